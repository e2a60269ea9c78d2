"""The distance from a surface φ = 0, whatever function φ is: what a ball rests on.

The nearest point x of the surface to a point c, and c = x + g n(x), solve

    x − c + λ ∇φ(x) = 0,     φ(x) = 0,     g = λ |∇φ(x)|

by Newton's method from the first-order answer. As a function of c, g has the gradient n and the second derivatives
K (1 + g K)⁻¹, with the curvature K = (1 − n nᵀ) ∇∇φ (1 − n nᵀ)/|∇φ| at x: those of a surface parallel to the first (M.
P. do Carmo, Differential Geometry of Curves and Surfaces, Prentice-Hall 1976, §3-5). It has none where 1 + g K is not
positive: there a ball of radius g does not fit into the hollow.
"""

from __future__ import annotations

import math
from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel
from closedloop.mechanics.surface.geometry import Touch

# Newton steps at most, and the length of a step, m, that is rounding: relative to the distance from the origin too.
MOST_NEAREST, ROUNDING = 50, 1e-15


class Nearest(Block):
    """The search for the nearest point, in the surface's axes."""

    at: Annotated[Array, 3]  # x, m
    gradient: Annotated[Array, 3]
    hessian: Annotated[Array, 3, 3]
    factor: float  # λ
    step: Annotated[Array, 3]
    matrix: Annotated[Array, 3, 3]
    inverse: Annotated[Array, 3, 3]


@kernel
def begin_nearest(touch: Touch, near: Nearest) -> bool:
    """Write the first-order answer x, λ of a point whose level, gradient and Hessian `touch` has."""
    g, square = touch.gradient, 0.0
    for i in range(3):
        square += g[i] * g[i]
    if not 0.0 < square < math.inf:
        return False
    near.factor = touch.level / square
    for i in range(3):
        near.at[i] = touch.at[i] - near.factor * g[i]
    return True


@kernel
def improve_nearest(c: Array, level: float, near: Nearest) -> float:
    """Take a Newton step from x and λ, with φ, ∇φ and ∇∇φ at x; return its length, m, NaN where there is none."""
    A, B, g = near.matrix, near.inverse, near.gradient
    for i in range(3):
        for j in range(3):
            A[i, j] = near.factor * near.hessian[i, j] + (1.0 if i == j else 0.0)
    if not invert(A, B) > 0.0:
        return math.nan
    along, across = level, 0.0
    for i in range(3):
        y = z = 0.0
        for j in range(3):
            y -= B[i, j] * (near.at[j] - c[j] + near.factor * g[j])
            z += B[i, j] * g[j]
        near.step[i] = y
        along += g[i] * y
        across += g[i] * z
    change, size = along / across, 0.0
    for i in range(3):
        z = B[i, 0] * g[0] + B[i, 1] * g[1] + B[i, 2] * g[2]
        step = near.step[i] - change * z
        near.at[i] += step
        size += step * step
    near.factor += change
    return math.sqrt(size)


@kernel
def is_rounding(size: float, before: float, near: Nearest) -> bool:
    """Whether a Newton step of this length, m, is the last: it is rounding, or no longer shrinks near it."""
    x = near.at
    scale: float = ROUNDING * (1.0 + abs(x[0]) + abs(x[1]) + abs(x[2]))
    return size <= scale or (before <= size <= 1e4 * scale)


@kernel
def write_distance(near: Nearest, radius: float, touch: Touch) -> bool:
    """Write the distance less a radius, m, with gradient and Hessian, in place of φ; False where it has none."""
    g, size = near.gradient, 0.0
    for i in range(3):
        size += g[i] * g[i]
    size = math.sqrt(size)
    if not 0.0 < size < math.inf:
        return False
    n, K, A = touch.gradient, near.hessian, near.matrix
    gap = near.factor * size
    for i in range(3):
        n[i] = g[i] / size
    for k in range(2):  # (1 − n nᵀ) ∇∇φ (1 − n nᵀ)/|∇φ|: first the columns, then the rows
        for i in range(3):
            along = 0.0
            for j in range(3):
                along += n[j] * (K[i, j] if k == 0 else K[j, i])
            for j in range(3):
                if k == 0:
                    K[i, j] -= along * n[j]
                else:
                    K[j, i] -= along * n[j]
    for i in range(3):
        for j in range(3):
            K[i, j] /= size
            A[i, j] = gap * K[i, j] + (1.0 if i == j else 0.0)
    if not invert(A, near.inverse) > 0.0 or not A[0, 0] + A[1, 1] + A[2, 2] > 1.0:
        return False
    for i in range(3):
        for j in range(3):
            s = 0.0
            for m in range(3):
                s += K[i, m] * near.inverse[m, j]
            touch.hessian[i, j] = s
    touch.level = gap - radius
    return True


@kernel
def invert(A: Array, B: Array) -> float:
    """Write the inverse B of a matrix A (3, 3), and return its determinant; B is not finite where that is zero."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            B[j, i] = A[a, c] * A[b, d] - A[a, d] * A[b, c]
    det = A[0, 0] * B[0, 0] + A[0, 1] * B[1, 0] + A[0, 2] * B[2, 0]
    for i in range(3):
        for j in range(3):
            B[i, j] /= det
    return float(det)
