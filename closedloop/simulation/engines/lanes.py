"""Eight runs at a time in SIMD lanes, and their loop.

They are runs of a batch with the paper's law. The loop calls the kernels of a single run, in the order of
`closedloop.loop.events` without events, in float64x8 (`closedloop.jit.simd8`): eight runs take each step together, with
the same result to the last bit. The tips may be free, slide or stick (`closedloop.simulation.engines.lane_contact`). A
run of which one may not say that nothing happens in a step takes that step by itself
(`closedloop.simulation.engines.lane_contact`). The summary of a run is accumulated row by row
(`closedloop.record.report.measures`); the rows are kept only on request.

If one of the eight cannot go on, the loop returns a status, and each of the eight is run by itself.
"""

from typing import Any, NamedTuple, cast

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.control.reference.desired import Reference
from closedloop.jit.background import make_ready
from closedloop.jit.blocks import Block
from closedloop.jit.calls import address_of, entry_address, integers_at, matrix_at, vector_at
from closedloop.jit.inside.simd8 import float64x8_at, lane, with_lane
from closedloop.jit.kernel import entry_kernel, jit_disabled, kernel_inlined, plain
from closedloop.jit.simd8 import WIDE, aligned, every
from closedloop.loop.events.locate import INITIAL_EVENTS
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.advance import advance
from closedloop.loop.step.energy_supplied import add_stage_work, commit_work, save_power
from closedloop.loop.step.entries import nearest_row
from closedloop.loop.step.evaluate import bounded, paper_torque
from closedloop.loop.step.memory import Constants, Loop, State, Work
from closedloop.loop.step.record_row import Row, keep_condition, record_conditions
from closedloop.mechanics.closure.conditioning import BATCH, LONG_ARM
from closedloop.mechanics.closure.contact_force import PRESSED, accelerate, factorise, free_acceleration
from closedloop.mechanics.closure.solve import DIVERGED, OK
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import Tree, energy_there, tree_terms, work_size
from closedloop.record.report.measures import (
    CONTROL,
    JointLimits,
    Tally,
    Values,
    begin_tally,
    count_condition,
    count_events,
    count_row,
    joint_limits,
    write_control,
    write_values,
)
from closedloop.scenario.arm import has_stops
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.lane_contact import (
    ALONE,
    WINDOW,
    Alone,
    Kept,
    alone_at,
    first_of,
    go_alone,
    hold_tips,
    keep_start,
    locate_tips,
    passed_rows,
    take_row,
    write_rows,
)
from closedloop.simulation.engines.loops import (
    COMPILED,
    Addresses,
    addresses_of,
    compiled_terms,
    compiled_work,
    set_rows,
)
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.scenario_numbers import asks_for_more, is_no_papers_law
from closedloop.simulation.ensemble.member import strike

# Status: a run could not go on by itself, or one of those that never do is near a singular pose.
NEEDS_EVENTS = -1


# Of each row for `closedloop.record.report.control_verdict`: f − f_des, and the tip less its path along both tangents.
SIGNALS = 3


class Worst(Block):
    """Of all rows, for a first look at the control: `closedloop.simulation.batch.worker`."""

    miss: float  # largest |f − f_des| of the later half, N
    off_squared: float  # of the tip off its path along the surface, m²
    least: float  # f_des, N
    wanted_squared: float  # the sum of f_des² over the rows, N²
    lowest: float  # the path along the normal, least until now, m
    rise: float  # and the most that it then rose from there, m


