"""A state that obeys the loops: the nearest one to a given state, joints counting alike.

The measure is the same at every state. With one that is not, such as that of H, a stage of a Runge-Kutta step would be
moved along the loops by what the measure has changed since the last stage, which takes an order from the scheme.

The loops of a mechanism whose tip follows a path: postures that close them, and motions that keep them so.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.dual8 import has_derivatives, sought
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.mechanics.loops.factor import factor, meet
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, loops_at, tree_at
from closedloop.mechanics.loops.rows import locate_rows, place_rows
from closedloop.mechanics.loops.solve import basis_alike, dot, leave_free, take_free
from closedloop.mechanics.robot.tree.turning import move_posture

# Newton steps at most, and the error, m or rad, below which there is no other: rounding.
MOST_MOVES, CLOSED = 50, 1e-15
# A loop is closed if no error is above this, m or rad.
TOLERANCE = 1e-12
# Where a step has left no more than this share of the error, the next is taken with the rows as they were: it leaves
# about the same share of it.
FAST = 1e-3


@kernel
def factor_rows(links: LoopLinks, rows: LoopRows, b: Array, most: int) -> None:
    """Factor the rows G, of `most` independent ones at most, for b (m,), and write the basis; joints count alike."""
    factor(links, rows, b, most)
    basis_alike(links, rows)


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
def close_state(links: LoopLinks, rows: LoopRows, q: Array, v: Array) -> float:
    """Move q and q̇ to the nearest state that the loops allow; return the error left, m or rad.

    Newton's method on the error, each step the shortest, until the error is rounding or no longer shrinks; then the
    velocity. The rows are factored again only where they have changed much since.
    """
    n, tree, before, left, factored_here = links.n, tree_at(links), math.inf, math.inf, False
    # Rows that depend on others where the loops are closed seem not to where they are open.
    most = links.known if links.known > 0 else links.m
    for _ in range(MOST_MOVES):
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        place_rows(links, rows)
        left = largest_error(links, rows)
        factored_here = not (before < math.inf and left <= FAST * before)
        if factored_here:
            factor_rows(links, rows, rows.error, most)
        if left <= CLOSED or not left < math.inf or (left <= TOLERANCE and left >= 0.25 * before):
            break
        if not factored_here:
            meet(links, rows, rows.error)
        take_free(links, rows, rows.met)
        move_posture(tree, q, rows.met, -1.0)
        if not factored_here and left * left <= 0.01 * CLOSED * before:
            left = left * left / before  # what this step leaves, below rounding
            break
        before = left
    if has_derivatives(left):  # the derivatives of q are moved onto the loops too, and the rows are those there
        for k in range(links.m):
            rows.error[k] -= sought(rows.error[k])
        meet(links, rows, rows.error)
        take_free(links, rows, rows.met)
        move_posture(tree, q, rows.met, -1.0)
        for j in range(n):
            rows.q[j] = q[j]
        place_rows(links, rows)
        factor_rows(links, rows, rows.error, most)
        factored_here = True
    if links.frames > 0:  # G q̇ is minus the rate with which frames that move open the rows
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        locate_rows(links, rows)
        factor_rows(links, rows, rows.rate, most)
        take_free(links, rows, rows.met)
        for j in range(n):
            v[j] -= rows.met[j]
        return left
    leave_free(links, rows, v)
    if not factored_here:  # that was where the loops were not closed yet
        for k in range(links.m):
            rows.rate[k] = dot(row_of(rows.G, k), v, n)
        meet(links, rows, rows.rate)
        take_free(links, rows, rows.met)
        for j in range(n):
            v[j] -= rows.met[j]
    return left


@entry_kernel
def closed_to(address: int, q: Array, v: Array) -> float:
    """Do `close_state` with the memory of the loops at an address."""
    links, rows = loops_at(address)
    return close_state(links, rows, q, v)


# What is asked.
TANGENT, NEAREST = range(2)


@entry_kernel
def along_path(address: int, what: int) -> int:
    """Answer for the loops at `q` of their memory, by its address; joints count alike.

    TANGENT     replace `tip`, rows of joint velocities, by what the loops leave of them
    NEAREST     replace `q` by the nearest posture that closes the loops
    """
    links, rows = loops_at(address)
    if what == TANGENT:
        for j in range(links.n):
            rows.v[j] = 0.0
        locate_rows(links, rows)
        factor_rows(links, rows, rows.error, links.m)
        links.known = links.rank
        for k in range(6):
            leave_free(links, rows, rows.tip[k])
    else:
        for j in range(links.n):
            rows.column[j], rows.still[j] = rows.q[j], 0.0
        close_state(links, rows, rows.column, rows.still)
        for j in range(links.n):
            rows.q[j] = rows.column[j]
    return 0
