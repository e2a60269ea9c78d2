"""The memory of a mechanism's loop joints: what they bind, and their rows at the state asked about last."""

from typing import Annotated, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import address_of, integers_at, vector_at
from closedloop.jit.kernel import kernel, plain
from closedloop.mechanics.loops.boxes import BoxPair
from closedloop.mechanics.loops.moved import MovedFrame, add_frames
from closedloop.mechanics.robot.tree import LINK_ROWS, Tree, work_size
from closedloop.mechanics.robot.tree.layout import SCRATCHES

N, M = Count.of("n"), Count.of("m")


class LoopLinks(Block):
    """Whole numbers, int64: where the memory is, its own address first, and the tree that it belongs to."""

    address: int
    numbers: int  # address of the `LoopRows`
    total: int  # of its numbers
    n: int  # joints
    m: int  # rows
    rank: int  # how many of the rows are independent
    ordered: int  # 1 once there is an order of elimination, see `closedloop.mechanics.loops.factor`
    # 1 if the basis spans what the rows leave free, 0 if it spans the rows, see `closedloop.mechanics.loops.solve`
    free: int
    spanned: int  # directions of the basis
    known: int  # how many were where the loops were closed last, 0: not known
    undriven: int  # directions of torque that no drive gives
    loop: int  # address of the memory of the loop that it is for, see `closedloop.loop.step.memory`; 0: none
    bound: int  # address of what each row binds, see `Bound.sides`
    order: int  # address of the rows and of the joints in the order of elimination
    tree_blocks: int
    tree_carrier: int
    tree_serial: int
    tree_balls: int
    tree_links: int  # addresses
    tree_constants: int
    tree_constants_size: int
    scratch: int
    scratch_size: int
    frames: int  # that move as they are told, see `closedloop.mechanics.loops.moved`
    moved: int  # address of entry and memory of each


class NearBy(Block, sizes=("n",)):
    """A state near by, see `closedloop.loop.step.closed_loops`."""

    q: Annotated[Array, N]
    v: Annotated[Array, N]
    part: Annotated[Array, N]


class LoopRows(Block, sizes=("n", "m")):
    """What the rows bind, and what they are at a state (q, q̇) of n joints."""

    q: Annotated[Array, N]
    v: Annotated[Array, N]
    at_a: Annotated[Array, M, 3]  # a point of either link, in the link's axes, m
    at_b: Annotated[Array, M, 3]
    along_a: Annotated[Array, M, 3]  # and a direction
    along_b: Annotated[Array, M, 3]
    value: Annotated[Array, M, 5]  # a distance, m, the polynomial of a gear, or half the edges of a box, m
    first: Annotated[Array, M, N]  # of a gear the coefficients of the joints in x1 and in x2
    second: Annotated[Array, M, N]
    scale: Annotated[Array, M]  # one over the usual length of each row
    undriven: Annotated[Array, N, N]  # as many rows as `LoopLinks.undriven` says, see `robot_models.model`
    # Of a point whose first error is above this, m, or that is farther than that from the other point, only errors and
    # rates are written; if clear is −inf only errors, and these only if it is nearer.
    clear: Annotated[Array, M]
    beyond: Annotated[Array, M]
    written: Annotated[Array, M]  # ROWS, RATES, ERRORS or NOTHING of a point
    G: Annotated[Array, M, N]  # written, as all that follow: the rows, their drift, error and its rate
    drift: Annotated[Array, M]
    error: Annotated[Array, M]  # m, or the sine of an angle
    rate: Annotated[Array, M]
    factors: Annotated[Array, M, M]  # Lᵀ above the diagonal, Uᵀ below, the reciprocal pivots on it
    left: Annotated[Array, M, N + 1]  # the rows and their right side, after elimination
    reduced: Annotated[Array, M, N + 1]  # the same solved for the joints that they determine: the free ones' part
    met: Annotated[Array, N]  # a motion that meets the rows
    along: Annotated[Array, M]  # scratch
    basis: Annotated[Array, N, N]  # orthonormal, of P, see `closedloop.mechanics.loops.solve`
    share: Annotated[Array, N]  # scratch: coordinates in the basis
    part: Annotated[Array, N]  # L⁻ᵀ part is the acceleration that the rows require
    moved: Annotated[Array, 3]  # the acceleration of the tip that the rows require, contact frame, m/s²
    drive_basis: Annotated[Array, N, N]  # scratch, as the next four: what the drives move of what is free
    drive_order: Annotated[Array, N]
    drive_coefficients: Annotated[Array, N, N]
    drive_lengths: Annotated[Array, N]
    wanted: Annotated[Array, N]
    tip: Annotated[
        Array, 6, N
    ]  # in and out: rows of the tip and its turning, see `closedloop.mechanics.loops.assemble`
    still: Annotated[Array, N]  # scratch: a velocity of none
    motions: Annotated[Array, 2, 18]  # scratch: see `closedloop.mechanics.loops.rows`, as the next
    directions: Annotated[Array, 3, 9]  # of the rows of a point, with their first and second derivatives
    pair: BoxPair  # that was located last
    near: NearBy  # scratch, as what follows
    column: Annotated[Array, N]


