"""Eight runs at a time in SIMD lanes, and their loop.

They are runs of a batch with the paper's law and the tip on a smooth surface. The loop calls the kernels of a single
run, in the order of `closedloop.loop.events` without events.

Such a run has no events, impacts or friction, so its steps have no branches. Eight of them take each step together in
float64x8 (`closedloop.jit.simd8`), by the same kernels as a single run, with the same result to the last bit. The
summary of a run is accumulated row by
row (`closedloop.record.report.measured`); the rows are kept only on request.

If one of the eight needs an event (liftoff), comes near a singular pose or diverges, the loop returns a status, and
each of the eight is run by itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.control.reference.table import Reference
from closedloop.jit.background import make_ready
from closedloop.jit.blocks import Block
from closedloop.jit.calls import address_of, integers_at, matrix_at
from closedloop.jit.kernel import entry_kernel, jit_disabled, kernel_inlined, plain
from closedloop.jit.numba_simd8 import float64x8_at, with_lane
from closedloop.jit.simd8 import WIDE, aligned, every
from closedloop.loop.step.advance import advance
from closedloop.loop.step.energy_supplied import add_stage_work, commit_work, save_power
from closedloop.loop.step.entries import nearest_row
from closedloop.loop.step.evaluate import bounded, paper_torque
from closedloop.loop.step.locate import locate_on_plane
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.loop.step.record_row import Row, record_conditions, record_state
from closedloop.loop.step.singular import near_singular
from closedloop.mechanics.closure.conditioning import BATCH
from closedloop.mechanics.closure.contact_force import (
    PRESSED,
    accelerate,
    baumgarte_acceleration,
    factorise,
    free_acceleration,
    pressed_force,
)
from closedloop.mechanics.closure.solve import DIVERGED, OK
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import Tree, energy_there, tree_terms, work_size
from closedloop.record.report.measured import Tally, Values, begin_tally, count_condition, count_row, write_values
from closedloop.record.report.row_sample import JointLimits, joint_limits
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.scenario_numbers import needs_general_form

# Status: in some lane the tip may leave the surface, or is near a singular pose, or the stabiliser would pull.
NEEDS_EVENTS = -1


# Of each row for `closedloop.record.report.control_verdict`: f − f_des, and the tip less its path along both tangents.
SIGNALS = 3


class Worst(Block):
    """Of all rows, for a first look at the control: `closedloop.simulation.batch.control`."""

    miss: float  # largest |f − f_des| of the later half, N
    off_squared: float  # of the tip off its path along the surface, m²
    least: float  # f_des, N
    wanted_squared: float  # the sum of f_des² over the rows, N²
    lowest: float  # the path along the normal, least until now, m
    rise: float  # and the most that it then rose from there, m


class LaneAddresses(Block):
    """Whole numbers, int64: addresses of the arrays of the loop's memory, each of float64x8."""

    work: int
    terms: int
    constants: int
    forces: int
    largest: int
    rows: int
    tallies: int
    values: int
    signals: int
    worst: int


class Sizes(NamedTuple):
    """Sizes of the arrays in memory."""

    nodes: int  # rows of a table to each of the record's
    # instants, columns: of a table
    instants: int
    columns: int
    kept: int  # rows of the record in memory: all, or `BATCH`, which are then overwritten in turn
    width: int  # length of such a row


