"""Passing a pose in which the rows of the loops lose rank: a change point, where the mechanism lies flat.

Where a row is outside the span of the others by a share s only, what it requires of the acceleration is its drift
divided by s. On the mechanism's way both go to zero together, and the quotient has a limit; but an error e of the loops
changes it by |q̇|² e/s³: with e of rounding, 1e-15 m, by 1e-5 rad/s² at s = 1e-3 and by 1e4 rad/s² at s = 1e-6. So near
such a pose the quotient is interpolated between states on both sides of it, closed to rounding, along the velocity.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.loops.close import TOLERANCE, close_state
from closedloop.loops.memory import LoopLinks, LoopRows
from closedloop.loops.rows import locate_rows
from closedloop.loops.solve import dot, meet_rows, orthonormal_rows, remove_basis, substitute_rows

Array = NDArray[np.float64]

# A row is near to losing its direction below this share; the way to the next of the four states between which what it
# requires is interpolated, rad or m; by how much more it has to be outside the span there; and the way to the state
# whose direction stands for one that is lost.
NEAR, WAY, FARTHER, ASIDE = 1e-3, 1e-2, 3.0, 1e-4


@kernel
def find_required(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Write the rows at a state, the basis of Z = G L⁻ᵀ, and the shortest part (n,) with Z part = −drift."""
    for j in range(links.n):
        rows.q[j], rows.v[j] = q[j], v[j]
    locate_rows(links, rows)
    for k in range(links.m):
        for j in range(links.n):
            rows.basis[k, j] = rows.G[k, j]
    substitute_rows(L, rows.basis, links.m)
    links.rank = orthonormal_rows(rows.basis, links.m, links.m, rows.order, rows.coefficients, rows.along)
    links.known = links.rank
    for k in range(links.m):
        rows.rate[k] = -rows.drift[k]
    meet_rows(rows.rate, rows.order, rows.coefficients, rows.basis, links.rank, rows.along, rows.part)


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
        speed = math.sqrt(dot(v, v, links.n))
        for j in range(links.n):
            rows.near_q[j], rows.near_v[j] = q[j] + ASIDE * v[j] / speed, v[j]
        close_state(links, rows, rows.near_q, rows.near_v)
        find_required(links, rows, L, rows.near_q, rows.near_v)
    else:
        find_required(links, rows, L, q, v)
    if found:
        for j in range(links.n):
            rows.part[j] = rows.near_part[j]
        remove_basis(rows.near_part, rows.basis, links.rank)
        for j in range(links.n):  # what lies along the basis, so that reactions account for all of it
            rows.part[j] -= rows.near_part[j]


@kernel
def smallest_share(links: LoopLinks, rows: LoopRows) -> float:
    """Return how far the last row of the basis is outside the span of the others, as a share of its length."""
    k = links.rank - 1
    if k < 0:
        return 1.0
    square = 0.0
    for i in range(k + 1):
        square += rows.coefficients[k, i] * rows.coefficients[k, i]
    return float(abs(rows.coefficients[k, k]) / math.sqrt(square))


@kernel
def interpolate_part(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array, rank: int, share: float) -> bool:
    """Write `near_part`, what the rows require at a state near a pose in which they lose rank, if that has a limit.

    Between its values f at −2, −1, 1 and 2 steps along the velocity, with the same L,

        f(0) = (4 f(1) + 4 f(−1) − f(2) − f(−2)) / 6 + O(step⁴).

    Returns false where that is not so: at rest, where the rows do not get farther from losing rank on both sides, or
    where the mechanism cannot be closed there. The rows are those of another state afterwards.
    """
    n, speed = links.n, math.sqrt(dot(v, v, links.n))
    if not speed > 0.0:
        return False
    for j in range(n):
        rows.near_part[j] = 0.0
    for steps in (-2, -1, 1, 2):
        for j in range(n):
            rows.near_q[j], rows.near_v[j] = q[j] + steps * WAY * v[j] / speed, v[j]
        links.known = rank
        left = close_state(links, rows, rows.near_q, rows.near_v)
        find_required(links, rows, L, rows.near_q, rows.near_v)
        if links.rank != rank or not left <= TOLERANCE or not smallest_share(links, rows) > FARTHER * share:
            return False
        weight = (4.0 if abs(steps) == 1 else -1.0) / 6.0
        for j in range(n):
            rows.near_part[j] += weight * rows.part[j]
    return True
