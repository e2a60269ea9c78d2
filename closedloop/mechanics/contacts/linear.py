"""A square system of any rank: elimination with complete pivots."""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel

# A pivot below this share of the largest is rounding: the row depends on the others.
DEPENDENT = 1e-11


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
        row, column, largest = k, k, 0.0
        for i in range(k, p):
            for j in range(k, p):
                if abs(S[i, j]) > largest:
                    row, column, largest = i, j, abs(S[i, j])
        if k == 0:
            first = largest
        if not largest > dependent * first:
            rank = k
            break
        for j in range(p + sides):
            S[k, j], S[row, j] = S[row, j], S[k, j]
        for i in range(p):
            S[i, k], S[i, column] = S[i, column], S[i, k]
        order[k], order[column] = order[column], order[k]
        for i in range(k + 1, p):
            share = S[i, k] / S[k, k]
            if share != 0.0:
                for j in range(k + 1, p + sides):
                    S[i, j] -= share * S[k, j]
    for side in range(sides):
        for i in range(p):
            x[side, i] = 0.0
        for i in range(rank - 1, -1, -1):
            s = S[i, p + side]
            for j in range(i + 1, rank):
                s -= S[i, j] * x[side, int(order[j])]
            x[side, int(order[i])] = s / S[i, i]
    return rank