LOOP_LINKS = LoopLinks.count()

# Kinds of rows, see `closedloop.mechanics.loops.rows`.
POSITION, ROTATION, DISTANCE, GEAR, IDLE, BOXES = range(6)
# What is written of a point.
ROWS, RATES, ERRORS, NOTHING = range(4)


@kernel
def loops_at(address: int) -> tuple[LoopLinks, LoopRows]:
    """Return the memory of a mechanism's loops, by the address of its `LoopLinks`."""
    links = LoopLinks(integers_at(address, LOOP_LINKS))
    return links, LoopRows(vector_at(links.numbers, links.total), links.n, links.m)


@kernel
def tree_at(links: LoopLinks) -> Tree:
    """Return the tree of a mechanism's loops."""
    return Tree(
        links.n, links.tree_blocks, 1, links.tree_carrier, links.tree_serial,
        integers_at(links.tree_links, LINK_ROWS * links.n), vector_at(links.tree_constants, links.tree_constants_size),
        links.tree_balls,
    )  # fmt: skip


class LoopMemory(NamedTuple):
    """The memory of a mechanism's loops, made in Python: kept as long as its address is used."""

    links: LoopLinks
    rows: LoopRows

    @property
    def address(self) -> int:
        """Return what `loops_at` takes."""
        return int(self.links.address)

    @property
    def placed(self) -> Array:
        """Return what `closedloop.mechanics.loops.moved.place_frames` writes."""
        scratch: Array = self.links.kept["scratch"]
        return scratch[len(scratch) - int(self.links.frames) * SCRATCHES :]


#: What is told of each row, of those that `LoopRows` and `Bound` both have.
VALUES = ("at_a", "at_b", "along_a", "along_b", "value", "first", "second", "scale")


class Bound(NamedTuple):
    """What the m rows of a mechanism's loops bind."""

    # (4 m,): kind of each row, see `closedloop.mechanics.loops.rows`; then the link (gear: a joint) of the one side
    # of each; then of the other; −1 is the base, −2 − k frame k of `moved`; then 1 for a row whose points are those of
    # the row before it
    sides: IntArray
    # at_a, at_b, along_a, along_b, value, first, second: (m, 3), ..., (m, 5), (m, n), (m, n): see `LoopRows`
    at_a: Array
    at_b: Array
    along_a: Array
    along_b: Array
    value: Array
    first: Array
    second: Array
    # (m,): one over the usual length of each row, so that rows of any unit can be compared, and one that is short in
    # some posture is known to be
    scale: Array
    undriven: Array  # (u, n), see `robot_models.model.RobotModel.undriven`
    moved: tuple[MovedFrame, ...] = ()

    @property
    def m(self) -> int:
        """How many rows there are."""
        return len(self.at_a)


def bound_points(n: int, sides: IntArray, at_a: Array, at_b: Array, directions: Array) -> Bound:
    """Return what rows of points (m, 3) of either link bind along directions (m, 3) of the other, in n joints."""
    m, none = len(at_a), np.zeros((len(at_a), 3))
    sums = np.zeros((m, n))
    return Bound(sides, at_a, at_b, none, directions, np.zeros((m, 5)), sums, sums, np.ones(m), np.zeros((0, n)))


def make_loop_memory(tree: Tree, bound: Bound) -> LoopMemory:
    """Return the memory of a mechanism's loops."""
    sizes = tree.n, bound.m
    links, rows = LoopLinks(np.zeros(LOOP_LINKS, dtype=np.int64)), LoopRows(np.zeros(LoopRows.count(*sizes)), *sizes)
    scratch = np.zeros(plain(work_size)(tree.n) + len(bound.moved) * SCRATCHES)
    links.address, links.numbers, links.total = address_of(links.memory), address_of(rows.memory), rows.memory.size
    links.n, links.m, links.undriven = *sizes, len(bound.undriven)
    order = np.arange(bound.m + tree.n, dtype=np.int64)
    links.bound, links.order = address_of(bound.sides), address_of(order)
    links.tree_blocks, links.tree_carrier, links.tree_serial = tree.blocks, tree.carrier, tree.serial
    links.tree_links, links.tree_constants = address_of(tree.links), address_of(tree.constants)
    links.tree_constants_size, links.tree_balls = tree.constants.size, tree.balls
    links.scratch, links.scratch_size = address_of(scratch), scratch.size
    for name in VALUES:
        getattr(rows, name)[:] = getattr(bound, name)
    rows.undriven[: len(bound.undriven)] = bound.undriven
    rows.clear[:] = rows.beyond[:] = np.inf
    links.keep_alive(tree=tree, bound=bound, scratch=scratch, order=order)
    if bound.moved:
        add_frames(links, bound.moved)
    return LoopMemory(links, rows)
