"""The joint velocity of least norm for a given velocity of the tip, with its turning or without."""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel

# Singular values of Jᵣ below this share of the largest count as zero: the arm cannot move the tip in that direction.
RANK_TOLERANCE = 1e-6
# Rows are orthogonal when their product is below this share of the product of their lengths: rounding.
ORTHOGONAL = 1e-15
# A row whose square is below this, where the largest entry is 1, is rounding, far below `RANK_TOLERANCE`.
NOTHING = 1e-40
# Sweeps over the pairs of rows; they converge quadratically, so six do.
SWEEPS = 30


@kernel
def least_norm(J: Array, wanted: Array, W: Array, c: Array, rate: Array) -> None:
    """Write q̇ = Jᵣ⁺ ṙ (Moore-Penrose): the smallest q̇ that gives the tip ṙ as nearly as it can.

    The singular value decomposition by one-sided Jacobi rotations (M. R. Hestenes, J. SIAM 6, 1958; G. H. Golub and
    C. F. Van Loan, Matrix Computations, 4th ed., 8.6.3): with an orthogonal U that makes the rows of W = U Jᵣ
    orthogonal to each other, and c = U ṙ, q̇ is the sum of Wᵢ cᵢ/|Wᵢ|² over the rows that are not zero; their lengths
    are the singular values. Small ones are as accurate as large ones, which those of Jᵣ Jᵣᵀ would not be.

    Parameters
    ----------
    J : (m, n) array
        Jᵣ, and what else is to move, a row each.
    wanted : (m,) array
        ṙ, m/s, and the rates of the rest.
    W, c : (m, n), (m,) arrays
        Scratch.
    rate : (n,) array
        Written: q̇, rad/s (m/s); NaN if an entry of J or `wanted` is not finite.
    """
    m, n = J.shape
    size, finite = 0.0, True
    for i in range(m):
        finite = finite and math.isfinite(wanted[i])
        for j in range(n):
            finite = finite and math.isfinite(J[i, j])
            size = max(size, abs(J[i, j]))
    for j in range(n):
        rate[j] = 0.0 if finite else math.nan
    if size == 0.0 or not finite:
        return
    for i in range(m):
        c[i] = wanted[i]
        for j in range(n):
            W[i, j] = J[i, j] / size  # so that no square overflows
    make_rows_orthogonal(W, c)
    longest = 0.0
    for i in range(m):
        square = 0.0
        for j in range(n):
            square += W[i, j] * W[i, j]
        longest = max(longest, square)
    for i in range(m):
        square = 0.0
        for j in range(n):
            square += W[i, j] * W[i, j]
        if square > RANK_TOLERANCE * RANK_TOLERANCE * longest:
            share = c[i] / square / size
            for j in range(n):
                rate[j] += W[i, j] * share


@kernel
def make_rows_orthogonal(W: Array, c: Array) -> None:
    """Turn the rows of W (m, n), and c (m,) with them, by Jacobi rotations until they are orthogonal to each other."""
    m, n = W.shape
    turned, sweep = True, 0
    while turned and sweep < SWEEPS:
        turned, sweep = False, sweep + 1
        for i in range(m - 1):
            for k in range(i + 1, m):
                first = second = product = 0.0
                for j in range(n):
                    first += W[i, j] * W[i, j]
                    second += W[k, j] * W[k, j]
                    product += W[i, j] * W[k, j]
                if min(first, second) > NOTHING and abs(product) > ORTHOGONAL * math.sqrt(first * second):
                    turned = True
                    cot = (second - first) / (2.0 * product)  # of twice the angle
                    tan = math.copysign(1.0, cot) / (abs(cot) + math.sqrt(1.0 + cot * cot))
                    cos = 1.0 / math.sqrt(1.0 + tan * tan)
                    sin = cos * tan
                    for j in range(n):
                        W[i, j], W[k, j] = cos * W[i, j] - sin * W[k, j], sin * W[i, j] + cos * W[k, j]
                    c[i], c[k] = cos * c[i] - sin * c[k], sin * c[i] + cos * c[k]
