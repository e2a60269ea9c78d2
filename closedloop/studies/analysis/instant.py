"""A run at an instant: the state at a row, and the run from there on."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.encoder import NO_ENCODER
from closedloop.control.reference.table import Reference
from closedloop.jit.background import make_ready
from closedloop.loop.events.impacts import collide
from closedloop.loop.events.phases import IMPACT_LAW_WANTED, MEASURED, STEP_END, TABLE_FULL, TERMS
from closedloop.loop.events.table import KINDS
from closedloop.loop.step.make_loop import Loop
from closedloop.loop.step.record_row import Row, complete_record
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.loop_start import read_encoders
from closedloop.simulation.engines.loops import PINOCCHIO, kernels_of, loop_for
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Answers, single_calls
from closedloop.simulation.stepper import Stepper
from closedloop.studies.analysis.closed_contacts import contacts_of, put_contacts

# What of the loop's memory is the state at a row, beside the states in z.
KEPT = (
    "q", "v", "torque", "drives.held", "tip.anchor", "friction.direction", "joint_friction.stuck", "encoders.last_q",
    "encoders.last_v", "drives.before",
)  # fmt: skip
# The parts of z, in their order.
PARTS = ("law", "compensation", "filter", "friction", "joint friction", "transmission")


@dataclass(frozen=True)
class Instant:
    """The state of a run just before a row."""

    time: float  # its time, s
    mode: int  # contact mode, see `closedloop.mechanics.closure.contact_force`
    values: dict[str, Array]  # arrays of the loop's memory, by the names `KEPT`
    z: dict[str, Array]  # states of the parts `PARTS`
    # measured, force: the reading of the sensor that the law has, and f at this instant, N
    measured: float
    force: float = 0.0
    # state of the contacts of links, if one is closed; see `closedloop.studies.analysis.closed_contacts`
    contacts: dict[str, Array] = field(default_factory=dict)


def parts_of(problem: Problem) -> dict[str, slice]:
    """Return where in z the states of each part are; empty slices for those that there are not."""
    n, motors = problem.robot.n, 2 * problem.robot.n if problem.scenario.transmission.elastic else 0
    counts = (
        problem.law.states, problem.compensation.states, problem.sensor.states, problem.friction.states,
        n * problem.joint_friction.states, motors,
    )  # fmt: skip
    ends = np.cumsum(counts).tolist()
    return {name: slice(end - count, end) for name, count, end in zip(PARTS, counts, ends, strict=True)}


def refuse_outside(scenario: Scenario, at: float, what: str = "linearise: at") -> None:
    """Refuse an instant, s, outside the run; `what` is what gave it."""
    end = scenario.time.duration
    if not 0.0 <= at <= end:
        raise ScenarioError(f"{what} = {at:g} s: must be within the run, 0 to time.duration = {end:g} s")


def row_at(problem: Problem, at: float) -> int:
    """Return the row of an instant, s: the nearest at which the law is evaluated, and its velocities are as always.

    The first reading of encoders that take differences has none before it.
    """
    hold = max(problem.hold, 1)
    refuse_outside(problem.scenario, at)
    first = 1 if problem.scenario.encoder.velocity == "difference" else 0
    return min(max(round(at / (problem.h * hold)), first), problem.steps // hold) * hold


def run_to(problem: Problem, row: int) -> Instant:
    """Simulate to a row and return the state there.

    Raises
    ------
    SimulationError
        If the run stops before, or the contact changes there: an impact, a touchdown, the end of a slip ...
    """
    stepper = Stepper(problem, PINOCCHIO)
    stepper.let(None)
    h = problem.h
    try:
        for _ in range(row + 1):
            stepper.to_row()
    except SimulationError as error:
        raise SimulationError(
            f"linearise: the run stops before t = {row * h:g} s: {error}", getattr(error, "time", 0.0)
        ) from error
    mark, force = stepper.mark, float(stepper.loop.w.tip.F[0])
    if row < problem.steps:
        try:
            stepper.to_row()
        except SimulationError as error:
            raise SimulationError(f"linearise: at t = {row * h:g} s the run stops: {error}", row * h) from error
    for event in stepper.answers.events[: stepper.events_done]:
        if row > 0 and abs(event[0] - row * h) < h * (1.0 + 1e-9):
            kind = KINDS[int(event[1])]
            raise SimulationError(
                f"linearise: t = {row * h:g} s is within a step of an event ({kind} at {event[0]:.6g} s), where there "
                "is no linear loop; take an instant before or after it",
                row * h,
            )
    stepper.back_to(mark)
    state, w = stepper.loop.state, stepper.loop.w
    contacts = contacts_of(problem, stepper.loop, row * h)
    values = {name: np.array(attrgetter(name)(w)) for name in KEPT}
    if state.settings.encoder != NO_ENCODER and state.phase == MEASURED:
        values |= {"q": np.array(w.encoders.true_q), "v": np.array(w.encoders.true_v)}
    before = np.array(w.z)
    if row == 0 and state.settings.states_at != 0:  # the law's states as it has started them, which the row has
        before[: state.law_states] = stepper.rows[
            0, state.settings.states_at : state.settings.states_at + state.law_states
        ]
    z = {name: before[where] for name, where in parts_of(problem).items()}
    return Instant(row * h, int(state.mode), values, z, float(w.sensing.measured), force, contacts)


def put(instant: Instant, problem: Problem, loop: Loop) -> None:
    """Write the state of an instant into a loop's memory, which may be that of another sensor: it is then at rest."""
    state, w = loop.state, loop.w
    for name, value in instant.values.items():
        attrgetter(name)(w)[:] = value
    for name, where in parts_of(problem).items():
        mine, width = instant.z[name], where.stop - where.start
        if mine.size == width:
            w.z[where] = mine
        elif name == "filter" and width:
            w.z[where] = instant.force
    w.sensing.ring[:] = w.sensing.measured = instant.measured
    state.row = row = round(instant.time / problem.h)
    w.time = row * problem.h
    state.mode, state.started, state.sampled, state.trial.off, state.cleared = instant.mode, 1, 1, 1, 1
    state.phase = STEP_END
    if instant.contacts:
        put_contacts(instant.contacts, loop)
    if state.settings.encoder != NO_ENCODER:
        read_encoders(loop, problem.table)


