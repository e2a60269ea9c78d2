"""Equations of which some depend on others, and the shortest forces that obey these.

A square system of any rank: elimination with complete pivots.

Loops go along the rows of an array, and over what is not zero: contacts that share no body do not move each other.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, Contacts
from closedloop.mechanics.contacts.resistance import square_of_turning

# A pivot below this share of the largest is rounding: the row depends on the others.
DEPENDENT = 1e-11


@kernel
def largest_number(S: Array, p: int, k: int) -> tuple[int, int, float]:
    """Return row and column of the first largest number of S[k:p, k:p], and its size.

    Of four numbers at a time: one after the other each waits for the one before.
    """
    row, column, largest = k, k, 0.0 * abs(S[k, k])
    for i in range(k, p):
        of = row_of(S, i)
        a = b = c = d = 0.0 * largest
        for j in range(k, p - 3, 4):
            a, b = max(a, abs(of[j])), max(b, abs(of[j + 1]))
            c, d = max(c, abs(of[j + 2])), max(d, abs(of[j + 3]))
        for j in range(p - (p - k) % 4, p):
            a = max(a, abs(of[j]))
        most = max(max(a, b), max(c, d))
        if most > largest:
            row, largest = i, most
    of = row_of(S, row)
    for j in range(p - 1, k - 1, -1):
        if abs(of[j]) >= largest:
            column = j
    return row, column, largest


@kernel
def solve_any_rank(S: Array, p: int, sides: int, order: Array, x: Array, dependent: float) -> int:
    """Solve the p equations in S[:p, :p] for right-hand sides in its next columns; return the rank.

    Parameters
    ----------
    S : (>= p, >= p + sides) array
        Overwritten.
    p, sides : int
        Size, and how many right-hand sides there are.
    order : (>= p,) array
        Scratch.
    x : (sides, >= p) array
        Written; unknowns that the equations leave free are zero.
    dependent : float
        Share of the largest pivot below which a row depends on the others.
    """
    rank, first = p, 0.0
    for i in range(p):
        order[i] = i
    for k in range(p):
        row, column, largest = largest_number(S, p, k)
        if k == 0:
            first = largest
        if not largest > dependent * first:
            rank = k
            break
        of, other = row_of(S, k), row_of(S, row)
        for j in range(p + sides if row != k else 0):
            of[j], other[j] = other[j], of[j]
        for i in range(p if column != k else 0):
            S[i, k], S[i, column] = S[i, column], S[i, k]
        order[k], order[column] = order[column], order[k]
        for i in range(k + 1, p):
            to = row_of(S, i)
            if to[k] != 0.0:
                share = to[k] / of[k]
                for j in range(k + 1, p + sides):
                    to[j] -= share * of[j]
    for side in range(sides):
        for i in range(p):
            x[side, i] = 0.0
        for i in range(rank - 1, -1, -1):
            s = S[i, p + side]
            for j in range(i + 1, rank):
                s -= S[i, j] * x[side, int(order[j])]
            x[side, int(order[i])] = s / S[i, i]
    return rank


# A pivot of the mobility below this share of the largest: the row depends on others, its force is not unique. A row
# that asks for more than this share beyond what the others give contradicts them: points of one body that stick
# contradict each other by the square of what a step's error leaves of the velocity between them.
SAME_ROW, CONTRADICTS = 1e-10, 1e-3
# What equations of dependent rows may be off, of what they ask for, and how often they are solved for what is left.
EXACT, REFINEMENTS = 1e-13, 5


@kernel
def independent_rows(c: Contacts, p: int) -> int:
    """Write as `column_order` the unknowns in such an order that the first rows depend on no others; return how many.

    By Cholesky's factors of W with pivots.
    """
    R, order, left, first = c.scratch.unknowns, c.scratch.column_order, c.scratch.trial, 0.0
    W, unknown, rest = c.W, c.scratch.unknown, c.scratch.multiples
    for i in range(p):
        row = int(unknown[i])
        order[i], left[i] = i, W[row, row]
        first = max(first, left[i])
    for r in range(p):
        best = r
        for m in range(r + 1, p):
            if left[int(order[m])] > left[int(order[best])]:
                best = m
        order[r], order[best] = order[best], order[r]
        i = int(order[r])
        if not left[i] > SAME_ROW * first:
            return r
        root, row = math.sqrt(left[i]), int(unknown[i])
        for j in range(p):
            rest[j] = W[row, int(unknown[j])]
        for t in range(r):
            subtract(rest, R[t, i], row_of(R, t), p)
        for j in range(p):
            R[r, j] = rest[j] / root
        for m in range(r + 1, p):
            j = int(order[m])
            left[j] -= R[r, j] * R[r, j]
    return p


@kernel
def subtract(x: Array, share: float, y: Array, p: int) -> None:
    """Subtract from the first p numbers of x a share of those of y."""
    if share != 0.0:
        for j in range(p):
            x[j] -= share * y[j]


@kernel
def shortest_solutions(c: Contacts, p: int, rank: int, asked: float) -> bool:
    """Write as `solution` the shortest forces, inside cones or not, that obey the first equations of `column_order`.

    With A these equations and D the squares of the forces that the unknowns stand for, x = D⁻¹Aᵀ(A D⁻¹Aᵀ)⁻¹ s.

    Returns False if rounding is in the way, or the other equations contradict them.
    """
    A, order, weight = c.scratch.system, c.scratch.column_order, c.scratch.best
    write_weights(c, p, weight)
    if not factor_normal_equations(c, p, rank, weight):
        return False
    for side in range(2):
        if not refine(c, p, rank, side, weight, asked):
            return False
    x = row_of(c.scratch.solution, 0)
    for r in range(rank, p):
        i = int(order[r])
        s = A[i, p]
        for j in range(p):
            s -= A[i, j] * x[j]
        if not abs(s) <= CONTRADICTS * asked:
            return False
    return True


@kernel
def write_weights(c: Contacts, p: int, weight: Array) -> None:
    """Write D⁻¹ of the unknowns."""
    for j in range(p):
        row = int(c.scratch.unknown[j])
        i, square = row // 3, 1.0
        if c.problem.form[i] != CONE and c.problem.form[i] != DOUBLE:
            along = row_of(c.problem.along, i)
            square += along[0] * along[0] + along[1] * along[1]
        if row % 3 == 0:
            square += square_of_turning(c, i)
        weight[j] = 1.0 / square


@kernel
def factor_normal_equations(c: Contacts, p: int, rank: int, weight: Array) -> bool:
    """Write Cholesky's factor of A D⁻¹Aᵀ into `unknowns`, and its transpose above it; the columns of A as `columns`."""
    A, B, order, columns = c.scratch.system, c.scratch.unknowns, c.scratch.column_order, c.scratch.columns
    for q in range(rank):
        m = int(order[q])
        for j in range(p):
            columns[j, q] = A[m, j]
    for r in range(rank):
        i, row = int(order[r]), row_of(B, r)
        for q in range(r + 1):
            row[q] = 0.0
        for j in range(p):
            share = A[i, j] * weight[j]
            if share != 0.0:
                for q in range(r + 1):
                    row[q] += share * columns[j, q]
        whole = row[r]
        for q in range(r):
            row[q] /= B[q, q]
            if row[q] != 0.0:
                for t in range(q + 1, r):
                    row[t] -= row[q] * B[q, t]
                row[r] -= row[q] * row[q]
        if not row[r] > 1e-12 * whole:
            return False
        row[r] = math.sqrt(row[r])
        for q in range(r):
            B[q, r] = row[q]
    return True