@entry_kernel
def run_in_lanes(
    tree: Tree, addresses: IntArray, state_numbers: IntArray, h: float, tableau: Array, tables: IntArray, sizes: Sizes,
    limits: Array,
) -> int:  # fmt: skip
    """Run eight problems from start to end.

    Returns OK, or NEEDS_EVENTS or a status of `closedloop.mechanics.closure.solve` if at least one lane could not
    go on.

    Parameters
    ----------
    tree : Tree
        Their robot.
    addresses : array of int
        Memory of `LaneAddresses`.
    state_numbers : array of int
        See `closedloop.loop.step.memory`; the same for all.
    h : float
        Step, s.
    tableau : (S + 1, S) array
        See `closedloop.mechanics.integrators.Scheme.tableau`.
    tables : (8,) array of int
        Addresses of the reference table of each run, see `closedloop.loop.step.entries`.
    sizes : Sizes
        Of the arrays in memory.
    limits : (4 n,) array
        See `closedloop.record.report.row_sample.joint_limits`.
    """
    n, state, kept, width = tree.n, State(state_numbers), sizes.kept, sizes.width
    ends = integers_at(state.addresses.group_ends, state.n)
    stages, steps, hold = state.settings.stages, state.settings.steps, state.settings.hold
    semi_implicit, unilateral = state.settings.semi_implicit != 0, state.settings.unilateral != 0
    at = LaneAddresses(addresses)
    w = Work(float64x8_at(at.work, 0), n, 0, stages, 1, 0)
    terms = float64x8_at(at.terms, n * n + n + work_size(n))
    H, C, scratch = terms[0 : n * n].reshape(n, n), terms[n * n : n * n + n], terms[n * n + n :]
    largest = float64x8_at(at.largest, 1)[0]
    constants = Constants(
        float64x8_at(at.constants, 0), n, state.law.size, state.compensation.size, state.friction.size,
        state.joint_friction.size, state.compliance.size, 0,
    )  # fmt: skip
    forces = float64x8_at(at.forces, sizes.instants)
    rows = float64x8_at(at.rows, kept * width).reshape(kept, width)
    tally, values = Tally(float64x8_at(at.tallies, 0), n), Values(float64x8_at(at.values, 0), n)
    joint_limits, wanted = JointLimits(limits, n), w.reference
    signals = float64x8_at(at.signals, (steps + 1) * SIGNALS).reshape(steps + 1, SIGNALS)
    worst = Worst(float64x8_at(at.worst, 0))
    begin_tally(tally, h, largest)
    w.supply.energy = 0.0
    for row in range(steps + 1):
        begin, slot = row * h, row % kept
        for stage in range(stages if row < steps else 1):
            node = 0.0
            for i in range(stage):
                node += tableau[stage, i]
            t = begin + node * h
            tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
            desired(t, h / sizes.nodes, tables, sizes, forces, wanted)
            sampled = hold == 0 or (stage == 0 and row % hold == 0)
            status = press(H, C, w, constants, t, sampled, ends)
            if status != OK:
                return status
            if unilateral and not (every(w.tip.F[0] >= 0.0) and every(w.tip.F[0] - w.tip.stabiliser_force[0] >= 0.0)):
                return NEEDS_EVENTS
            if stage == 0:
                record_state(H, C, w, state, rows, slot)
                potential = energy_there(tree, w.q, scratch)
                write_signals(w, wanted, signals, row, worst)
                count_row(Row(rows[slot], n), n, potential, wanted, joint_limits, row, tally)
                if row == steps:
                    record_conditions(w.batch, rows, state, slot + 1, n)
                if state.batched == 0:
                    for i in range(slot - slot % BATCH, slot + 1):
                        count_condition(Row(rows[i], n), tally)
                for j in range(n):
                    w.start.state[j] = w.q[j]
                    w.start.state[n + j] = w.v[j]
                save_power(w, state)
            if row < steps:
                add_stage_work(w, state, stage, h, tableau[stages, stage])
                advance(stage, h, semi_implicit, False, tableau, w)
        commit_work(w)
    write_values(Row(rows[steps % kept], n), n, steps + 1, tally, values)
    return OK


@kernel_inlined
def write_signals(w: Work, wanted: Reference, signals: Array, i: int, worst: Worst) -> None:
    """Write `SIGNALS` numbers of row i, and count it into the worst."""
    frame, miss, off, height = w.tip.frame, w.tip.F[0] - wanted.force, 0.0, 0.0
    for a in range(2):
        along = 0.0
        for k in range(3):
            along = along + frame[1 + a, k] * (w.r[k] - wanted.position[k])
        signals[i, 1 + a] = along
        off = off + along * along
    for k in range(3):
        height = height + frame[0, k] * wanted.position[k]
    signals[i, 0] = miss
    if i == 0:
        worst.miss = worst.off_squared = worst.rise = worst.wanted_squared = 0.0 * miss
        worst.least, worst.lowest = wanted.force, height
    if i >= signals.shape[0] // 2:
        worst.miss = max(worst.miss, abs(miss))
    worst.off_squared = max(worst.off_squared, off)
    worst.least = min(worst.least, wanted.force)
    worst.wanted_squared += wanted.force * wanted.force
    worst.lowest = min(worst.lowest, height)
    worst.rise = max(worst.rise, height - worst.lowest)