def run_on(problem: Problem, instant: Instant, rows: int, kick: float = 0.0) -> Array:
    """Run the whole loop on from an instant and return the contact force of the next rows (rows,), N; see `rows_on`."""
    return rows_on(problem, instant, rows, kick)[:, Row.place("contact_force", problem.robot.n)]


def rows_on(problem: Problem, instant: Instant, rows: int, kick: float = 0.0) -> Array:
    """Run the whole loop on from an instant and return the next rows as they are recorded, (rows, ...).

    Parameters
    ----------
    rows : int
        How many; less if the run ends or stops before.
    kick : float
        Added to f_des at the first sample, N.
    """
    problem = replace(problem, robot=Robot(problem.robot.model, problem.robot.tip))
    loop, n = problem.loop(), problem.robot.n
    make_ready(*kernels_of(PINOCCHIO), *problem.called(loop), complete_record, collide)
    problem.connect(loop)
    put(instant, problem, loop)
    first = int(loop.state.row)
    last = min(first + rows, problem.steps)
    record = np.zeros((problem.steps + 1, problem.row_width))
    answers = Answers(problem, loop)
    arrays = problem.table, problem.integrator.tableau(), record
    once, _ = single_calls(problem, loop_for(PINOCCHIO), loop, arrays, PINOCCHIO)
    kicked = problem.table[
        first * problem.nodes : (first + max(problem.hold, 1)) * problem.nodes, Reference.place("force", n)
    ]
    before = kicked.copy()
    kicked += kick
    try:
        while loop.state.row < last:
            request = once(answers.events)
            if request in (TABLE_FULL, IMPACT_LAW_WANTED):
                answers.give(request)
            elif request != TERMS:
                break
    finally:
        kicked[:] = before
    return np.array(record[first : loop.state.row])
