"""Several simulations of the same arm, stepped side by side from control instant to control instant."""

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, IntArray
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.jit.background import make_ready
from closedloop.jit.calls import address_of, entry_address
from closedloop.jit.simd8 import WIDE
from closedloop.loop.events.locate import FAILED, MEASURED, STEP_END, TERMS
from closedloop.loop.step.memory import Loop, Work
from closedloop.mechanics.closure.conditioning import BATCH
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.simulation.engines import loops
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.ensemble.lane_steps import Lanes, may_step_in_lanes, step_in_lanes
from closedloop.simulation.ensemble.member import BETWEEN, MEMBER, WAITING, Member, step_members, strike
from closedloop.simulation.loop_calls import Answers, drive, unwritten

# Rows that the window of a member has beside those that it must keep: it moves them once in so many.
SPARE = 64


class _One:
    """One simulation: what owns the memory that its `Member` has the addresses of; the next of its form has it too."""

    def __init__(self, problem: Problem, steps: int, held: bool, own: IntArray, into: Loop | None = None) -> None:
        self.loop = problem.memory(into=into)
        problem.connect(self.loop)
        self._before = unwritten(self.loop)
        self.answers = Answers(problem, self.loop)
        n, self._beside = problem.robot.n, steps + SPARE
        self._window = window = np.zeros((self._beside + BATCH, problem.row_width))
        H, C, scratch = loops.compiled_terms(loops.compiled_work(n), n)
        tableau = np.ascontiguousarray(problem.integrator.tableau())
        self.addresses = loops.addresses_of((H, C), self.loop, problem.table, tableau, window, self.answers.events)
        self.answers.addresses = self.addresses
        # The batch of condition numbers starts anew at each control instant; scratch is kept from no call to the next.
        w, sizes = self.loop.w, self.loop.w.sizes
        batch, after = Work.place("batch", *sizes), Work.place("z", *sizes)
        assert isinstance(batch, slice)
        assert isinstance(after, slice)
        memory = [self.loop.state.memory, w.memory[: batch.start], w.memory[after.start :], *self.loop.lasting_contacts]
        marks = [each.copy() for each in memory]
        reading = Work.place("sensing.measured", *sizes)
        assert isinstance(reading, int)
        copied = np.array(
            [(address_of(a), address_of(b), a.size) for a, b in zip(memory, marks, strict=True)], dtype=np.int64
        )
        boundary = np.zeros(2 * n + 3)
        own[:] = 0
        self.member = m = Member(own)
        m.addresses, m.scratch, m.scratch_size = address_of(self.addresses.memory), address_of(scratch), scratch.size
        m.copied, m.copied_count, m.boundary = address_of(copied), len(copied), address_of(boundary)
        m.held, m.steps, m.request = held, steps, TERMS
        m.reading = address_of(marks[2][reading - after.start :])
        m.keep_alive(scratch=scratch, copied=copied, marks=marks, boundary=boundary, H=H, C=C)
        self._fresh = own.copy()

    def begin(self, problem: Problem) -> None:
        """Go to the start of a problem that it fits."""
        self.problem, m, tree = problem, self.member, problem.robot.tree
        for array, before in self._before:
            array[...] = before
        problem.begin(self.loop)
        self.answers.begin(problem)
        lag = max(float(self.loop.constants.lag), float(np.max(self.loop.constants.joint_lag, initial=0.0)))
        keep = max(BATCH, int(lag / problem.h) + 3)  # rows before that a step may read or write
        if len(self._window) != keep + self._beside:
            self._window = np.empty((keep + self._beside, problem.row_width))
        self._window.fill(0.0)
        loops.set_rows(self.addresses, problem.table, self._window)
        loops.set_events(self.addresses, self.answers.events)
        self.addresses.row_count = problem.steps + 1  # the window stands for all of them, see `make_room`
        m.memory[:] = self._fresh
        m.window, m.room, m.keep = address_of(self._window), len(self._window), keep
        m.links, m.constants, m.constants_size = address_of(tree.links), address_of(tree.constants), tree.constants.size
        m.blocks, m.once, m.carrier, m.serial, m.balls = tree.blocks, tree.once, tree.carrier, tree.serial, tree.balls
        m.begins = MEASURED if self.loop.state.settings.encoder else STEP_END
        m.lanes = m.held and may_step_in_lanes(problem, self.loop.state, self.loop.constants, self.loop.w)
        # What an impact gives back is known before, unless it is of links or a user says it.
        if not problem.scenario.contact and problem.restitution.__module__.startswith("closedloop."):
            problem.set_restitution(self.loop)
            m.strike = entry_address(strike)
        m.keep_alive(tree=tree)