@kernel_inlined
def desired(t: float, spacing: float, tables: IntArray, sizes: Sizes, forces: Array, wanted: Reference) -> None:
    """Write the reference of each run at t, an instant of the tables; see `closedloop.loop.step.entries`."""
    at = nearest_row(t, spacing, sizes.instants)
    reference = wanted.memory
    width = reference.shape[0]
    first = matrix_at(tables[0], sizes.instants, sizes.columns)
    for j in range(width):
        reference[j] = first[at, j]
    for i in range(1, WIDE):
        if tables[i] != tables[0]:
            own = matrix_at(tables[i], sizes.instants, sizes.columns)
            for j in range(width):
                reference[j] = with_lane(reference[j], i, own[at, j])
    wanted.force = forces[at]


@kernel_inlined
def press(H: Array, C: Array, w: Work, constants: Constants, t: float, sampled: bool, ends: IntArray) -> int:
    """Evaluate law, contact and Eq. 24 with the tip on a smooth surface; see
    `closedloop.loop.step.evaluate.evaluate`."""
    locate_on_plane(w, constants)
    status = factorise(H, w.tip.A, w.L, w.tip.X, w.tip.S, constants.reach, ends)
    if status != OK:
        return status
    if sampled:
        paper_torque(C, w, constants, t)
    free_acceleration(w.L, w.tip.X, w.tip.drift_c, w.torque, C, w.y, w.tip.a, ends)
    w.tip.b[0] = baumgarte_acceleration(constants.s_v, constants.s_p, w.tip.rate, w.tip.gap)
    if near_singular(w.tip.S):
        return NEEDS_EVENTS
    status, w.tip.stabiliser_force[0] = pressed_force(
        w.tip.S, w.tip.a, w.tip.b[0], w.friction.c, w.friction.viscous, w.tip.F
    )
    if status != OK:
        return status
    accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, ends)
    return OK if bounded(w) else DIVERGED


# Eight runs in lanes take as long as two by themselves; fewer than this many are run one by one.
FEWEST = 3


def can_use_lanes(scenario: Scenario) -> bool:
    """Whether a scenario may run without branches: the paper's law, on a smooth surface from the start."""
    return (
        not needs_general_form(scenario)
        and scenario.surface.kind == "plane"
        and scenario.tool.radius == 0.0
        and scenario.surface_motion.kind == "none"
        and np.isinf(scenario.surface.bounds()[0])
        and scenario.compliance.kind == "none"
        and not scenario.surface.gap > 0.0
        and scenario.stabiliser.kind in ("baumgarte", "none")
        and scenario.time.integrator in INTEGRATORS
        and not jit_disabled()
    )


class Kind(NamedTuple):
    """What the runs of one set of lanes have in common."""

    contact: str
    integrator: str
    robot: Robot
    steps: int
    h: float
    nodes: int
    hold: int


def kind_of(problem: Problem) -> Kind | None:
    """Return what a run must have in common with the others in its lanes; None for one that cannot use lanes."""
    scenario = problem.scenario
    if not can_use_lanes(scenario) or problem.general or problem.robot.model.loops or problem.mode != PRESSED:
        return None
    return Kind(
        scenario.surface.contact, scenario.time.integrator, problem.robot, problem.steps, problem.h, problem.nodes,
        problem.hold,
    )  # fmt: skip


