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
from typing import Annotated

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel

# Order of the expansion. A step of e⁻² radii of convergence leaves a remainder of e⁻⁴⁰ = 4e-18, below rounding.
ORDER = 20
STEP = math.exp(-2.0)


class ImpactWork(Block):
    """Memory of an impact: the polynomials of a piece, a coefficient for each order, and what happened so far."""

    w1: Annotated[Array, ORDER + 1]  # slip velocity, m/s
    w2: Annotated[Array, ORDER + 1]
    r: Annotated[Array, ORDER + 1]  # its size, m/s
    un: Annotated[Array, ORDER + 1]  # normal velocity, m/s
    pn: Annotated[Array, ORDER + 1]  # what this piece adds to the impulses, N s
    p1: Annotated[Array, ORDER + 1]
    p2: Annotated[Array, ORDER + 1]
    work: Annotated[Array, ORDER + 1]  # ... to the work of the normal impulse, J
    energy: Annotated[Array, ORDER + 1]  # ... to the kinetic energy, J
    turned: Annotated[Array, ORDER + 1]  # slip velocity across a direction, m/s
    happened: float  # a sum of the bits of `closedloop.mechanics.impact.begin`


@kernel
def expand_straight(a: float, a1: float, a2: float, t1: float, t2: float, c: ImpactWork) -> None:
    """Write the polynomials in P_n of a piece with one direction of friction, from the velocities at its begin.

    `a`, `a1`, `a2` are du_n/dP_n, du_t1/dP_n and du_t2/dP_n, 1/kg; `t1`, `t2` are dP_t/dP_n.
    """
    c.w1[1], c.w2[1], c.un[1] = a1, a2, a
    c.w1[2], c.w2[2], c.un[2] = 0.0, 0.0, 0.0
    c.pn[1], c.p1[1], c.p2[1] = 1.0, t1, t2
    c.pn[2], c.p1[2], c.p2[2] = 0.0, 0.0, 0.0
    c.work[1], c.work[2] = c.un[0], 0.5 * a
    c.energy[1] = c.un[0] + t1 * c.w1[0] + t2 * c.w2[0]
    c.energy[2] = 0.5 * (a + t1 * a1 + t2 * a2)


@kernel
def expand_turning(S: Array, mu: float, c: ImpactWork) -> float:
    """Write the Taylor polynomials in τ of slip whose direction turns; return how far they reach.

    They begin with the velocities that are the first coefficients of `w1`, `w2` and `un`.
    """
    rate = (1.0 + mu) * (S[0, 0] + S[1, 1] + S[2, 2])
    for k in range(ORDER):
        d = 1.0 / (rate * (k + 1))
        x, y, r = c.w1[k], c.w2[k], c.r[k]
        c.w1[k + 1] = (S[1, 0] * r - mu * (S[1, 1] * x + S[1, 2] * y)) * d
        c.w2[k + 1] = (S[2, 0] * r - mu * (S[2, 1] * x + S[2, 2] * y)) * d
        c.un[k + 1] = (S[0, 0] * r - mu * (S[0, 1] * x + S[0, 2] * y)) * d
        c.pn[k + 1] = r * d
        c.p1[k + 1] = -mu * x * d
        c.p2[k + 1] = -mu * y * d
        power, square = 0.0, 0.0
        for j in range(k + 1):
            power += c.un[j] * c.r[k - j]
            square += c.r[j] * c.r[k - j]
        c.work[k + 1] = power * d
        c.energy[k + 1] = (power - mu * square) * d
        # r² = w1² + w2², its coefficient of order k + 1 solved for that of r
        square = 0.0
        for j in range(k + 2):
            square += c.w1[j] * c.w1[k + 1 - j] + c.w2[j] * c.w2[k + 1 - j]
        for j in range(1, k + 1):
            square -= c.r[j] * c.r[k + 1 - j]
        c.r[k + 1] = 0.5 * square / c.r[0]
    # Where the terms of the last two orders would be as large as r, the series ends to converge (Jorba & Zou 2005).
    # Slip that hardly turns has terms near 1e-308: 1e-200 keeps the powers of its reach finite.
    reach = np.inf
    for k in range(ORDER - 1, ORDER + 1):
        size = max(abs(c.w1[k]) / c.r[0], abs(c.w2[k]) / c.r[0], 1e-200)
        reach = min(reach, size ** (-1.0 / k))
    return STEP * reach


@kernel
def value(c: Array, degree: int, x: float) -> float:
    """Return a polynomial of these coefficients at x."""
    total: float = c[degree]
    for k in range(degree - 1, -1, -1):
        total = total * x + c[k]
    return total


@kernel
def first_reach(c: Array, degree: int, level: float, end: float) -> float:
    """Return where a polynomial of these coefficients takes the value `level` on its way from 0 to `end`, once.

    Newton's method inside a bracket that is halved whenever a step would leave it: at most 200 evaluations.
    """
    start = c[0] - level
    if start == 0.0:
        return 0.0
    low, high = 0.0, end
    x = 0.0
    f, slope = start, c[1]
    for _ in range(200):
        step = -f / slope if slope != 0.0 else np.inf
        new = x + step
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - x) <= 2e-16 * new:
            return new
        x = new
        f, slope = c[degree], 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + f
            f = f * x + c[k]
        f -= level
        if f == 0.0:
            return x
        if (f > 0.0) == (start > 0.0):
            low = x
        else:
            high = x
    return x
