"""The equation of motion beside the state of a run at an instant.

An evaluation is one call of the loop's own kernel at a row: law, friction, contact and Eq. 24 are those of a run, and
nothing is written twice. White noise and quantisation, which have no derivative, are left out of it.

Of the contacts of links that are closed a rigid one that slides binds n, one that sticks t1 and t2 as well, like rows
of loop joints; a soft one binds nothing along n. The forces are those that the run's own kernel solves for in these
modes.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.reference.desired import Reference
from closedloop.control.sensor import DIFFERENCE, NO_ENCODER, EncoderParameters, SensorParameters
from closedloop.jit.background import make_ready
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.locate import MEASURED, STEP_END
from closedloop.loop.events.table import KINDS
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.locate import sensor_feels
from closedloop.loop.step.memory import Loop
from closedloop.loop.step.record_row import Row, complete_record
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.memory import ContactMemory
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.reactions import loop_rows
from closedloop.mechanics.loops.solve import closed_to
from closedloop.mechanics.robot.tree.layout import turn
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of
from closedloop.simulation.engines.loops import PINOCCHIO
from closedloop.simulation.engines.problem import Problem, read_encoders
from closedloop.simulation.loop_calls import Driver, Stepper, drive

# What of the contacts' memory is their state, beside what the scenario says of them.
STATE = (
    "mode", "near", "direction", "anchor", "past_edge", "side", "located", "inside",
    "gaps.cleared", "gaps.floor", "gaps.unloaded",
    "friction.pulls", "friction.start_slip", "friction.start_u",
)  # fmt: skip


def contacts_of(problem: Problem, loop: Loop, time: float) -> dict[str, Array]:
    """Return the state of the contacts of links if one is closed, else nothing; refuse what is not linearised."""
    if loop.state.coupled == 0:
        return {}
    memory: ContactMemory = loop.w.kept["contacts"]
    links, c = memory.links, memory.contacts
    friction, resistance = c.friction, c.friction.resistance.owner >= 0.0
    closed, points = c.mode != FREE, np.arange(links.k) < links.points
    stops = closed & (np.arange(links.k) >= links.points) & (np.arange(links.k) < links.points + links.stops)
    names = ("tip", *names_of(problem.scenario.contact or ()))

    def refuse(why: str) -> SimulationError:
        return SimulationError(f"linearise: at t = {time:g} s {why}; take another instant", time)

    if np.any(stops):
        number = int(c.joint[np.flatnonzero(stops)[0]])
        who = f"joint {problem.robot.joint_names[number]}" if number < problem.robot.n else "a tendon"
        raise refuse(f"{who} is at its stop, which is not linearised")
    if links.undecided != 0 or links.stepped != 0:
        raise refuse("no modes of the contacts are found, and their forces are those of a time step")
    if np.any(resistance & closed):
        owner = names[int(c.friction.resistance.owner[np.flatnonzero(resistance & closed)[0]])]
        raise refuse(f"contact {owner!r} resists rolling or pivoting, which is not linearised")
    remembers = points & closed & ((friction.states > 0.0) | (friction.lag > 0.0))
    remembers[0] = False
    if np.any(remembers):
        name = names[int(np.flatnonzero(remembers)[0])]
        raise refuse(f"contact {name!r} is closed, whose friction has a memory, which is not linearised")
    return {name: np.array(attrgetter(name)(c)) for name in STATE}


def put_contacts(state: dict[str, Array], loop: Loop) -> None:
    """Write the state of contacts into a loop's memory."""
    memory: ContactMemory = loop.w.kept["contacts"]
    for name, value in state.items():
        attrgetter(name)(memory.contacts)[:] = value
    memory.links.undecided = memory.links.fresh = memory.links.stepped = memory.links.chattering = 0
    loop.state.coupled = 1