class LaneRuns:
    """Memory for eight runs of one kind; see `kind_of`.

    Parameters
    ----------
    like : Problem
        One of the runs, for the sizes.
    keep : bool
        Whether all rows are kept.

    Attributes
    ----------
    kind : Kind
        The kind of all eight.
    n : int
        Joints.
    end : float
        Instant of the last row, s.
    """

    def __init__(self, like: Problem, kind: Kind, keep: bool) -> None:
        n, stages = like.robot.n, like.integrator.stages
        self.kind, self.n, self.end = kind, n, like.h * like.steps
        loop = like.loop()
        self._state, self._tableau, self._one = loop.state, like.integrator.tableau(), loop.constants
        self._h = like.h
        self._work = Work(aligned(Work.count(n, 0, stages, 1, 0)), n, 0, stages, 1, 0)
        self._constants = aligned(loop.constants.memory.size)
        self._forces, self._largest = aligned(like.table.shape[0]), aligned(1)
        self._rows = aligned(like.steps + 1 if keep else BATCH, Row.count(n))
        (instants, columns), (kept, width) = like.table.shape, self._rows.shape[:2]
        self._sizes = Sizes(like.nodes, instants, columns, kept, width)
        self._values, self._signals = aligned(Values.count(n)), aligned(like.steps + 1, SIGNALS)
        self._worst = aligned(Worst.count())
        self._limits = joint_limits(like.robot.model)
        self._parts = {
            "work": self._work.memory, "terms": aligned(n * n + n + plain(work_size)(n)), "constants": self._constants,
            "forces": self._forces, "largest": self._largest, "rows": self._rows, "tallies": aligned(Tally.count(n)),
            "values": self._values, "signals": self._signals, "worst": self._worst,
        }  # fmt: skip
        self._addresses = LaneAddresses(np.zeros(LaneAddresses.count(), dtype=np.int64))
        for name, part in self._parts.items():
            setattr(self._addresses, name, address_of(part))
        self._tables: list[Array] = []
        self._misses, self._has_misses = np.empty((WIDE, like.steps + 1)), False

    @property
    def bytes(self) -> int:
        """Return the size of the memory, bytes."""
        return sum(part.nbytes for part in self._parts.values())

    def put(self, lane: int, problem: Problem) -> None:
        """Load a problem into a lane; afterwards the table's forces and noise may be overwritten."""
        n = self.n
        if lane == 0:
            self._tables.clear()
        self._constants[:, lane] = problem.constants(self._one).memory
        self._work.q[:, lane], self._work.v[:, lane] = problem.q, problem.v
        self._work.tip.frame[..., lane] = problem.frame
        force = problem.table[:, Reference.place("force", n)]
        self._forces[:, lane] = force
        self._largest[0, lane] = np.abs(force[:: problem.nodes]).max()
        self._tables.append(problem.table)

    def run(self, tree: Tree, count: int) -> bool:
        """Run the first `count` lanes; False if one of them could not be finished here."""
        for part in (self._constants, self._forces, self._largest, self._work.q, self._work.v, self._work.tip.frame):
            part[..., count:] = part[..., :1]  # unused lanes repeat the first
        addresses = [address_of(table) for table in self._tables[:count]]
        tables = np.array(addresses + addresses[:1] * (WIDE - count))
        self._state.batched, self._has_misses = 0, False
        make_ready(run_in_lanes)
        status = run_in_lanes(
            tree, self._addresses.memory, self._state.memory, self._h, self._tableau, tables, self._sizes, self._limits
        )
        return status == OK

    def values(self, lane: int) -> Array:
        """Return the values of a run's summary, see `closedloop.record.report.measured`."""
        return self._values[:, lane].copy()

    def worst(self, lane: int) -> Worst:
        """Return what a first look at the control goes by."""
        return Worst(self._worst[:, lane])

    def miss(self, lane: int) -> Array:
        """Return f − f_des, (N,)."""
        if not self._has_misses:  # of all lanes at once: they are in the same cache lines
            np.copyto(self._misses, self._signals[:, 0].T)
            self._has_misses = True
        return self._misses[lane]

    def signals(self, lane: int) -> tuple[Array, Array, Array, Array]:
        """Return f_des, (N,), f, (N,), the tip less its path along the surface, (N, 3), and the path, (N, 3)."""
        n, nodes = self.n, self._sizes.nodes
        wanted, own = self._forces[::nodes, lane].copy(), self._signals[:, :, lane].T.copy()
        along = own[1:].T @ self._work.tip.frame[1:, :, lane]
        return wanted, wanted + own[0], along, self._tables[lane][::nodes, Reference.place("position", n)]

    def normal(self, lane: int) -> Array:
        """Return the normal (3,) of the plane."""
        return self._work.tip.frame[0, :, lane].copy()

    def rows(self, lane: int) -> Array:
        """Return the rows of a run, if they were kept; the next run overwrites them."""
        return self._rows[:, :, lane]


def uses_lanes(scenario: Scenario, engine: str, runs: int) -> bool:
    """Whether a scenario is run in lanes, with others of its kind, in a batch of so many runs."""
    return engine == COMPILED and runs >= FEWEST and can_use_lanes(scenario)
