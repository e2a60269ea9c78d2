"""The two engines: the loop of each, compiled once, and how many evaluations it does before Ctrl-C can have its effect.

`closedloop.loop.events.proceed` requests terms and does everything else. The Pinocchio engine calls it from Python with
the results of Pinocchio's two passes, the compiled engine by its address with terms of our own, from
`closedloop.mechanics.robot.tree`. So the two engines differ only in the source of H, C, Jᵣ, r and J̇ᵣq̇. The compiled
loop runs without the interpreter and its lock, so the runs of a batch are parallel in threads. A loop takes any number
of joints and any laws. In a batch, runs of the paper's law on a smooth surface go eight at a time in SIMD lanes instead
(`closedloop.simulation.engines.lanes`).

Python has no arrays of dual numbers (`closedloop.jit.dual8`), only their memory, so entries for them take all arrays by
address. Of these entries only the form of dual numbers is compiled. The arrays are those of the entries that they stand
for: `run_compiled` and `closedloop.record.report.measures.measure_rows`.
"""

import time as clock
from collections.abc import Callable

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.calls import address_of, call_at, fortran_at, integers_at, known_matrix_at, matrix_at, vector_at
from closedloop.jit.kernel import brief_entry, entry_kernel, kernel_inlined, plain
from closedloop.loop.events.locate import TERMS
from closedloop.loop.events.proceed import proceed
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.memory import Loop, loop_at
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tip import tip_kinematics
from closedloop.mechanics.robot.tree import Tree, tree_terms, work_size
from closedloop.record.report.measures import CONTROL, measure

# Where Jᵣ, r and J̇ᵣq̇ come from: they are in the loop's memory, or follow from Pinocchio's data.
IN_MEMORY, FROM_PINOCCHIO = range(2)


class Addresses(Block):
    """Addresses and sizes of the arrays of a run: what `proceed_at` takes the address of."""

    H: int
    C: int
    jacobian: int
    rotation: int
    origin: int
    velocity: int
    acceleration: int
    loop: int
    table: int
    tableau: int
    rows: int
    events: int
    n: int
    instants: int
    table_width: int
    row_count: int
    row_width: int
    event_room: int


ADDRESSES = Addresses.count()
VIEWS = 7  # of Pinocchio's data, H and C first


def addresses_of(
    terms: tuple[Array, ...], loop: Loop, table: Array, tableau: Array, rows: Array, events: Array
) -> Addresses:
    """Return the addresses of the arrays of a run, which it keeps.

    `terms`: H (n, n), column after column, and C (n,); for `FROM_PINOCCHIO` the 7 views of
        `closedloop.mechanics.robot.pinocchio.Robot.views`.
    `loop`, `table`, `tableau`, `rows`, `events`: see `proceed`. When `events` is replaced, so must be its address and
        its length; see `set_events`.
    """
    H, _, *more = terms
    for array in (*terms, table, tableau, rows, events):
        columns_first = array is H or any(array is other for other in more[:2])  # Eigen's storage order
        assert array.flags.f_contiguous if columns_first else array.flags.c_contiguous
    sizes = H.shape[0], 0, 0, 0, 0, 0
    missing = (0,) * (VIEWS - len(terms))
    at = (*map(address_of, terms), *missing, loop.address, 0, address_of(tableau), 0, 0)
    addresses = Addresses(np.array([*at, *sizes], dtype=np.int64))
    addresses.keep_alive(terms=terms, loop=loop, tableau=tableau)
    set_rows(addresses, table, rows)
    set_events(addresses, events)
    return addresses


def set_rows(addresses: Addresses, table: Array, rows: Array) -> None:
    """Store the addresses and the sizes of the table of what is desired, and of the rows."""
    addresses.table, addresses.rows = address_of(table), address_of(rows)
    (addresses.instants, addresses.table_width), (addresses.row_count, addresses.row_width) = table.shape, rows.shape
    addresses.keep_alive(table=table, rows=rows)


def set_events(addresses: Addresses, events: Array) -> None:
    """Store the address and the length of the table of events (M, EVENT_WIDTH)."""
    addresses.events, addresses.event_room = address_of(events), events.shape[0]
    addresses.keep_alive(events=events)


@kernel_inlined
def tip_from_pinocchio(a: Addresses) -> None:
    """Write Jᵣ, r and J̇ᵣq̇ from the results of `pinocchio.crba` and `pinocchio.nonLinearEffects` in Pinocchio's data."""
    _, constants, w = loop_at(a.loop)
    link = fortran_at(a.rotation, 3, 3), vector_at(a.origin, 3), vector_at(a.velocity, 6), vector_at(a.acceleration, 6)
    tip_kinematics(
        fortran_at(a.jacobian, 6, a.n), link, constants.tip, constants.gravity, constants.support, w.J, w.r, w.drift
    )


@brief_entry
def proceed_at(address: int, source: int) -> int:
    """Do `proceed` with the arrays of a run, and return its request.

    `address`: of the memory of what `addresses_of` returned.
    `source`: IN_MEMORY or FROM_PINOCCHIO.
    """
    a = Addresses(integers_at(address, ADDRESSES))
    if source == FROM_PINOCCHIO:
        tip_from_pinocchio(a)
    n = a.n
    state, constants, w = loop_at(a.loop)
    stages = state.settings.stages
    return proceed(
        fortran_at(a.H, n, n), vector_at(a.C, n), w, constants, state, matrix_at(a.table, a.instants, a.table_width),
        known_matrix_at(a.tableau, stages + 1, stages), matrix_at(a.rows, a.row_count, a.row_width),
        matrix_at(a.events, a.event_room, EVENT_WIDTH),
    )  # fmt: skip