class ClosedContacts:
    """The closed contacts of links in a loop's memory, while it is evaluated again and again.

    `names`, `sizes`: of those that are closed; how many numbers `read` returns, by their names.
    """

    def __init__(self, problem: Problem, loop: Loop) -> None:
        self._loop, memory = loop, loop.w.kept["contacts"]
        self._numbers: Any = memory.contacts
        self._links = memory.links
        self._saved = memory.contacts.memory.copy(), memory.links.memory.copy()
        self._modes = np.array(memory.contacts.mode)
        names = names_of(problem.scenario.contact or ())
        self._closed = [i for i in range(1, len(names) + 1) if self._modes[i] != FREE]
        self.names = tuple(names[i - 1] for i in self._closed)
        self._normals = np.array([3 * i for i in self._closed], dtype=np.intp)
        rows: list[int] = []
        for i in self._closed:
            rows += [] if memory.contacts.soft[i] != 0.0 else [3 * i]
            rows += [3 * i + 1, 3 * i + 2] if self._modes[i] == STUCK else []
        self._rows = np.array(rows, dtype=np.intp)
        self.sizes = {"rates": self._rows.size, "presses": self._normals.size}

    def put_back(self) -> None:
        """Write the state again that the contacts had at first."""
        self._numbers.memory[:], self._links.memory[:] = self._saved

    def read(self) -> tuple[Array, Array] | None:
        """Return the rates u of the rows that bind (m,), m/s, and the normal forces (k,), N; None in other modes."""
        decided = self._loop.state.coupled != 0 and self._links.undecided == self._links.stepped == 0
        if not decided or not np.array_equal(self._numbers.mode, self._modes):
            return None
        return self._numbers.u[self._rows], self._numbers.F[self._normals]

    def rows(self) -> Array:
        """Return the rows that bind at the state evaluated last (m, n)."""
        return np.array(self._numbers.G[self._rows])


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
    # state of the contacts of links, if one is closed; see `closedloop.studies.analysis.here`
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

    Raises SimulationError if the run stops before, or the contact changes there: an impact, a touchdown, the end of a
        slip ...
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
    w.sensing.ring[0] = w.sensing.measured = instant.measured
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

    `rows`: how many; less if the run ends or stops before.
    `kick`: added to f_des at the first sample, N.
    """
    problem = problem.with_robot(problem.robot.again())
    record, n = np.zeros((problem.steps + 1, problem.row_width)), problem.robot.n
    driver = Driver(problem, record)
    make_ready(complete_record, collide)
    put(instant, problem, driver.loop)
    state = driver.loop.state
    first = int(state.row)
    last = min(first + rows, problem.steps)
    kicked = problem.table[
        first * problem.nodes : (first + max(problem.hold, 1)) * problem.nodes, Reference.place("force", n)
    ]
    before = kicked.copy()
    kicked += kick
    try:
        if first < last:
            drive(lambda request: driver.once(), driver.answers.give, lambda: bool(state.row < last))
    finally:
        kicked[:] = before
    return np.array(record[first : state.row])


# Rows that bind whose singular value is below this share of the largest depend on others.
DEPENDENT = 1e-9


class EventHere(Exception):
    """The contact changes its mode at the state that was evaluated, or the forces have no derivative there."""


@contextmanager
def without_event(time: float) -> Iterator[None]:
    """Raise a SimulationError, that there is no linear loop, in place of the `EventHere` of an instant, s."""
    try:
        yield
    except EventHere:
        raise SimulationError(
            f"linearise: at t = {time:g} s the contact is about to change, or friction to turn: there is no linear "
            "loop; take another instant",
            time,
        ) from None


@dataclass
class Here:
    """Evaluations at states beside that of an instant, without the stabiliser.

    So a tip that is off the surface, or moves off it, is one whose surface has been moved.
    """

    problem: Problem
    instant: Instant
    free: bool = False  # whether it may be in flight

    def __post_init__(self) -> None:
        self.problem = problem = self.problem.with_robot(self.problem.robot.again())
        self.row = round(self.instant.time / problem.h)
        self._driver = Driver(problem, np.empty((self.row + 2, problem.row_width)))
        self.loop = loop = self._driver.loop
        self._loops: LoopMemory | None = loop.w.kept.get("loops")
        make_ready(complete_record, *([] if self._loops is None else [closed_to]))
        self._balls = problem.robot.model.balls
        state, w, constants = loop.state, loop.w, loop.constants
        n = problem.robot.n
        put(self.instant, problem, loop)
        state.settings.project = 0
        state.settings.semi_implicit = 0  # so that friction's states have rates
        sensor: Any = SensorParameters(constants.sensor, 0)
        sensor.noise = sensor.quantisation = sensor.jitter = sensor.saturation = 0.0
        if problem.encoder.size:
            encoder = EncoderParameters(constants.encoder, n)
            for name in ("noise", "quantisation", "velocity_noise"):
                getattr(encoder, name)[:] = 0.0
        for key, lag in (("friction", constants.lag), ("joint_friction", np.max(constants.joint_lag))):
            if lag > 0.0:
                kind = getattr(problem.scenario, key).kind
                raise ScenarioError(
                    f"linearise: {key}.kind = {kind!r} depends on the slip {lag:g} s earlier, which is not linearised; "
                    "take another law"
                )
        if problem.compensation.member.reads_tangential:
            kind = problem.scenario.compensation.kind
            raise ScenarioError(
                f"linearise: compensation.kind = {kind!r} reads forces along the tangents, which is not part of the "
                "linear loop: take another compensation"
            )
        if problem.robot.moved:
            raise ScenarioError("linearise: the motion of a [[mocap]] is not part of the linear loop: leave it out")
        constants.s_v = constants.s_p = 0.0
        self.contacts = ClosedContacts(problem, loop) if self.instant.contacts else None
        touches = self.free or self.contacts is not None
        if not problem.scenario.has_surface and not touches:
            raise ScenarioError(
                "linearise: the scenario has no [surface], and no contact of a link is closed at "
                f"t = {self.instant.time:g} s: without a contact there is no force loop"
            )
        if self.instant.mode == FREE and not touches:
            raise SimulationError(
                f"linearise: the tip is in flight at t = {self.instant.time:g} s, where there is no force loop; take "
                "an instant at which it presses",
                self.instant.time,
            )
        self._encoder = int(state.settings.encoder)
        self._motors = parts_of(problem)["transmission"]
        self._saved = state.memory.copy(), w.memory.copy(), constants.memory.copy()
        self.held = np.array(w.torque)  # the torque (n,) of an evaluation that holds it, N m
        self._sensor, self._z = sensor, type(w).place("z", *w.sizes)
        node = self.row * problem.nodes
        self._force_nodes = problem.table[node : node + problem.nodes + 1, Reference.place("force", n)]
        self._asked = self._force_nodes.copy()
        sizes = {
            "qdd": n, "dz": w.z.size, "f": 1, "felt": 1, "torque": n, "r": 3, "u": w.tip.u.size, "gap": 1,
            "last": 2 * n, **({} if self.contacts is None else self.contacts.sizes),
        }  # fmt: skip
        ends = np.cumsum(list(sizes.values())).tolist()
        self.places = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}
        self._width = ends[-1]

    @property
    def n(self) -> int:
        """Joints."""
        return self.problem.robot.n

    @property
    def differences(self) -> bool:
        """Whether the controller's velocities are differences of readings."""
        return self._encoder == DIFFERENCE

    def __call__(self, held: bool = False, **changes: Any) -> dict[str, Array]:
        """Evaluate once, with changes to the state and the inputs, and return what follows, by name; see `flat`."""
        found = self.flat(held, **changes)
        return {name: found[where] for name, where in self.places.items()}

    def flat(self, held: bool = False, **changes: Any) -> Array:
        """Evaluate once, with changes to the state and the inputs, and return what follows in one row, see `places`.

        `held`: whether the torque is `held`, instead of the law's.
        `changes`: q, v, z, last: added to the state; measured, force (f_des), bias (of the sensor), (1,), N; link:
            torque on the links (n,), N m; torque: added to what is held (n,); compliance: added to its parameters.
        Raises EventHere if the contact would change its mode.
        """
        loop, problem, n = self.loop, self.problem, self.n
        state, w, constants = loop.state, loop.w, loop.constants
        state.memory[:], w.memory[:], constants.memory[:] = self._saved
        if self.contacts is not None:
            self.contacts.put_back()
        if "z" in changes:
            w.z += changes["z"]
        if held:
            w.torque[:] = self.held
        if "torque" in changes:
            w.torque += changes["torque"]
        if "measured" in changes:
            w.sensing.measured += changes["measured"][0]
        if "last" in changes:
            w.encoders.last_q += changes["last"][:n]
            w.encoders.last_v += changes["last"][n:]
        if "bias" in changes:
            self._sensor.bias += changes["bias"][0]
        if "compliance" in changes:
            constants.compliance += changes["compliance"]
        nodes, asked = self._force_nodes, "force" in changes
        if asked:
            nodes += changes["force"]
        encoders = self._encoder != NO_ENCODER
        if encoders:
            w.q[:], w.v[:] = w.encoders.true_q, w.encoders.true_v
        if "q" in changes:
            self.move(w.q, changes["q"])
        if "v" in changes:
            w.v += changes["v"]
        self._close(w.q, w.v)
        if encoders:
            read_encoders(loop, problem.table)
        try:
            for _ in range(2 if encoders else 1):
                self._driver.terms()
                if "link" in changes:
                    problem.robot.views[1][:] -= changes["link"]
                state.sampled = 0 if held else 1
                self._driver.again()
        finally:
            if asked:
                nodes[:] = self._asked
        if state.row != self.row + 1 and not (state.row == problem.steps and self.row == state.row):
            raise EventHere
        found, places, general = np.empty(self._width), self.places, state.settings.general != 0
        dz, motors = found[places["dz"]], self._motors
        dz[:] = w.dz if general else 0.0
        if motors.stop > motors.start:  # what the semi-implicit scheme writes there is its own
            dz[motors][:n] = (self._saved[1][self._z] + changes.get("z", 0.0))[motors][n:]
        found[places["qdd"]], found[places["torque"]], found[places["r"]] = w.qdd, w.torque, w.r
        f = found[places["f"]] = w.tip.F[0]
        found[places["felt"]] = interpreted(sensor_feels)(0, w, self._sensor, state) if general else f
        found[places["u"]], found[places["gap"]] = w.tip.u, w.tip.gap
        last = found[places["last"]]
        last[:n], last[n:] = w.encoders.last_q, w.encoders.last_v
        if self.contacts is not None:
            seen = self.contacts.read()
            if seen is None:
                raise EventHere
            found[places["rates"]], found[places["presses"]] = seen
        return found

    def move(self, q: Array, by: Array) -> None:
        """Move q (n,) by so much; a joint that turns freely turns by it in the axes of its link."""
        before = q.copy()
        q += by
        for j in self._balls:
            turn(q, j, before, j, *by[j : j + 3])

    def _close(self, q: Array, v: Array) -> None:
        """Move q and q̇ to the nearest state that the loops allow."""
        if self._loops is not None:
            closed_to(self._loops.address, q, v)

    def loop_rows(self, q: Array) -> tuple[Array, Array]:
        """Return the rows G (m, n) of the loops at q, and their rate (m,) with q̇ of the instant."""
        v, there = self.instant.values["v"], bool(self.problem.robot.model.loops)
        G = loop_rows(self.problem.robot, q[None], v[None])[0][0] if there else np.zeros((0, self.n))
        return G, G @ v

    def geometry(self) -> tuple[Array, Array, Array, Array]:
        """Return H (n, n), the contact frame's Jacobian A (3, n), the frame (3, 3) and S (3, 3) at the instant."""
        self()
        w = self.loop.w
        H = np.triu(self.problem.robot.terms(self.instant.values["q"], self.instant.values["v"]).mass_matrix)
        H = H + np.triu(H, 1).T
        return H, np.array(w.tip.A), np.array(w.tip.frame), np.array(w.tip.S)

    def moved(self, depth: float) -> Instant:
        """Return the instant with the tip moved along the normal until it is so deep, m, in a soft surface.

        Nothing but geometry is asked: where the tip was, this surface may not carry it.
        """
        instant, problem = self.instant, self.problem
        q, v = instant.values["q"].copy(), instant.values["v"].copy()
        for _ in range(20):
            terms = problem.robot.terms(q, v)
            touching = problem.surface.touching(terms.position, t=instant.time)
            off = touching.gap + depth
            if abs(off) <= 1e-13 + 1e-12 * depth:
                break
            H, loops = np.triu(terms.mass_matrix), self.loop_rows(q)[0]
            H = H + np.triu(H, 1).T
            bound = np.vstack([touching.frame[:1] @ terms.jacobian, independent(loops) @ loops])
            answer = np.linalg.solve(H, bound.T)
            self.move(q, -answer @ np.linalg.inv(bound @ answer)[:, 0] * off)
            self._close(q, v)
        return replace(instant, values=instant.values | {"q": q, "v": v})


def independent(rows: Array) -> Array:
    """Return combinations (k, m) of rows (m, n) that are independent and span all of them."""
    if rows.size == 0:
        return np.zeros((0, rows.shape[0]))
    left, sizes, _ = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(left[:, sizes > DEPENDENT * sizes[0]].T)