# What is the worse for the control the less it is.
_LEAST_OF = [cast(int, Worst.place(name)) for name in ("least", "wanted_squared")]


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
    before: int
    members: int  # of the addresses of each lane's `Alone`; 0: they have none, as nothing can happen to them
    scratch: int  # of the terms of one run


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

    `tree`: their robot.
    `addresses`: memory of `LaneAddresses`.
    `state_numbers`: see `closedloop.loop.step.memory`; the same for all.
    `h`: step, s.
    `tableau` (S + 1, S): see `closedloop.mechanics.integrators.Scheme.tableau`.
    `tables` (8,): addresses of the reference table of each run, see `closedloop.loop.step.entries`.
    `sizes`: of the arrays in memory.
    `limits` (4 n,): see `closedloop.record.report.measures.joint_limits`.
    """
    n, state, width = tree.n, State(state_numbers), sizes.width
    ends = integers_at(state.addresses.group_ends, state.n)
    stages, steps, hold = state.settings.stages, state.settings.steps, state.settings.hold
    semi_implicit = state.settings.semi_implicit != 0
    at = LaneAddresses(addresses)
    w, kept = Work(float64x8_at(at.work, 0), n, 0, stages, 1, 0), Kept(float64x8_at(at.before, 0), n)
    terms = float64x8_at(at.terms, n * n + n + work_size(n))
    H, C, scratch = terms[0 : n * n].reshape(n, n), terms[n * n : n * n + n], terms[n * n + n :]
    largest = float64x8_at(at.largest, 1)[0]
    constants = Constants(
        float64x8_at(at.constants, 0), n, state.law.size, state.compensation.size, state.friction.size,
        state.joint_friction.size, state.compliance.size, 0,
    )  # fmt: skip
    forces = float64x8_at(at.forces, sizes.instants)
    rows = float64x8_at(at.rows, sizes.kept * width).reshape(sizes.kept, width)
    tally, values = Tally(float64x8_at(at.tallies, 0), n), Values(float64x8_at(at.values, 0), n)
    joint_limits, wanted = JointLimits(limits, n), w.reference
    signals = float64x8_at(at.signals, (steps + 1) * SIGNALS).reshape(steps + 1, SIGNALS)
    control = float64x8_at(at.signals, CONTROL * (steps + 1)).reshape(CONTROL, steps + 1)
    worst, members, many = Worst(float64x8_at(at.worst, 0)), integers_at(at.members, WIDE), at.members != 0
    of_one = vector_at(at.scratch, work_size(n))
    begin_tally(tally, h, largest)
    w.supply.energy = 0.0
    kept.mode = 1.0 * PRESSED
    for i in range(WIDE if many else 0):
        if first_of(members, i) and not go_alone(tree, of_one, w, kept, members, forces, h, i, 0):
            return NEEDS_EVENTS
    for row in range(steps + 1):
        begin, slot = row * h, row % sizes.kept
        leaving = 0  # a bit for each lane whose run takes this step by itself
        for stage in range(stages if row < steps else 1):
            node = 0.0
            for i in range(stage):
                node += tableau[stage, i]
            t, evaluated = begin + node * h, False
            sampled = hold == 0 or (stage == 0 and row % hold == 0)
            while not evaluated:
                evaluated = True
                tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
                desired(t, h / sizes.nodes, tables, sizes, forces, wanted)
                status, stays = press(H, C, w, constants, state, kept, members, t, sampled, ends, h)
                if not many:
                    if status != OK:
                        return status
                    if not every(stays > 0.5):
                        return NEEDS_EVENTS
                elif stage == 0:
                    leaving, stays = 0, min(stays, passed_rows(w, constants, state, kept, h))
                    for i in range(WIDE):
                        if lane(stays, i) < 0.5 and first_of(members, i):
                            if alone_at(members, i)[0].row == row:
                                leaving |= 1 << i
                            elif go_alone(tree, of_one, w, kept, members, forces, h, i, row):
                                evaluated = False
                            else:
                                return NEEDS_EVENTS
                else:
                    for i in range(WIDE):
                        leaving |= 1 << i if lane(stays, i) < 0.5 and first_of(members, i) else 0
            if stage == 0:
                here = Row(rows[slot], n)
                closed = write_rows(H, C, w, state, kept, here)
                save_power(w, state)
                for i in range(WIDE if many else 0):
                    take_row(w, members, here, i, row)
                keep_condition(H, w, state, closed, here, rows, slot)
                potential = energy_there(tree, w.q, scratch)
                if many:
                    write_control(here, wanted, control, row)
                else:
                    write_signals(w, wanted, signals, row, worst)
                count_row(here, n, potential, wanted, joint_limits, row, tally)
                if row == steps:
                    record_conditions(w.batch, rows, state, slot + 1, n)
                if state.batched == 0:
                    for i in range(slot - slot % BATCH, slot + 1):
                        count_condition(Row(rows[i], n), tally)
                for j in range(n):
                    w.start.state[j] = w.q[j]
                    w.start.state[n + j] = w.v[j]
                if many:
                    keep_start(w, kept, members, state)
            if row < steps:
                add_stage_work(w, state, stage, h, tableau[stages, stage])
                advance(stage, h, semi_implicit, False, tableau, w)
        commit_work(w)
        for i in range(WIDE if row < steps and leaving != 0 else 0):
            if leaving & (1 << i) != 0 and not go_alone(tree, of_one, w, kept, members, forces, h, i, row + 1):
                return NEEDS_EVENTS
    write_values(Row(rows[steps % sizes.kept], n), n, steps + 1, tally, values)
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
def press(
    H: Array, C: Array, w: Work, constants: Constants, state: State, kept: Kept, members: IntArray, t: float,
    sampled: bool, ends: IntArray, h: float,
) -> tuple[int, Array]:  # fmt: skip
    """Evaluate law, contact and Eq. 24; return a status, and for each lane 1 if the evaluation is that of its run.

    See `closedloop.loop.step.evaluate.evaluate`.
    """
    stays = locate_tips(w, constants, members, state.surface.entry != 0, t, h)
    status = factorise(H, w.tip.A, w.L, w.tip.X, w.tip.S, constants.reach, ends)
    if status == OK:
        if sampled:
            paper_torque(C, w, constants, t)
        free_acceleration(w.L, w.tip.X, w.tip.drift_c, w.torque, C, w.y, w.tip.a, ends)
        status, goes_on = hold_tips(w, constants, state, kept, members, h)
        stays = min(stays, goes_on)
    if status == OK:
        accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, ends)
        if not bounded(w):
            status = DIVERGED
    return status, stays if status == OK else 0.0 * stays


# Eight runs in lanes take as long as two by themselves; fewer than this many are run one by one.
FEWEST = 3


def can_use_lanes(scenario: Scenario) -> bool:
    """Whether a scenario may run in lanes: the paper's law, and one tip with or without a surface that ships."""
    return not is_no_papers_law(scenario.law) and _but_for_the_law(scenario)


