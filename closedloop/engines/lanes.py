"""Eight runs at a time in SIMD lanes: runs of a batch with the paper's law and the tip on a smooth surface.

Such a run has no events, impacts or friction, so its steps have no branches. Eight of them take each step together in
float64x8 (`closedloop.jit.simd8`), by the same kernels as a single run, with the same result to the last bit. This
module only calls them, in the order of `closedloop.events` without events. The summary of a run is accumulated row by
row (`closedloop.report.measured`); the rows are kept only on request.

If one of the eight needs an event (liftoff), comes near a singular pose or diverges, the loop returns a status, and
each of the eight is run by itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.conditioning import BATCH
from closedloop.closure.contact_force import (
    PRESSED,
    accelerate,
    baumgarte_acceleration,
    factorise,
    free_acceleration,
    pressed_force,
)
from closedloop.closure.solve import DIVERGED, OK
from closedloop.engines.loops import COMPILED
from closedloop.engines.needs import needs_general_form
from closedloop.engines.problem import Problem
from closedloop.integrators import INTEGRATORS
from closedloop.jit.background import make_ready
from closedloop.jit.kernel import entry_kernel, jit_disabled, kernel_inlined, plain
from closedloop.jit.numba_simd8 import float64x8_at, with_lane
from closedloop.jit.pointers import address_of, matrix_at
from closedloop.jit.simd8 import WIDE, aligned, every
from closedloop.report.measured import (
    Tally,
    Values,
    begin_tally,
    count_condition,
    count_row,
    write_values,
)
from closedloop.report.row_sample import JointLimits, joint_limits
from closedloop.robot.pinocchio import Robot
from closedloop.robot.tree import Tree, energy_there, tree_terms, work_size
from closedloop.scenario.scenario import Scenario
from closedloop.step.advance import advance
from closedloop.step.energy_supplied import add_stage_work, commit_work, save_power
from closedloop.step.evaluate import bounded, nearest_row, paper_torque
from closedloop.step.locate import locate_on_plane
from closedloop.step.memory import Constants, IntArray, Reference, State, Work
from closedloop.step.record_row import Row, record_conditions, record_state
from closedloop.step.singular import near_singular

Array = NDArray[np.float64]

# The arrays of the loop's memory, each of float64x8, in the order of `addresses`.
WORK, TERMS, CONSTANTS, FORCES, LARGEST, ROWS, TALLIES, VALUES = range(8)

# Eight runs in lanes take as long as two by themselves; fewer than this many are run one by one.
FEWEST = 3
# Status: in some lane the tip may leave the surface, or is near a singular pose, or the stabiliser would pull.
NEEDS_EVENTS = -1


def can_use_lanes(scenario: Scenario) -> bool:
    """Whether a scenario may run without branches: the paper's law, on a smooth surface from the start."""
    return (
        not needs_general_form(scenario)
        and scenario.surface.kind == "plane"
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
    if not can_use_lanes(scenario) or problem.general or problem.mode != PRESSED:
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
    kind : Kind
        Its kind.
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
        self._instants, self._columns = like.table.shape
        loop = like.loop()
        self._state, self._tableau = loop.state, like.integrator.tableau()
        self._h, self._spacing = like.h, like.h / like.nodes
        self._work = Work(aligned(Work.count(n, 0, stages, 1)), n, 0, stages, 1)
        self._constants = aligned(loop.constants.memory.size)
        self._forces, self._largest = aligned(like.table.shape[0]), aligned(1)
        self._rows = aligned(like.steps + 1 if keep else BATCH, Row.count(n))
        self._values = aligned(Values.count(n))
        self._limits = joint_limits(like.robot.model)
        self._parts = (
            self._work.memory, aligned(n * n + n + plain(work_size)(n)), self._constants, self._forces, self._largest,
            self._rows, aligned(Tally.count(n)), self._values,
        )  # fmt: skip
        self._addresses = np.array([address_of(part) for part in self._parts])
        self._tables: list[Array] = []

    @property
    def bytes(self) -> int:
        """Return the size of the memory, bytes."""
        return sum(part.nbytes for part in self._parts)

    def put(self, lane: int, problem: Problem) -> None:
        """Load a problem into a lane; afterwards the table's forces and noise may be overwritten."""
        n = self.n
        if lane == 0:
            self._tables.clear()
        self._constants[:, lane] = problem.constants().memory
        self._work.q[:, lane], self._work.v[:, lane] = problem.q, problem.v
        self._work.frame[..., lane] = problem.frame
        force = problem.table[:, 2 * n + 9]
        self._forces[:, lane] = force
        self._largest[0, lane] = np.abs(force[:: problem.nodes]).max()
        self._tables.append(problem.table)

    def run(self, tree: Tree, count: int) -> bool:
        """Run the first `count` lanes; False if one of them could not be finished here."""
        for part in (self._constants, self._forces, self._largest, self._work.q, self._work.v, self._work.frame):
            part[..., count:] = part[..., :1]  # unused lanes repeat the first
        addresses = [address_of(table) for table in self._tables[:count]]
        tables = np.array(addresses + addresses[:1] * (WIDE - count))
        self._state.batched = 0
        make_ready(run_in_lanes)
        status = run_in_lanes(
            tree, self._addresses, self._state.memory, self._h, self._spacing, self._tableau, tables,
            self._instants, self._columns, self._rows.shape[0], self._rows.shape[1], self._limits,
        )  # fmt: skip
        self._tables.clear()
        return status == OK

    def values(self, lane: int) -> Array:
        """Return the values of a run's summary, see `closedloop.report.measured`."""
        return self._values[:, lane].copy()

    def rows(self, lane: int) -> Array:
        """Return the rows of a run, if they were kept; the next run overwrites them."""
        return self._rows[:, :, lane]


@entry_kernel
def run_in_lanes(
    tree: Tree, addresses: IntArray, state_numbers: IntArray, h: float, spacing: float, tableau: Array,
    tables: IntArray, instants: int, columns: int, kept: int, width: int, limits: Array,
) -> int:  # fmt: skip
    """Run eight problems from start to end.

    Parameters
    ----------
    tree : Tree
        Their robot.
    addresses : (8,) array of int
        Of the arrays of the memory, see `LaneRuns`.
    state_numbers : array of int
        See `closedloop.step.memory`; the same for all.
    h, spacing : float
        Step, and time between two rows of a table, s.
    tableau : (S + 1, S) array
        See `closedloop.integrators.Scheme.tableau`.
    tables : (8,) array of int
        Addresses of the reference table of each run, (instants, columns), see `closedloop.step.evaluate.reference_row`.
    kept : int
        Rows in memory: all, or `BATCH`, which are then overwritten in turn.
    width : int
        Length of a row.
    limits : (4 n,) array
        See `closedloop.report.row_sample.joint_limits`.

    Returns
    -------
    int
        OK, or NEEDS_EVENTS or a status of `closedloop.closure.solve` if at least one lane could not go on.
    """
    n, state = tree.n, State(state_numbers)
    stages, steps, hold = state.stages, state.steps, state.hold
    semi_implicit, unilateral = state.semi_implicit != 0, state.unilateral != 0
    w = Work(float64x8_at(addresses[WORK], 0), n, 0, stages, 1)
    terms = float64x8_at(addresses[TERMS], n * n + n + work_size(n))
    H, C, scratch = terms[0 : n * n].reshape(n, n), terms[n * n : n * n + n], terms[n * n + n :]
    largest = float64x8_at(addresses[LARGEST], 1)[0]
    constants = Constants(
        float64x8_at(addresses[CONSTANTS], 0), n, state.law_size, state.compensation_size, state.friction_size,
        state.joint_friction_size, state.compliance_size,
    )  # fmt: skip
    forces = float64x8_at(addresses[FORCES], instants)
    rows = float64x8_at(addresses[ROWS], kept * width).reshape(kept, width)
    tally, values = Tally(float64x8_at(addresses[TALLIES], 0), n), Values(float64x8_at(addresses[VALUES], 0), n)
    joint_limits, wanted = JointLimits(limits, n), Reference(w.reference, n)
    begin_tally(tally, n, h, largest)
    w.supplied = 0.0
    for row in range(steps + 1):
        begin, slot = row * h, row % kept
        for stage in range(stages if row < steps else 1):
            node = 0.0
            for i in range(stage):
                node += tableau[stage, i]
            t = begin + node * h
            tree_terms(tree, w.q, w.v, scratch, H, C, w.J, w.r, w.drift)
            desired(t, spacing, tables, instants, columns, forces, w.reference)
            sampled = hold == 0 or (stage == 0 and row % hold == 0)
            status = press(H, C, w, constants, t, sampled)
            if status != OK:
                return status
            if unilateral and not (every(w.F[0] >= 0.0) and every(w.F[0] - w.stabiliser_force[0] >= 0.0)):
                return NEEDS_EVENTS
            if stage == 0:
                record_state(H, C, w, state, rows, slot)
                potential = energy_there(tree, scratch)
                count_row(Row(rows[slot], n), n, potential, wanted, joint_limits, row, tally)
                if row == steps:
                    record_conditions(w.batch, rows, state, slot + 1, n)
                if state.batched == 0:
                    for i in range(slot - slot % BATCH, slot + 1):
                        count_condition(Row(rows[i], n), tally)
                for j in range(n):
                    w.begin[j] = w.q[j]
                    w.begin[n + j] = w.v[j]
                save_power(w, state)
            if row < steps:
                add_stage_work(w, state, stage, h, tableau[stages, stage])
                advance(stage, h, semi_implicit, False, tableau, w.begin, w.stages, w.qdd, w.dz, w.q, w.v, w.z)
        commit_work(w)
    write_values(Row(rows[steps % kept], n), n, steps + 1, tally, values)
    return OK


@kernel_inlined
def desired(
    t: float, spacing: float, tables: IntArray, instants: int, columns: int, forces: Array, reference: Array
) -> None:
    """Write the reference of each run at t, an instant of the tables; see `closedloop.step.evaluate.reference_row`."""
    at = nearest_row(t, spacing, instants)
    width = reference.shape[0]
    first = matrix_at(tables[0], instants, columns)
    for j in range(width):
        reference[j] = first[at, j]
    for i in range(1, WIDE):
        if tables[i] != tables[0]:
            own = matrix_at(tables[i], instants, columns)
            for j in range(width):
                reference[j] = with_lane(reference[j], i, own[at, j])
    reference[width - 1] = forces[at]


@kernel_inlined
def press(H: Array, C: Array, w: Work, constants: Constants, t: float, sampled: bool) -> int:
    """Evaluate law, contact and Eq. 24 with the tip on a smooth surface; see `closedloop.step.evaluate.evaluate`."""
    locate_on_plane(w, constants)
    status = factorise(H, w.A, w.L, w.X, w.S, constants.reach)
    if status != OK:
        return status
    if sampled:
        paper_torque(C, w, constants, t)
    free_acceleration(w.L, w.X, w.drift_c, w.torque, C, w.y, w.a)
    w.b[0] = baumgarte_acceleration(constants.s_v, constants.s_p, w.rate, w.gap)
    if near_singular(w.S):
        return NEEDS_EVENTS
    status, w.stabiliser_force[0] = pressed_force(w.S, w.a, w.b[0], w.c, w.viscous, w.F)
    if status != OK:
        return status
    accelerate(w.L, w.X, w.y, w.F, w.qdd)
    return OK if bounded(w) else DIVERGED


def uses_lanes(scenario: Scenario, engine: str, runs: int) -> bool:
    """Whether a scenario is run in lanes, with others of its kind, in a batch of so many runs."""
    return engine == COMPILED and runs >= FEWEST and can_use_lanes(scenario)
