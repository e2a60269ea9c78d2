"""A run of dual numbers: the loop of `closedloop.simulation.engines.loops` with a value and seven derivatives.

The memory of a prepared run is copied, eight numbers for each of its floats. Every float of it may have derivatives:
they are how a scenario's numbers enter a run, whichever they are.
"""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.jit.blocks import arrays_of
from closedloop.jit.calls import address_of, entry_address
from closedloop.jit.dual import NotDualError, dual, refused_as_one_line
from closedloop.jit.kernel import direct
from closedloop.jit.simd8 import WIDE, aligned
from closedloop.loop.events.locate import DONE, INITIAL_EVENTS, TABLE_FULL
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.memory import Constants, Loop, State, Work
from closedloop.mechanics.robot.tree import Tree
from closedloop.record.report.measures import CONTROL, Tally, Values, joint_limits
from closedloop.simulation.engines import loops
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import drive

# Directions of one run.
DIRECTIONS = WIDE - 1
# Differences of a coefficient of restitution take steps of this share of the speed.
OF_SPEED = 1e-3
# Its record and table may take so much memory, bytes.
MOST_BYTES = 1 << 30


class Prepared(NamedTuple):
    """A problem and its loop's memory at t = 0."""

    problem: Problem
    loop: Loop
    # all that the run reads or writes, in an order that is the same for every scenario with the same sections
    floats: list[Array]
    words: list[NDArray[np.int64]]  # the whole numbers of it, int64, among them addresses
    tree: Tree  # the robot, whose constants are among the floats


def prepared(problem: Problem) -> Prepared:
    """Return a problem with its loop's memory."""
    loop, tree = problem.loop(), problem.robot.tree
    floats: list[Array] = []
    words: list[NDArray[np.int64]] = []
    seen: set[int] = set()
    for array in arrays_of((loop.state, loop.constants, loop.w, problem.table, tree.constants)):
        if array.size and address_of(array) not in seen:
            seen.add(address_of(array))
            (words if array.dtype == np.int64 else floats).append(array)
    return Prepared(problem, loop, floats, words, tree)


def structure(base: Prepared) -> tuple[Any, ...]:
    """Return all that two runs must have in common of which one has derivatives along the way to the other."""
    arrays = (*base.floats, *base.words)
    places = {address_of(array): -1 - i for i, array in enumerate(arrays)}
    words = [tuple(places.get(word, word) for word in array.ravel().tolist()) for array in base.words]
    return *(array.shape for array in arrays), *words