def _but_for_the_law(scenario: Scenario) -> bool:
    """Whether all but its law lets a scenario run in lanes."""
    members: tuple[Any, ...] = scenario.friction, scenario.compliance, scenario.surface, scenario.surface_motion
    smooth = scenario.friction.kind == "none"
    return (
        not jit_disabled()
        and scenario.has_surface
        and scenario.tool.radius == 0.0
        and scenario.stabiliser.kind in ("baumgarte", "none")
        and scenario.time.integrator in INTEGRATORS
        and not INTEGRATORS[scenario.time.integrator].time_stepping
        and (smooth or scenario.friction.sticks == "rigid")
        and all(type(each).__module__.startswith("closedloop.") for each in members)
        and not asks_for_more(scenario if smooth else scenario.model_copy(update={"friction": NoFriction()}))
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
    members: tuple[type, ...]  # of friction, a soft surface, the surface and its motion
    many: bool  # whether something may happen to a run, so that it may have to go by itself


def kind_of(problem: Problem) -> Kind | None:
    """Return what a run must have in common with the others in its lanes; None for one that cannot use lanes."""
    scenario, robot = problem.scenario, problem.robot
    members = scenario.friction, scenario.compliance, scenario.surface, scenario.surface_motion
    law = problem.restitution
    if (
        not problem.papers_law
        or not _but_for_the_law(scenario)
        or robot.model.loops
        or robot.model.balls
        or len(robot.model.undriven)
        or has_stops(scenario, robot.model)
        or not law.__module__.startswith("closedloop.")
        or problem.project
    ):
        return None
    simple = problem.there.fixed_plane and not any(each.kind != "none" for each in members[:2])
    many = not simple or scenario.surface.contact == "unilateral"
    if many and robot.n > LONG_ARM:
        return None
    return Kind(
        scenario.surface.contact, scenario.time.integrator, robot, problem.steps, problem.h, problem.nodes,
        problem.hold, tuple(type(each) for each in members), many,
    )  # fmt: skip


class LaneMember:
    """The memory of one run of a set of lanes, where it goes by itself: see `Alone`.

    `terms`: H (n, n) and C (n,), which the runs have in common.
    `width`: numbers in a row.
    `problem`, `loop`: of the latest run.
    `window` (WINDOW, width): its first row, and its two latest.
    `address`: of the `Alone`.
    """

    problem: Problem

    def __init__(self, terms: tuple[Array, Array], width: int) -> None:
        self._terms, self.window = terms, np.zeros((WINDOW, width))
        self._events = np.zeros((INITIAL_EVENTS, EVENT_WIDTH))
        self._alone = Alone(np.zeros(ALONE, dtype=np.int64))
        self._alone.window, self.address = address_of(self.window), address_of(self._alone.memory)
        self.loop: Loop | None = None
        self._of_loop: Addresses | None = None

    def begin(self, problem: Problem) -> Loop:
        """Stand at the start of a problem, and return the memory of its loop."""
        before, self.problem = self.loop, problem
        self.loop = loop = problem.loop(into=before)
        if before is None:
            make_ready(*problem.called(loop))
        problem.connect(loop)
        if loop.state.settings.unilateral != 0:
            problem.set_restitution(loop)
        if before is None or before.w is not loop.w or self._of_loop is None:
            arrays = problem.table, problem.integrator.tableau(), self.window
            self._of_loop = addresses_of(self._terms, loop, *arrays, self._events)
            self._of_loop.row_count = problem.steps + 1
        set_rows(self._of_loop, problem.table, self.window)
        self._alone.addresses, self._alone.strike = address_of(self._of_loop.memory), entry_address(strike)
        self._alone.row, self._alone.stands = -1, 1
        return loop

    @property
    def told(self) -> Array:
        """The table of events (E, EVENT_WIDTH) of the run."""
        assert self.loop is not None
        return self._events[: self.loop.state.event.rows]


class LaneRuns:
    """Memory for eight runs of one kind; see `kind_of`.

    `like`: one of the runs, for the sizes.
    `keep`: whether all rows are kept.
    `kind`, Kind: the kind of all eight.
    `n`, int: joints.
    `end`, float: instant of the last row, s.
    """

    def __init__(self, like: Problem, kind: Kind, keep: bool) -> None:
        n, stages = like.robot.n, like.integrator.stages
        self.kind, self.n, self.end = kind, n, like.h * like.steps
        self._loop = loop = like.loop()
        self._state, self._tableau, self._one = loop.state, like.integrator.tableau(), loop.constants
        self._h = like.h
        self._work = Work(aligned(Work.count(n, 0, stages, 1, 0)), n, 0, stages, 1, 0)
        self._constants = aligned(loop.constants.memory.size)
        self._forces, self._largest = aligned(like.table.shape[0]), aligned(1)
        self._rows = aligned(like.steps + 1 if keep else BATCH, Row.count(n))
        (instants, columns), (kept, width) = like.table.shape, self._rows.shape[:2]
        self._sizes = Sizes(like.nodes, instants, columns, kept, width)
        self._values = aligned(Values.count(n))
        self._signals = aligned(CONTROL, like.steps + 1) if kind.many else aligned(like.steps + 1, SIGNALS)
        self._worst = aligned(Worst.count())
        self._limits, self._scratch = joint_limits(like.robot.model), compiled_work(n)
        self._parts = {
            "work": self._work.memory, "terms": aligned(n * n + n + plain(work_size)(n)), "constants": self._constants,
            "forces": self._forces, "largest": self._largest, "rows": self._rows, "tallies": aligned(Tally.count(n)),
            "values": self._values, "signals": self._signals, "worst": self._worst, "before": aligned(Kept.count(n)),
        }  # fmt: skip
        self._addresses = LaneAddresses(np.zeros(LaneAddresses.count(), dtype=np.int64))
        for name, part in self._parts.items():
            setattr(self._addresses, name, address_of(part))
        H, C, scratch = compiled_terms(self._scratch, n)
        self._addresses.scratch = address_of(scratch)
        self._members = [LaneMember((H, C), width) for _ in range(WIDE if kind.many else 0)]
        self._alone = np.zeros(WIDE, dtype=np.int64)
        self._addresses.members = address_of(self._alone) if kind.many else 0
        self._tables: list[Array] = []
        self._given: list[Array] = []  # the force of each

    @property
    def bytes(self) -> int:
        """Return the size of the memory, bytes."""
        return sum(part.nbytes for part in self._parts.values())

    def put(self, lane: int, problem: Problem) -> None:
        """Load a problem into a lane; afterwards the table's forces and noise may be overwritten."""
        if lane == 0:
            self._tables, self._given = [], []
        loop = self._members[lane].begin(problem) if self.kind.many else None
        constants = problem.constants(self._one) if loop is None else loop.constants
        self._constants[:, lane] = constants.memory
        self._work.q[:, lane], self._work.v[:, lane] = problem.q, problem.v
        self._work.tip.frame[..., lane] = problem.frame
        self._given.append(problem.forces)
        self._tables.append(problem.bare_table)
        if loop is not None and lane == 0:
            self._state.memory[:] = loop.state.memory

    def run(self, count: int) -> bool:
        """Run the first `count` lanes; False if one of them could not be finished here."""
        self._forces[:, :count] = np.transpose(self._given[:count])
        if self.kind.many:
            self._forces += 0.0  # as the law is told it where it is asked by address
        self._largest[0, :count] = np.abs(self._forces[:: self._sizes.nodes, :count]).max(axis=0)
        for part in (self._constants, self._forces, self._largest, self._work.q, self._work.v, self._work.tip.frame):
            part[..., count:] = part[..., :1]  # unused lanes repeat the first
        addresses = [address_of(table) for table in self._tables[:count]]
        tables = np.array(addresses + addresses[:1] * (WIDE - count))
        self._state.batched = 0
        if self.kind.many:
            self._alone[:] = [self._members[i if i < count else 0].address for i in range(WIDE)]
        make_ready(run_in_lanes)
        status = run_in_lanes(
            self.kind.robot.tree,
            self._addresses.memory,
            self._state.memory,
            self._h,
            self._tableau,
            tables,
            self._sizes,
            self._limits,
        )
        return status == OK

    def values(self, count: int) -> Array:
        """Return the values of the first `count` runs' summaries, (count, W): `closedloop.record.report.measures`."""
        values = self._values[:, :count].T.copy()
        for own, member in zip(values, self._members, strict=False):
            plain(count_events)(member.told, Values(own, self.n))
        return values

    def by_itself(self, lane: int) -> tuple[Problem, Row, Array, Array]:
        """Return the problem of a lane, the first row of its run by itself, its signals (CONTROL, N), see
        `write_control`, and its table of events."""
        member = self._members[lane]
        return member.problem, Row(member.window[0], self.n), self._signals[:, :, lane], member.told

    def worst(self, lanes: slice) -> Worst:
        """Return what a first look at the control goes by: the worst of these runs."""
        some = self._worst[:, lanes]
        found = Worst(some.max(axis=1))
        found.least, found.wanted_squared = some[_LEAST_OF].min(axis=1)
        return found

    def miss(self, lane: int) -> Array:
        """Return f − f_des, (N,)."""
        return self._signals[:, 0, lane].copy()

    def signals(self, lane: int) -> tuple[Array, Array, tuple[Array, Array, Array]]:
        """Return f_des and f, (N,), and of the path what `closedloop.record.report.control_verdict.signals_of` takes.

        That is the tip less its path along the surface, (N, 3), the path along the normal, (N,), and the path, (N, 3).
        """
        n, nodes, frame = self.n, self._sizes.nodes, self._work.tip.frame[..., lane].copy()
        wanted, own = self._forces[::nodes, lane].copy(), self._signals[:, :, lane].T.copy()
        path = self._tables[lane][::nodes, Reference.place("position", n)]
        return wanted, wanted + own[0], (own[1:].T @ frame[1:], path @ frame[0], path)

    def rows(self, lane: int) -> Array:
        """Return the rows of a run, if they were kept; the next run overwrites them."""
        return self._rows[:, :, lane]


def uses_lanes(scenario: Scenario, engine: str, runs: int) -> bool:
    """Whether a scenario is run in lanes, with others of its kind, in a batch of so many runs."""
    return engine == COMPILED and runs >= FEWEST and can_use_lanes(scenario)
