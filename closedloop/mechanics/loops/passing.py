"""Passing a pose in which the rows of the loops lose rank: a change point, where the mechanism lies flat.

Where a row is outside the span of the others by a share s only, what it requires of the acceleration is its drift
divided by s. On the mechanism's way both go to zero together, and the quotient has a limit; but an error e of the loops
changes it by |q̇|² e/s³: with e of rounding, 1e-15 m, by 1e-5 rad/s² at s = 1e-3 and by 1e4 rad/s² at s = 1e-6. So near
such a pose the quotient is interpolated between states on both sides of it, closed to rounding, along the velocity.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.loops.close import TOLERANCE, close_state
from closedloop.mechanics.loops.factor import factor, smallest_share
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, tree_at
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import basis_in_metric, dot, multiply_transposed, take_free
from closedloop.mechanics.robot.tree.turning import move_posture

# A row is near to losing its direction below this share; the way to the next of the four states between which what it
# requires is interpolated, rad or m; by how much more it has to be outside the span there; and the way to the state
# whose direction stands for one that is lost, which must be far enough for it to be found there again (`DEPENDENT`).
NEAR, WAY, FARTHER, ASIDE = 1e-3, 1e-2, 3.0, 1e-4


@kernel
def find_basis(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Write the rows at a state, factored for their drift, and the basis of P (`closedloop.mechanics.loops.solve`)."""
    for j in range(links.n):
        rows.q[j], rows.v[j] = q[j], v[j]
    locate_rows(links, rows)
    factor(links, rows, rows.drift, links.m)
    links.known = links.rank
    basis_in_metric(links, rows, L)


@kernel
def find_required(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Do `find_basis`, and write the shortest part (n,) of which L⁻ᵀ part is an acceleration with G q̈ = −drift."""
    find_basis(links, rows, L, q, v)
    for j in range(links.n):
        rows.part[j] = -rows.met[j]
    multiply_transposed(L, rows.part, links.n)
    take_free(links, rows, rows.part)


@kernel
def find_required_on_the_way(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Do `find_required`, also where the rows lose rank on the mechanism's way."""
    known = links.known
    find_required(links, rows, L, q, v)
    lost = links.rank < known
    share = 0.0 if lost else smallest_share(links, rows)
    if not share < NEAR:
        return
    found = interpolate_part(links, rows, L, q, v, known if lost else links.rank, share)
    if found and lost:  # the direction that is lost here is that of a state close by
        close_beside(links, rows, q, v, ASIDE)
        find_basis(links, rows, L, rows.near_q, rows.near_v)
    else:
        find_required(links, rows, L, q, v)
    if found:
        take_free(links, rows, rows.near_part)  # what the rows determine, so that reactions account for all of it
        for j in range(links.n):
            rows.part[j] = rows.near_part[j]


@kernel
def close_beside(links: LoopLinks, rows: LoopRows, q: Array, v: Array, way: float) -> float:
    """Write the state near_q, near_v at a way, rad or m, along the velocity, closed; return the error left."""
    n = links.n
    for j in range(n):
        rows.near_q[j], rows.near_v[j] = q[j], v[j]
    move_posture(tree_at(links), rows.near_q, v, way / math.sqrt(dot(v, v, n)))
    return close_state(links, rows, rows.near_q, rows.near_v)


@kernel
def interpolate_part(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array, rank: int, share: float) -> bool:
    """Write `near_part`, what the rows require at a state near a pose in which they lose rank, if that has a limit.

    Between its values f at −2, −1, 1 and 2 steps along the velocity, with the same L,

        f(0) = (4 f(1) + 4 f(−1) − f(2) − f(−2)) / 6 + O(step⁴).

    Returns false where that is not so: with frames that move, which are elsewhere then, at rest, where the rows do not
    get farther from losing rank on both sides, or where the mechanism cannot be closed there. The rows are those of
    another state afterwards.
    """
    if links.frames > 0 or not dot(v, v, links.n) > 0.0:
        return False
    for j in range(links.n):
        rows.near_part[j] = 0.0
    for steps in (-2, -1, 1, 2):
        links.known = rank
        left = close_beside(links, rows, q, v, steps * WAY)
        find_required(links, rows, L, rows.near_q, rows.near_v)
        if links.rank != rank or not left <= TOLERANCE or not smallest_share(links, rows) > FARTHER * share:
            return False
        weight = (4.0 if abs(steps) == 1 else -1.0) / 6.0
        for j in range(links.n):
            rows.near_part[j] += weight * rows.part[j]
    return True