def _shares(count: int, threads: int) -> list[int]:
    """Return where the share of each thread begins, and the end: whole groups of `WIDE`, as far as there are."""
    groups = -(-count // WIDE)
    if groups < threads:
        return [count * k // threads for k in range(threads + 1)]
    return [min(WIDE * (groups * k // threads), count) for k in range(threads + 1)]


class Ensemble:
    """Simulations of the same arm that are stepped side by side, on several threads.

    `count`: how many.
    `steps`: steps between two control instants.
    `plan` (l, 3): what an action sets, see `closedloop.simulation.ensemble.member.act`.
    `numbers`: numbers of an action.
    `held`: whether torques from outside act in place of the scenarios' laws.
    `threads`: the results are the same, to the last bit, for any number.
    `rows`, (count, width) array: the recorded row of each at its control instant, see
        `closedloop.loop.step.record_row.Row`; without the condition number.
    `wanted`, (count, 2 n + 10) array: what is desired there, see `closedloop.loop.step.memory.Reference`.
    `between`, (count, BETWEEN) array: what happened since the control instant before, see
        `closedloop.simulation.ensemble.member.Between`.
    `actions`, (count, k) array: to be written before `step`, SI units.
    `failures`, `failed`, list, (count,) array of bool: why each could not go on, or None; and whether.
    """

    def __init__(
        self, count: int, steps: int, plan: IntArray, numbers: int, *, held: bool = False, threads: int = 1
    ) -> None:
        self.count, self.steps, self.threads = count, steps, max(1, min(threads, count))
        self._plan, self._held = plan, held
        self.actions: Array = np.zeros((count, numbers))
        self.between: Array = np.zeros((count, BETWEEN))
        self.failures: list[SimulationError | None] = [None] * count
        self.failed: NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)
        self._last: IntArray = np.zeros(count, dtype=np.int64)  # from the row of which there is a control instant more
        self._members: IntArray = np.zeros((count, MEMBER), dtype=np.int64)
        self._ones: list[_One | None] = [None] * count
        self._ready: set[Any] = set()  # kernels that are compiled
        self._pool: ThreadPoolExecutor | None = None
        self._process = os.getpid()  # that has the threads of the pool
        self._lanes: list[Lanes] = []
        self._groups: IntArray = np.zeros((self.threads, 2), dtype=np.int64)  # of each thread, see `step_members`
        self.rows: Array = np.zeros((count, 0))
        self.wanted: Array = np.zeros((count, 0))

    def begin(self, i: int, problem: Problem, own: bool = False) -> None:
        """Let simulation `i` be this problem's, before its first row; `start` records that.

        Its table, to which actions write, is `own`, or else copied: that of a cache may be another's next.

        Raises ScenarioError if a torque cannot act from outside, or the arm has another number of joints than the
            others.
        """
        if self._held:
            refuse_torque(problem)
        if self.rows.shape[1] == 0:
            self.rows = np.zeros((self.count, problem.row_width))
            self.wanted = np.zeros((self.count, 2 * problem.robot.n + 10))
        if self.rows.shape[1] != problem.row_width:
            raise ScenarioError(
                f"{problem.scenario.name}: its record has {problem.row_width} numbers a row, that of the others "
                f"{self.rows.shape[1]}: simulations that are stepped side by side must be of the same arm and contacts"
            )
        problem = problem if own else problem.with_table(problem.table.copy())
        one = self._ones[i]
        if one is None or not problem.fits(one.loop):
            one = self._ones[i] = _One(problem, self.steps, self._held, self._members[i], one.loop if one else None)
            self._make_ready(*loops.kernels_of(loops.COMPILED), step_members, strike, *problem.called(one.loop))
        one.begin(problem)
        if one.member.lanes:
            self._make_ready(step_in_lanes)
            self._forget_trees(problem)
        self.failures[i], self.failed[i] = None, False
        self._last[i] = problem.steps - self.steps

    def _make_ready(self, *called: Any) -> None:
        """Have kernels compiled, once."""
        if missing := {*called} - self._ready:
            make_ready(*missing)
            self._ready |= missing

    def _forget_trees(self, like: Problem) -> None:
        """Let the groups, which are made first if there are none, put in the constants of their arms anew."""
        if not self._lanes:
            arrays = {"everyone": self._members, "rows": self.rows, "wanted": self.wanted, "between": self.between}
            kinds = [mode for _ in range(self.threads) for mode in (PRESSED, STUCK)]
            self._lanes = [Lanes(like, mode, self.steps, arrays) for mode in kinds]
            self._groups[:] = np.reshape([each.address for each in self._lanes], self._groups.shape)
        for each in self._lanes:
            each.group.trees[:] = 0

    def problem(self, i: int) -> Problem:
        """Return the problem of simulation `i`."""
        one = self._ones[i]
        assert one is not None
        return one.problem

    def loop(self, i: int) -> Loop:
        """Return the loop's memory of simulation `i`."""
        one = self._ones[i]
        assert one is not None
        return one.loop

    def left(self, i: int) -> int:
        """Return how many more control instants simulation `i` has."""
        one = self._ones[i]
        assert one is not None
        return (one.problem.steps - int(one.member.target)) // self.steps

    def start(self, some: Iterable[int]) -> None:
        """Record the first row of these simulations."""
        self._go(some)

    def step(self, some: Sequence[int] | IntArray) -> None:
        """Step these simulations to their next control instant; their actions are in `actions`.

        One that cannot go on has its reason in `failures` from then on, and its rows are those of the instant before.

        Raises ValueError if one of them is at its end, or could not go on.
        """
        going = np.ascontiguousarray(some, dtype=np.int64)
        over = self.failed[going] | (self._members[going, Member.place("target")] > self._last[going])
        if over.any():
            raise ValueError(f"step: simulation {going[over][0]} is at its end, or could not go on")
        self._go(going)

    def _go(self, some: Iterable[int]) -> None:
        going = np.ascontiguousarray(some, dtype=np.int64)
        given, groups = (self.actions, self._plan, self.rows, self.wanted, self.between), self._groups
        count, members = len(going), self._members
        if self.threads > 1 and count > 1:
            parts = _shares(count, self.threads)
            pool = self._threads()
            running = [
                pool.submit(step_members, members, going, a, b, *given, own)
                for (a, b), own in zip(pairwise(parts[1:]), groups[1:], strict=True)
            ]
            try:
                step_members(members, going, 0, parts[1], *given, groups[0])
            finally:
                wait(running)
            for each in running:
                each.result()
        else:
            step_members(members, going, 0, count, *given, groups[0])
        for at in np.flatnonzero(members[going, Member.place("request")] != WAITING):
            self._answer(going[at : at + 1], (*given, groups[0]))

    def _answer(self, one: IntArray, given: tuple[Any, ...]) -> None:
        """Let one simulation go on that asks for something, until it is at its control instant or cannot."""
        i = int(one[0])
        asking = self._ones[i]
        assert asking is not None
        member, answers = asking.member, asking.answers

        def call(request: int) -> int:
            step_members(self._members, one, 0, 1, *given)
            return int(member.request)

        request = int(member.request)
        if request != FAILED:
            answers.give(request)
            request = drive(call, answers.give)
        if request == FAILED:
            self.failures[i], self.failed[i] = answers.failure("torque" if member.held else None, None), True

    def _threads(self) -> ThreadPoolExecutor:
        if self._pool is None or self._process != os.getpid():  # a fork has the pool, but none of its threads
            self._pool, self._process = ThreadPoolExecutor(self.threads - 1, "closedloop"), os.getpid()
        return self._pool

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self._pool = None


def refuse_torque(problem: Problem) -> None:
    """Refuse a scenario in which a torque from outside is not simply the torque on the joints."""
    state = problem.loop().state
    if state.settings.drives != 0:
        raise ScenarioError("drives: limits act on what a law asks for; leave [drives] out, or limit the actions")
    if problem.robot.model.loops:
        raise ScenarioError(f"{problem.robot.model.name} has loop joints: torques of an action act on trees only")
