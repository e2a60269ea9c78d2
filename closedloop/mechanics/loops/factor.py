"""The rows of the loops, factored: G = S⁻¹ L U in an order of its rows and joints, by Gaussian elimination.

The order is that of the last state, as long as no pivot has become small beside what is divided by it; only then is it
chosen anew, by threshold pivoting: of the entries that are no less than a tenth of the largest one left, that with the
fewest entries in its row and column (H. M. Markowitz, Management Science 3, 1957; I. S. Duff, A. M. Erisman and
J. K. Reid, Direct Methods for Sparse Matrices, 1986). A joint of one leg of a mechanism then meets the rows of that leg
alone, and what is zero is not computed.

Rows that depend on others (a doubled link, a Bennett linkage) are nothing once those are eliminated from them. Their
number is found at each state: no row is regularised.
"""

import math

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.calls import integers_at
from closedloop.jit.kernel import kernel
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows

# A row of which no more than this share of its usual length is left depends on the others, or is none. A state is
# closed to rounding, and the direction of a row of which a share s is left is known to that over s²: to 1e-4 here.
DEPENDENT = 1e-6
# An entry may become a pivot if it is no less than this share of the largest; and the order is chosen anew where an
# entry is larger than a pivot that divides it by more than the second number.
PIVOT, LARGEST = 0.1, 30.0


@kernel
def factor(links: LoopLinks, rows: LoopRows, b: Array, most: int) -> None:
    """Factor the rows G, of `most` independent ones at most, and write a motion `met` (n,) with G met = b (m,)."""
    if links.rank > most or links.ordered == 0 or not eliminate(links, rows, b, most, DEPENDENT, LARGEST):
        order_rows(links, rows, most)
        eliminate(links, rows, b, links.rank, 0.0, math.inf)
    _, joints = order_of(links)
    for j in range(links.n):
        rows.met[j] = 0.0
    for k in range(links.rank):
        rows.met[joints[k]] = rows.reduced[k, links.n - links.rank]


@kernel
def order_of(links: LoopLinks) -> tuple[IntArray, IntArray]:
    """Return the rows and the joints in the order of elimination; the joints after the first `rank` are free."""
    both = integers_at(links.order, links.m + links.n)
    return both[: links.m], both[links.m :]


@kernel
def eliminate(links: LoopLinks, rows: LoopRows, b: Array, most: int, least: float, largest: float) -> bool:
    """Write the factors, and `reduced`, the rows solved for the joints that they determine, with b on the right.

    Returns false where the order will not do: a pivot below `least`, more than `largest` times smaller than what it
    divides, or a row not of the `rank` first that has more than `least` left, if more than `rank` may be independent.
    """
    of_rows, joints = order_of(links)
    m, n, rank, F, R = links.m, links.n, links.rank, rows.factors, rows.left
    count = m if rank < most else rank
    for k in range(count):
        row = of_rows[k]
        scale = rows.scale[row]
        for j in range(n):
            R[k, j] = scale * rows.G[row, j]
        R[k, n] = scale * b[row]
    for k in range(rank):
        c = joints[k]
        if not abs(R[k, c]) > least:
            return False
        inverse = 1.0 / R[k, c]
        F[k, k] = inverse
        for i in range(k + 1, count):
            share = R[i, c] * inverse
            if i < rank:
                F[k, i] = share
            if share == 0.0:
                continue
            if not abs(share) <= largest:
                return False
            for j in range(n + 1):
                R[i, j] -= share * R[k, j]
            R[i, c] = 0.0
    for i in range(rank, count):
        for j in range(n):
            if abs(R[i, j]) > least:
                return False
    return solve_for_determined(links, rows) <= largest


@kernel
def solve_for_determined(links: LoopLinks, rows: LoopRows) -> float:
    """Write `reduced`, what is left after elimination solved for the joints that it determines; return the largest."""
    _, joints = order_of(links)
    n, rank, F, R, T, largest = links.n, links.rank, rows.factors, rows.left, rows.reduced, 0.0
    width = n - rank + 1
    for k in range(rank - 1, -1, -1):
        for j in range(rank, n):
            T[k, j - rank] = R[k, joints[j]]
        T[k, n - rank] = R[k, n]
        for i in range(k + 1, rank):
            above = R[k, joints[i]]
            F[i, k] = above
            if above != 0.0:
                for j in range(width):
                    T[k, j] -= above * T[i, j]
        for j in range(width):
            T[k, j] *= F[k, k]
        for j in range(width - 1):
            largest = max(largest, abs(T[k, j]))
    return largest