class DualRun:
    """The memory of a run of dual numbers, and the run.

    `base`: the run.
    `seeds`: of each direction the derivatives of `base.floats`, None where there are none.
    `beside`: of each direction the problems on both sides, and how far off each is: a coefficient of restitution is
        found in Python, so its derivatives are differences.
    `rows`, (N, width, 8) array: the record, values and derivatives; residuals and condition numbers are NaN.
    `events`, (M, EVENT_WIDTH, 8) array: the table of events.
    `table`, (P, columns, 8) array: what is desired, see `closedloop.loop.step.entries`.
    Raises NotDualError if a kernel has no form of dual numbers, or there is not enough memory.
    """

    def __init__(
        self, base: Prepared, seeds: Sequence[Sequence[Array | None]],
        beside: Sequence[tuple[Problem, Problem, float]] = (),
    ) -> None:  # fmt: skip
        problem, n = base.problem, base.problem.robot.n
        if (wanted := 8 * WIDE * ((problem.steps + 1) * problem.row_width + problem.table.size)) > MOST_BYTES:
            raise NotDualError(f"its record would take {wanted / 1e9:.1f} GB")
        with refused_as_one_line():
            problem.connect(base.loop, form=dual)
        self._base, self._n, self._beside = base, n, beside
        self._wide = wide = [aligned(*array.shape) for array in base.floats]
        self._words = words = [array.copy() for array in base.words]
        self._moved = {
            address_of(a): address_of(b) for a, b in zip((*base.floats, *base.words), (*wide, *words), strict=True)
        }
        wide_of = {id(array): to for array, to in zip(base.floats, wide, strict=True)}
        loop = base.loop
        self._constants, self._work = wide_of[id(loop.constants.memory)], wide_of[id(loop.w.memory)]
        self._state = State(words[0])
        # What Python reads and writes between calls of the loop: the values.
        self._loop = Loop(
            self._state, Constants(self._constants[:, 0], *loop.constants.sizes), Work(self._work[:, 0], *loop.w.sizes)
        )
        table, tree = wide_of[id(problem.table)], base.tree
        constants = wide_of[id(tree.constants)]
        tableau = np.ascontiguousarray(problem.integrator.tableau())
        self.rows = aligned(problem.steps + 1, problem.row_width)
        self.events = aligned(INITIAL_EVENTS, EVENT_WIDTH)
        work = _widened(loops.compiled_work(n))
        self._addresses = a = loops.Addresses(np.zeros(loops.Addresses.count(), dtype=np.int64))
        a.H, a.C = address_of(work), address_of(work[n * n :])
        a.loop, a.table, a.tableau = address_of(words[0]), address_of(table), address_of(tableau)
        a.rows, a.n = address_of(self.rows), n
        a.instants, a.table_width = problem.table.shape
        a.row_count, a.row_width = self.rows.shape[:2]
        self._tree, self._tree_constants = tree, constants
        self._values, self._tally = aligned(Values.count(n)), aligned(Tally.count(n))
        self._signals, self._limits = aligned(CONTROL, problem.steps + 1), _widened(joint_limits(problem.robot.model))
        self._step = _widened(np.array([problem.h]))
        self._parts = p = loops.Parts(np.zeros(loops.Parts.count(), dtype=np.int64))
        p.constants, p.constants_size, p.scratch = address_of(constants), tree.constants.size, address_of(work)
        p.tally, p.values, p.signals = map(address_of, (self._tally, self._values, self._signals))
        p.limits, p.step = address_of(self._limits), address_of(self._step)
        self.table = table
        self._kept_too = tableau, work
        self.begin(seeds)

    def begin(self, seeds: Sequence[Sequence[Array | None]]) -> None:
        """Go back to the start, with other derivatives."""
        for i, (array, to) in enumerate(zip(self._base.floats, self._wide, strict=True)):
            to[..., 0] = array
            to[..., 1:] = 0.0
            for lane, parts in enumerate(seeds, 1):
                part = parts[i]
                if part is not None:
                    to[..., lane] = part
        for given, words in zip(self._base.words, self._words, strict=True):
            words.reshape(-1)[:] = [self._moved.get(word, word) for word in given.ravel().tolist()]
        self._varied = bool(np.any(self._tree_constants[:, 1:]))
        self._set_events()

    def _set_events(self) -> None:
        self._addresses.events, self._addresses.event_room = address_of(self.events), len(self.events)

    def run(self) -> bool:
        """Run to the end; False if something stops it."""
        at, parts = address_of(self._addresses.memory), address_of(self._parts.memory)
        kernel, pace = dual(loops.run_varied_at if self._varied else loops.run_at), loops.Pace()

        def call(request: int) -> int:
            with refused_as_one_line():
                return pace.take(lambda evaluations: kernel(self._tree, parts, at, evaluations))

        done = drive(call, self._give) == DONE
        if done:
            self.events = self.events[: int(self._state.event.rows)]
        return done

    def _give(self, request: int) -> None:
        if request == TABLE_FULL:
            more = aligned(2 * len(self.events), EVENT_WIDTH)
            more[: len(self.events)] = self.events
            self.events = more
            self._set_events()
        else:
            self._collide()

    def _collide(self) -> None:
        problem, loop = self._base.problem, self._loop
        problem.set_restitution(loop)
        coefficient = self._constants[Constants.place("restitution", *loop.constants.sizes)]
        of_speed = self._work[Work.place("impact.before", *loop.w.sizes)][0]
        speed = -float(of_speed[0])
        change = OF_SPEED * speed
        slope = 0.0
        if change > 0.0:
            wide, near = (
                (problem.restitution_at(loop, speed + h) - problem.restitution_at(loop, speed - h)) / (2.0 * h)
                for h in (change, 0.5 * change)
            )
            slope = (4.0 * near - wide) / 3.0
        coefficient[1:] = -slope * of_speed[1:]
        for lane, (minus, plus, h) in enumerate(self._beside, 1):
            coefficient[lane] += (plus.restitution_at(loop, speed) - minus.restitution_at(loop, speed)) / (2.0 * h)
        dual(collide)(int(self._state.address))

    def values(self) -> Array:
        """Return the values of the summary and their derivatives, (K, 8), see `closedloop.record.report.measures`."""
        dual(loops.measure_at)(
            self._tree, address_of(self._parts.memory), address_of(self._addresses.memory), self._base.problem.nodes,
            len(self.rows),
        )  # fmt: skip
        return self._values


def _widened(array: Array) -> Array:
    """Return numbers as dual numbers without derivatives."""
    wide = aligned(*array.shape)
    wide[..., 0] = array
    return wide


def kernels(base: Prepared, varied: bool = False) -> list[Any]:
    """Return the kernels of dual numbers that a run needs, those for the values of its summary included.

    `varied` says whether the constants of the robot have derivatives.
    """
    found = [loops.run_varied_at if varied else loops.run_at, loops.proceed_at, loops.measure_at]
    if base.loop.state.settings.unilateral or base.loop.state.contacts.at:
        found.append(collide)
    return [dual(each) for each in (*found, *base.problem.called(base.loop))]


def compile_for(base: Prepared, names: Collection[str]) -> None:
    """Compile those of the kernels that a run needs that have these names."""
    integers: dict[Any, tuple[Any, ...]] = {
        loops.run_at: (base.tree, 0, 0, 0), loops.run_varied_at: (base.tree, 0, 0, 0),
        loops.measure_at: (base.tree, 0, 0, 0, 0), collide: (0,),
    }  # fmt: skip
    for kernel, arguments in integers.items():
        if dual(kernel).__name__ in names:
            direct(dual(kernel), *arguments)
    for kernel in (loops.proceed_at, *base.problem.called(base.loop)):
        if dual(kernel).__name__ in names:
            entry_address(dual(kernel))