@entry_kernel
def run_compiled(tree: Tree, scratch: Array, address: int, most: int) -> int:
    """Run until something other than terms is requested, and return the request; see `closedloop.loop.events.proceed`.

    After `most` evaluations, at least one, it returns in any case. The address is that of the memory of
    `closedloop.simulation.engines.loops.Addresses`, of H and C in `compiled_terms`.
    """
    return provide_terms(tree, scratch, address, most)


@kernel_inlined
def provide_terms(tree: Tree, scratch: Array, address: int, most: int) -> int:
    """Do as `run_compiled`."""
    a, n = Addresses(integers_at(address, ADDRESSES)), tree.n
    H, C = fortran_at(a.H, n, n), vector_at(a.C, n)
    state, _, w = loop_at(a.loop)
    request, evaluations = TERMS, 0
    while request == TERMS and evaluations < most:
        evaluations += 1
        tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
        request = call_at(state.proceed, address, IN_MEMORY)
    return request


def compiled_work(n: int) -> Array:
    """Return the scratch array of `run_compiled` for n joints, with room for H and C before it."""
    return np.zeros(n * n + n + plain(work_size)(n))


def compiled_terms(work: Array, n: int) -> tuple[Array, Array, Array]:
    """Return H (n, n), column after column, C (n,) and the scratch array of `run_compiled` in `compiled_work`."""
    return work[: n * n].reshape(n, n).T, work[n * n : n * n + n], work[n * n + n :]


def compiled_tree(robot: Robot) -> Tree:
    """Return a robot as the compiled engine's arrays."""
    return robot.tree


class Parts(Block):
    """Addresses and sizes of what `Addresses` of the run does not have."""

    constants: int  # of the tree
    constants_size: int
    scratch: int  # of the terms, with room for H and C before it, see `compiled_work`
    tally: int
    values: int
    signals: int
    limits: int  # see `closedloop.record.report.measures.joint_limits`
    step: int  # the step, one number, s


PARTS = Parts.count()


@kernel_inlined
def tree_with(tree: Tree, parts: Parts) -> Tree:
    """Return the robot, its constants read from an address: with the derivatives that they may have."""
    return Tree(
        tree.n, tree.blocks, tree.once, tree.carrier, tree.serial, tree.links,
        vector_at(parts.constants, parts.constants_size), tree.balls,
    )  # fmt: skip


@entry_kernel
def run_at(tree: Tree, parts_at: int, address: int, most: int) -> int:
    """Do as `run_compiled`, of a robot whose constants have no derivatives."""
    parts, first = Parts(integers_at(parts_at, PARTS)), tree.n * tree.n + tree.n
    scratch = vector_at(parts.scratch, first + work_size(tree.n))[first:]
    return provide_terms(tree, scratch, address, most)


@entry_kernel
def run_varied_at(tree: Tree, parts_at: int, address: int, most: int) -> int:
    """Do as `run_compiled`, of a robot whose constants have derivatives."""
    parts, first = Parts(integers_at(parts_at, PARTS)), tree.n * tree.n + tree.n
    scratch = vector_at(parts.scratch, first + work_size(tree.n))[first:]
    return provide_terms(tree_with(tree, parts), scratch, address, most)


@entry_kernel
def measure_at(tree: Tree, parts_at: int, address: int, nodes: int, done: int) -> None:
    """Do as `measure_rows` with the first `done` rows; `nodes` of the table are to each of them."""
    a, parts, n = Addresses(integers_at(address, ADDRESSES)), Parts(integers_at(parts_at, PARTS)), tree.n
    state, _, _ = loop_at(a.loop)
    terms, tally = vector_at(parts.scratch, n * n + n + work_size(n)), vector_at(parts.tally, 0)
    table = matrix_at(a.table, a.instants, a.table_width)
    measure(
        tree_with(tree, parts), (terms, tally), matrix_at(a.rows, done, a.row_width),
        (table, nodes), vector_at(parts.step, 1)[0], vector_at(parts.limits, 4 * n),
        matrix_at(a.events, state.event.rows, EVENT_WIDTH), vector_at(parts.values, 0),
        matrix_at(parts.signals, CONTROL, done),
    )  # fmt: skip


PINOCCHIO, COMPILED = ENGINES = ("pinocchio", "compiled")


def loop_for(engine: str) -> Callable[..., int]:
    """Return the loop of an engine, see `closedloop.simulate`: what Python calls."""
    return kernels_of(engine)[0]


def kernels_of(engine: str) -> tuple[Callable[..., int], ...]:
    """Return the loop of an engine, and what it calls."""
    return (run_compiled, proceed_at) if engine == COMPILED else (proceed_at,)


# Evaluations at first and at most, and the time that they are to take, s.
FEW, MOST, MOMENT = 100, 4000, 0.02


class Pace:
    """The number of evaluations that take a `MOMENT`, by how long the last ones have taken.

    Evaluations of a run that crawls may take a thousand times as long as those before.
    """

    def __init__(self) -> None:
        self._count = FEW

    def take(self, evaluate: Callable[[int], int]) -> int:
        """Do so many evaluations by a function of their number, and return what it does."""
        began = clock.perf_counter()
        request = evaluate(self._count)
        share = MOMENT / max(clock.perf_counter() - began, 0.5 * MOMENT)
        self._count = min(max(int(share * self._count), 1), MOST)
        return request
