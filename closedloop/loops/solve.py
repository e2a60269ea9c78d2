"""What the rows of loop joints leave free, in the metric of the mass matrix.

With H = L Lᵀ and y = Lᵀq̈, the rows G q̈ = b are Z y = b, Z = G L⁻ᵀ. An orthonormal basis of the rows of Z splits
every y into a part that the loops determine and one that they leave free; a force of the loops changes the first alone.
So the equation of motion, contact and impact of the closed mechanism are those of the tree, on the second part
(`closedloop.step.closed_loops`).

Rows that depend on others (a doubled link, a Bennett linkage) add no direction to the basis. Their number is found at
each state: no row is regularised.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]

# A row of which no more than this share is outside the span of the rows before it depends on them. A row that is
# shorter than the longest by this factor is rounding: no joint of the tree moves what it binds.
DEPENDENT, NO_ROW = 1e-8, 1e-11
# What is left of a row's length is kept up to date by what is taken off, and measured again below this share of its
# square; and the share of its length below which a row is orthogonalised once more: above it, it is so to rounding.
MEASURED_AGAIN, ONCE_MORE = 1e-4, 0.1


@kernel
def orthonormal_rows(Z: Array, m: int, most: int, order: Array, coefficients: Array, lengths: Array) -> int:
    """Replace the rows of Z by an orthonormal basis of them, and return how many it has.

    Gram and Schmidt's method, modified; the row that is farthest from the span, relative to its own length, is taken
    next, and orthogonalised once more (L. Giraud, J. Langou and M. Rozložník, Comput. Math. Appl. 50, 2005).

    Parameters
    ----------
    Z : (>= m, n) array
        In: m rows. Out: the basis, in the first rows.
    most : int
        How many it may have.
    order : (m,) array
        Written: which row each direction was made of.
    coefficients : (m, m) array
        Written: of these rows in the basis, lower triangular.
    lengths : (m,) array
        Scratch.
    """
    n, longest = Z.shape[1], 0.0
    for i in range(m):
        square = dot(Z[i], Z[i], n)
        order[i], lengths[i], coefficients[i, i] = i, math.sqrt(square), square
        longest = max(longest, lengths[i])
    for k in range(most):
        best, share = -1, DEPENDENT * DEPENDENT
        for i in range(k, m):  # until a row is taken its diagonal holds the square of what is left of it
            whole = lengths[i] * lengths[i]
            if lengths[i] > NO_ROW * longest and coefficients[i, i] > share * whole:
                best, share = i, coefficients[i, i] / whole
        if best < 0:
            return k
        if best != k:
            order[k], order[best] = order[best], order[k]
            lengths[k], lengths[best] = lengths[best], lengths[k]
            for j in range(n):
                Z[k, j], Z[best, j] = Z[best, j], Z[k, j]
            for j in range(k):
                coefficients[k, j], coefficients[best, j] = coefficients[best, j], coefficients[k, j]
            coefficients[best, best] = coefficients[k, k]
        if not share > ONCE_MORE * ONCE_MORE:
            for i in range(k):
                coefficients[k, i] += _take_off(Z[k], Z[i], n)
        length = math.sqrt(dot(Z[k], Z[k], n))
        coefficients[k, k] = length
        for j in range(n):
            Z[k, j] /= length
        for i in range(k + 1, m):
            taken = _take_off(Z[i], Z[k], n)
            left = coefficients[i, i] - taken * taken
            coefficients[i, k] = taken
            if not left > MEASURED_AGAIN * lengths[i] * lengths[i]:
                left = dot(Z[i], Z[i], n)
            coefficients[i, i] = left
    return most


@kernel
def dot(x: Array, y: Array, n: int) -> float:
    """Return the product of the first n entries of x and y, by four sums that do not wait for each other."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    even = n - n % 4
    for j in range(0, even, 4):
        a += x[j] * y[j]
        b += x[j + 1] * y[j + 1]
        c += x[j + 2] * y[j + 2]
        d += x[j + 3] * y[j + 3]
    for j in range(even, n):
        a += x[j] * y[j]
    return (a + b) + (c + d)


@kernel
def _take_off(x: Array, direction: Array, n: int) -> float:
    """Subtract from x its component along a direction of length one, and return that component."""
    component = dot(x, direction, n)
    for j in range(n):
        x[j] -= component * direction[j]
    return component


@kernel
def substitute_rows(L: Array, Z: Array, m: int) -> None:
    """Replace the first m rows z of Z by L⁻¹z, for the factor with the reciprocals of its diagonal on it.

    An entry of L⁻¹z is taken off all below it as soon as it is known, so that they do not wait for each other's sums.
    """
    n = Z.shape[1]
    for k in range(m):
        for j in range(n):
            z = Z[k, j] * L[j, j]
            Z[k, j] = z
            if z != 0.0:
                for i in range(j + 1, n):
                    Z[k, i] -= L[i, j] * z


@kernel
def remove_basis(x: Array, basis: Array, rank: int) -> None:
    """Subtract from x (n,) all that lies along the basis."""
    for _ in range(2):  # where little is left of x, once leaves rounding of what has gone
        for k in range(rank):
            _take_off(x, basis[k], x.shape[0])


@kernel
def meet_rows(b: Array, order: Array, coefficients: Array, basis: Array, rank: int, along: Array, y: Array) -> None:
    """Write the shortest y (n,) with Z y = b (m,) for the rows Z that the basis was made of; `along` (m,): scratch."""
    for j in range(y.shape[0]):
        y[j] = 0.0
    for k in range(rank):
        s = b[int(order[k])]
        for i in range(k):
            s -= coefficients[k, i] * along[i]
        along[k] = s / coefficients[k, k]
        for j in range(y.shape[0]):
            y[j] += along[k] * basis[k, j]


@kernel
def spanned_force(t: Array, order: Array, coefficients: Array, basis: Array, rank: int, force: Array) -> None:
    """Write forces (m,) of the rows Z with Zᵀ force = t (n,), zero of dependent rows; t counts along the basis."""
    for i in range(force.shape[0]):
        force[i] = 0.0
    for k in range(rank - 1, -1, -1):
        s = dot(basis[k], t, t.shape[0])
        for i in range(k + 1, rank):
            s -= coefficients[i, k] * force[int(order[i])]
        force[int(order[k])] = s / coefficients[k, k]
