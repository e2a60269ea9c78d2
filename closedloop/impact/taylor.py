"""One piece of an impact: every quantity as a polynomial of one parameter.

During slip the tangential impulse grows against the slip velocity w = (u_t1, u_t2), dP_t = −μ w/|w| dP_n, so

    du_t/dP_n = S_tn − μ S_tt w/|w|        du_n/dP_n = S_nn − μ S_nt·w/|w|        (Routh; Keller 1986)

which is singular where slip stops. With dτ = Λ dP_n/|w| it becomes linear but for the one square root r = |w|,

    Λ dw/dτ = S_tn r − μ S_tt w        Λ du_n/dτ = S_nn r − μ S_nt·w        Λ dP_n/dτ = r

and regular everywhere: r falls to zero only as τ → ∞. Its Taylor coefficients follow one from another
(`expand_turning`), the square root through r² = w·w. Where the direction of friction stays the same, the impulse P_n
itself is the parameter and the polynomials end at the second order (`expand_straight`): then nothing is approximated.

Work is that of the normal impulse, dW = u_n dP_n, and energy the change of kinetic energy, dE = u·dP.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]

# Order of the expansion. A step of e⁻² radii of convergence leaves a remainder of e⁻⁴⁰ = 4e-18, below rounding.
ORDER = 20
STEP = math.exp(-2.0)

# Rows of the coefficients: slip velocity and its size, normal velocity, m/s; then what this piece adds to the three
# impulses, N s, to the work of the normal impulse and to the energy, J. The last row is for a quantity of the moment.
W1, W2, R, UN, PN, P1, P2, WORK, ENERGY, OTHER = range(10)
ROWS = 10


@kernel
def expand_straight(a: float, a1: float, a2: float, t1: float, t2: float, c: Array) -> None:
    """Write the polynomials in P_n of a piece with one direction of friction, from the velocities in column 0.

    `a`, `a1`, `a2` are du_n/dP_n, du_t1/dP_n and du_t2/dP_n, 1/kg; `t1`, `t2` are dP_t/dP_n.
    """
    for row in range(OTHER):
        c[row, 1] = 0.0
        c[row, 2] = 0.0
    c[W1, 1], c[W2, 1], c[UN, 1] = a1, a2, a
    c[PN, 1], c[P1, 1], c[P2, 1] = 1.0, t1, t2
    c[WORK, 1], c[WORK, 2] = c[UN, 0], 0.5 * a
    c[ENERGY, 1] = c[UN, 0] + t1 * c[W1, 0] + t2 * c[W2, 0]
    c[ENERGY, 2] = 0.5 * (a + t1 * a1 + t2 * a2)


@kernel
def expand_turning(S: Array, mu: float, c: Array) -> float:
    """Write the Taylor polynomials in τ of slip whose direction turns, from column 0; return how far they reach."""
    rate = (1.0 + mu) * (S[0, 0] + S[1, 1] + S[2, 2])
    for k in range(ORDER):
        d = 1.0 / (rate * (k + 1))
        x, y, r = c[W1, k], c[W2, k], c[R, k]
        c[W1, k + 1] = (S[1, 0] * r - mu * (S[1, 1] * x + S[1, 2] * y)) * d
        c[W2, k + 1] = (S[2, 0] * r - mu * (S[2, 1] * x + S[2, 2] * y)) * d
        c[UN, k + 1] = (S[0, 0] * r - mu * (S[0, 1] * x + S[0, 2] * y)) * d
        c[PN, k + 1] = r * d
        c[P1, k + 1] = -mu * x * d
        c[P2, k + 1] = -mu * y * d
        power, square = 0.0, 0.0
        for j in range(k + 1):
            power += c[UN, j] * c[R, k - j]
            square += c[R, j] * c[R, k - j]
        c[WORK, k + 1] = power * d
        c[ENERGY, k + 1] = (power - mu * square) * d
        # r² = w1² + w2², its coefficient of order k + 1 solved for that of r
        square = 0.0
        for j in range(k + 2):
            square += c[W1, j] * c[W1, k + 1 - j] + c[W2, j] * c[W2, k + 1 - j]
        for j in range(1, k + 1):
            square -= c[R, j] * c[R, k + 1 - j]
        c[R, k + 1] = 0.5 * square / c[R, 0]
    # Where the terms of the last two orders would be as large as r, the series ends to converge (Jorba & Zou 2005).
    # Slip that hardly turns has terms near 1e-308: 1e-200 keeps the powers of its reach finite.
    reach = np.inf
    for k in range(ORDER - 1, ORDER + 1):
        size = max(abs(c[W1, k]) / c[R, 0], abs(c[W2, k]) / c[R, 0], 1e-200)
        reach = min(reach, size ** (-1.0 / k))
    return STEP * reach


@kernel
def value(c: Array, row: int, degree: int, x: float) -> float:
    """Return the polynomial of a row at x."""
    total: float = c[row, degree]
    for k in range(degree - 1, -1, -1):
        total = total * x + c[row, k]
    return total


@kernel
def first_reach(c: Array, row: int, degree: int, level: float, end: float) -> float:
    """Return where the polynomial of a row takes the value `level` on its way from 0 to `end`, once.

    Newton's method inside a bracket that is halved whenever a step would leave it: at most 200 evaluations.
    """
    start = c[row, 0] - level
    if start == 0.0:
        return 0.0
    low, high = 0.0, end
    x = 0.0
    f, slope = start, c[row, 1]
    for _ in range(200):
        step = -f / slope if slope != 0.0 else np.inf
        new = x + step
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - x) <= 2e-16 * new:
            return new
        x = new
        f, slope = c[row, degree], 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + f
            f = f * x + c[row, k]
        f -= level
        if f == 0.0:
            return x
        if (f > 0.0) == (start > 0.0):
            low = x
        else:
            high = x
    return x