@kernel
def order_rows(links: LoopLinks, rows: LoopRows, most: int) -> None:
    """Choose the order of elimination, and find how many rows are independent, `most` at most."""
    of_rows, joints = order_of(links)
    m, n, R, rank = links.m, links.n, rows.left, 0
    for k in range(m):
        of_rows[k] = k
        for j in range(n):
            R[k, j] = rows.scale[k] * rows.G[k, j]
    for j in range(n):
        joints[j] = j
    while rank < most:
        size = 0.0
        for i in range(rank, m):
            for j in range(rank, n):
                size = max(size, abs(R[of_rows[i], joints[j]]))
        if not size > DEPENDENT:
            break
        row, column = fewest_entries(R, of_rows, joints, rank, PIVOT * size)
        of_rows[rank], of_rows[row] = of_rows[row], of_rows[rank]
        joints[rank], joints[column] = joints[column], joints[rank]
        top, c = of_rows[rank], joints[rank]
        for i in range(rank + 1, m):
            share = R[of_rows[i], c] / R[top, c]
            for j in range(n):
                R[of_rows[i], j] -= share * R[top, j]
            R[of_rows[i], c] = 0.0
        rank += 1
    links.rank, links.ordered = rank, 1


@kernel
def fewest_entries(R: Array, of_rows: IntArray, joints: IntArray, rank: int, least: float) -> tuple[int, int]:
    """Return where the entry, of at least this size, is whose row and column have the fewest others: the places."""
    m, n, best, row, column, size = len(of_rows), len(joints), -1, rank, rank, 0.0
    for i in range(rank, m):
        in_row = 0
        for j in range(rank, n):
            in_row += 1 if abs(R[of_rows[i], joints[j]]) > DEPENDENT * least else 0
        for j in range(rank, n):
            entry = abs(R[of_rows[i], joints[j]])
            if entry < least:
                continue
            in_column = 0
            for k in range(rank, m):
                in_column += 1 if abs(R[of_rows[k], joints[j]]) > DEPENDENT * least else 0
            fill = (in_row - 1) * (in_column - 1)
            if best < 0 or fill < best or (fill == best and entry > size):
                best, row, column, size = fill, i, j, entry
    return row, column


@kernel
def meet(links: LoopLinks, rows: LoopRows, b: Array) -> None:
    """Write a motion `met` (n,) with G met = b (m,), by the factors that are there."""
    of_rows, joints = order_of(links)
    F, x, rank = rows.factors, rows.along, links.rank
    for k in range(rank):
        x[k] = rows.scale[of_rows[k]] * b[of_rows[k]]
    for j in range(links.n):
        rows.met[j] = 0.0
    for k in range(rank):  # what is known is taken off all that follow: they do not wait for each other's sums
        known = x[k]
        for i in range(k + 1, rank):
            x[i] -= F[k, i] * known
    for k in range(rank - 1, -1, -1):
        known = x[k] * F[k, k]
        rows.met[joints[k]] = known
        for i in range(k):
            x[i] -= F[k, i] * known


@kernel
def smallest_share(links: LoopLinks, rows: LoopRows) -> float:
    """Return how far the last of the independent rows is outside the span of the others, by its usual length.

    Or less: it is one over the motion, of the joints that the rows determine, which changes this row alone, by its
    length, and the shortest of all such motions is no longer.
    """
    F, x, last, square = rows.factors, rows.along, links.rank - 1, 0.0
    if last < 0:
        return 1.0
    for k in range(last):
        x[k] = 0.0
    x[last] = 1.0
    for k in range(last, -1, -1):
        known = x[k] * F[k, k]
        square += known * known
        for i in range(k):
            x[i] -= F[k, i] * known
    return float(1.0 / math.sqrt(square))