@kernel
def refine(c: Contacts, p: int, rank: int, side: int, weight: Array, asked: float) -> bool:
    """Write x of one right-hand side, improved by what is left of it; return whether it is exact, but for rounding."""
    A, B, order, columns = c.scratch.system, c.scratch.unknowns, c.scratch.column_order, c.scratch.columns
    x, left, change = row_of(c.scratch.solution, side), c.scratch.trial, c.scratch.multiples
    worst, size = math.inf, 0.0
    for j in range(p):
        x[j] = 0.0
    for r in range(rank):
        size = max(size, abs(A[int(order[r]), p + side]))
    for _ in range(REFINEMENTS):
        worst = 0.0
        for r in range(rank):
            left[r] = A[int(order[r]), p + side]
        for j in range(p):
            subtract(left, x[j], row_of(columns, j), rank)
        for r in range(rank):
            worst = max(worst, abs(left[r]))
        if worst <= EXACT * size:
            break
        for t in range(rank):
            left[t] /= B[t, t]
            for r in range(t + 1, rank if left[t] != 0.0 else 0):
                left[r] -= left[t] * B[t, r]
        for r in range(rank - 1, -1, -1):
            for t in range(r + 1, rank):
                left[r] -= B[r, t] * left[t]
            left[r] /= B[r, r]
        for j in range(p):
            change[j] = 0.0
        for r in range(rank):
            subtract(change, -left[r], row_of(A, int(order[r])), p)
        for j in range(p):
            x[j] += weight[j] * change[j]
    return bool(worst <= max(EXACT * size, 1e-3 * EXACT * asked))
