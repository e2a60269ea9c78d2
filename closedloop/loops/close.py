"""A state that obeys the loops: the nearest one to a given state."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.solve import back_substitute, forward_substitute
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.loops.memory import LoopLinks, LoopRows, loops_at
from closedloop.loops.rows import locate_rows
from closedloop.loops.solve import meet_rows, orthonormal_rows

Array = NDArray[np.float64]

# Newton steps at most, and the error, m or rad, below which there is no other: rounding.
MOST_MOVES, CLOSED = 50, 1e-15
# A loop is closed if no error is above this, m or rad.
TOLERANCE = 1e-12


@kernel
def factor_rows(links: LoopLinks, rows: LoopRows, L: Array) -> None:
    """Write the basis of the rows Z = G L⁻ᵀ; L (n, n) as `closedloop.closure.solve.cholesky` writes it."""
    for k in range(links.m):
        for j in range(links.n):
            rows.basis[k, j] = rows.G[k, j]
        forward_substitute(L, rows.basis[k])
    links.rank = orthonormal_rows(rows.basis, links.m, rows.order, rows.coefficients, rows.along)


@kernel
def largest_error(links: LoopLinks, rows: LoopRows) -> float:
    """Return the largest error of the rows, m or rad."""
    largest = 0.0
    for k in range(links.m):
        size = abs(rows.error[k])
        if not size <= largest:
            largest = size
    return largest


@kernel
def close_state(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> float:
    """Move q and q̇ to the nearest state, in the metric of L Lᵀ, that the loops allow; return the error left, m or rad.

    Newton's method on the error, each step the shortest, until the error is rounding or no longer shrinks; then the
    velocity.
    """
    n, before, left = links.n, math.inf, math.inf
    for _ in range(MOST_MOVES):
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        locate_rows(links, rows)
        left = largest_error(links, rows)
        factor_rows(links, rows, L)
        if left <= CLOSED or not left < math.inf or (left <= TOLERANCE and left >= 0.25 * before):
            break
        before = left
        meet_rows(rows.error, rows.order, rows.coefficients, rows.basis, links.rank, rows.along, rows.part)
        back_substitute(L, rows.part)
        for j in range(n):
            q[j] -= rows.part[j]
    meet_rows(rows.rate, rows.order, rows.coefficients, rows.basis, links.rank, rows.along, rows.part)
    back_substitute(L, rows.part)
    for j in range(n):
        v[j] -= rows.part[j]
    return left


@entry_kernel
def closed_to(address: int, L: Array, q: Array, v: Array) -> float:
    """Do `close_state` with the memory of the loops at an address."""
    links, rows = loops_at(address)
    return close_state(links, rows, L, q, v)
