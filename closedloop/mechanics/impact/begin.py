"""The pieces of an impact: which comes next, along one direction of friction, turning, or from rest.

Friction holds a tip that does not slip, or the tip leaves in one direction. A tangential impulse t per unit of normal
impulse, |t| <= μ, changes the slip velocity by S_tn + S_tt t. The tip sticks if some t makes that zero. Else it starts
to slide along the one unit direction s whose own friction t = −μ s drives it on: S_tn − μ S_tt s = k s, k > 0. Both are
one statement: t minimises (1, t)·S (1, t) over the disk |t| <= μ. That is a convex problem, so there is no second
direction (found case by case by Bhatt & Koechling, J. Appl. Mech. 62, 1995).

In a piece every quantity is a polynomial of one parameter. During slip the tangential impulse grows against the slip
velocity w = (u_t1, u_t2), dP_t = −μ w/|w| dP_n, so

    du_t/dP_n = S_tn − μ S_tt w/|w|        du_n/dP_n = S_nn − μ S_nt·w/|w|        (Routh; Keller 1986)

which is singular where slip stops. With dτ = Λ dP_n/|w| it becomes linear but for the one square root r = |w|,

    Λ dw/dτ = S_tn r − μ S_tt w        Λ du_n/dτ = S_nn r − μ S_nt·w        Λ dP_n/dτ = r

and regular everywhere: r falls to zero only as τ → ∞. Its Taylor coefficients follow one from another
(`expand_turning`), the square root through r² = w·w. Where the direction of friction stays the same, the impulse P_n
itself is the parameter and the polynomials end at the second order (`expand_straight`): then nothing is approximated.

Work is that of the normal impulse, dW = u_n dP_n, and energy the change of kinetic energy, dE = u·dP.
"""

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


NEWTON, POISSON, STRONGE = 0, 1, 2

# What happened, as bits: `ImpactWork.happened` after a call of `closedloop.mechanics.impact.impact`. The tip slid;
# ended sticking; slip stopped and went on in another direction; slip turned; friction drove the tip into the surface
# for a while; there was a second compression; Newton's law would have created energy; held by friction, the tip cannot
# leave.
SLIP, STICK, REVERSAL, TURN, JAM, RECOMPRESSION, CUT, WEDGE = 1, 2, 4, 8, 16, 32, 64, 128

# A law of restitution by what its coefficient is the ratio of, see `closedloop.mechanics.impact.single`.
RATIOS = {"velocities": NEWTON, "impulses": POISSON, "energies": STRONGE}
MODE_NAMES = {
    SLIP: "slip",
    TURN: "turn",
    REVERSAL: "reversal",
    STICK: "stick",
    JAM: "jam",
    RECOMPRESSION: "recompression",
    CUT: "cut",
    WEDGE: "wedge",
}


# A direction along the plane whose mobility is below this share of the trace of S is one in which the tip cannot
# move: a planar arm's second tangent. Entries of S carry rounding of about 1e-16 of the trace.
IMMOBILE = 1e-14


@kernel
def leave_rest(S: Array, mu: float) -> tuple[float, float, float]:
    """Return t1, t2 and k: the tangential impulse per unit of normal impulse, and the rate of slip it leaves.

    k, 1/kg, is d|u_t|/dP_n along −(t1, t2): 0 where the tip sticks.
    """
    c1, c2, x, y = _principal_axes(S)
    b1, b2 = x * S[1, 0] + y * S[2, 0], x * S[2, 0] - y * S[1, 0]
    floor = IMMOBILE * (S[0, 0] + S[1, 1] + S[2, 2])
    if c1 <= floor:
        return 0.0, 0.0, 0.0
    if c2 <= floor:
        s1, s2 = b1 / c1, 0.0
        c2, b2 = 0.0, 0.0
    else:
        s1, s2 = _holding(S, x, y)
    if math.hypot(s1, s2) <= mu:
        return -(x * s1 - y * s2), -(y * s1 + x * s2), 0.0
    s1, s2 = _leaving(b1, b2, mu * c1, mu * c2)
    s1, s2 = x * s1 - y * s2, y * s1 + x * s2
    # The axes are rounded in the size of the larger mobility. In the axes of S itself a light direction is not, so the
    # direction is polished there: the part of S_tn − μ S_tt s across s is to be zero.
    k = 0.0
    for _ in range(2):
        d1, d2 = S[1, 1] * s1 + S[1, 2] * s2, S[2, 1] * s1 + S[2, 2] * s2
        a1, a2 = S[1, 0] - mu * d1, S[2, 0] - mu * d2
        k = s1 * a1 + s2 * a2
        stiff = k + mu * (S[1, 1] * s2 * s2 - 2.0 * S[1, 2] * s1 * s2 + S[2, 2] * s1 * s1)
        if c2 == 0.0 or not stiff > 0.0:
            break
        turn = (s1 * a2 - s2 * a1) / stiff
        size = math.hypot(1.0, turn)
        s1, s2 = (s1 - turn * s2) / size, (s2 + turn * s1) / size
    return -mu * s1, -mu * s2, max(k, 0.0)


@kernel
def _principal_axes(S: Array) -> tuple[float, float, float, float]:
    """Return the principal mobilities along the plane, c1 >= c2 >= 0, and the direction (x, y) of the first."""
    spread, off = 0.5 * (S[1, 1] - S[2, 2]), S[1, 2]
    c1 = 0.5 * (S[1, 1] + S[2, 2]) + math.hypot(spread, off)
    angle = 0.5 * math.atan2(off, spread)
    determinant = S[1, 1] * S[2, 2] - off * off
    return c1, max(determinant, 0.0) / c1 if c1 > 0.0 else 0.0, math.cos(angle), math.sin(angle)


@kernel
def _holding(S: Array, x: float, y: float) -> tuple[float, float]:
    """Return S_tt⁻¹ S_tn in the axes (x, y), (−y, x), by elimination with the larger pivot first."""
    i = 1 if S[1, 1] >= S[2, 2] else 2
    j = 3 - i
    share = S[i, j] / S[i, i]
    second = (S[j, 0] - share * S[i, 0]) / (S[j, j] - share * S[i, j])
    first = S[i, 0] / S[i, i] - share * second
    s1, s2 = (first, second) if i == 1 else (second, first)
    return x * s1 + y * s2, x * s2 - y * s1


@kernel
def _leaving(b1: float, b2: float, d1: float, d2: float) -> tuple[float, float]:
    """Return the unit vector (b1/(k + d1), b2/(k + d2)) with k > 0, d1 >= d2; at k = 0 it is longer than one.

    Newton's method on 1/length, concave in k: from below it approaches without ever passing.
    """
    k = max(0.0, math.hypot(b1, b2) - d1)
    s1, s2, length = b1, b2, 1.0
    for _ in range(60):
        s1 = b1 / (k + d1)
        s2 = b2 / (k + d2) if b2 != 0.0 else 0.0
        square = s1 * s1 + s2 * s2
        length = math.sqrt(square)
        step = (length - 1.0) * square / (s1 * s1 / (k + d1) + (s2 * s2 / (k + d2) if b2 != 0.0 else 0.0))
        if step <= 4e-16 * k:
            break
        k += step
    return s1 / length, s2 / length


# Slip below this share of the tip's speed is none: a tip that sticks, and rounding.
STILL = 1e-14
# Slip that will stop, and until then strays from a straight line by less than this share of the speed, is straight.
STRAY = 1e-15

STRAIGHT, TURNING, RESTING = 0, 1, 2


@kernel
def begin_piece(S: Array, mu: float, speed: float, c: ImpactWork) -> tuple[int, float, int]:
    """Expand the next piece; return its kind, its length (inf: until the impact ends), its bits.

    It begins with the velocities that are the first coefficients of `w1`, `w2` and `un`.
    """
    x, y = c.w1[0], c.w2[0]
    r = math.hypot(x, y)
    c.r[0] = r
    if mu == 0.0:
        expand_straight(S[0, 0], S[1, 0], S[2, 0], 0.0, 0.0, c)
        return STRAIGHT, np.inf, 0
    if r <= STILL * speed:
        c.w1[0], c.w2[0], c.r[0] = 0.0, 0.0, 0.0
        t1, t2, k = leave_rest(S, mu)
        expand_straight(S[0, 0] + S[0, 1] * t1 + S[0, 2] * t2, -k * t1 / mu, -k * t2 / mu, t1, t2, c)
        return RESTING, np.inf, SLIP if k > 0.0 else STICK
    s1, s2 = x / r, y / r
    a1 = S[1, 0] - mu * (S[1, 1] * s1 + S[1, 2] * s2)
    a2 = S[2, 0] - mu * (S[2, 1] * s1 + S[2, 2] * s2)
    along, across = s1 * a1 + s2 * a2, abs(s1 * a2 - s2 * a1)
    rounding = 1e-15 * (abs(S[1, 0]) + abs(S[2, 0]) + mu * (S[1, 1] + S[2, 2]))
    if across <= rounding or (along < 0.0 and r * across <= -along * STRAY * speed):
        a = S[0, 0] - mu * (S[0, 1] * s1 + S[0, 2] * s2)
        expand_straight(a, along * s1, along * s2, -mu * s1, -mu * s2, c)
        return STRAIGHT, r / -along if along < 0.0 else np.inf, SLIP
    return TURNING, expand_turning(S, mu, c), SLIP | TURN


@kernel
def to_extremum(S: Array, mu: float, length: float, c: ImpactWork) -> float:
    """Shorten a turning piece to where slip passes a direction with du_n/dP_n = S_nn − μ S_nt·s = 0.

    There are two such directions s or none, and slip turns one way: between them u_n is monotone.
    """
    steep = mu * math.hypot(S[0, 1], S[0, 2])
    if steep <= S[0, 0]:
        return length
    towards = math.atan2(S[0, 2], S[0, 1])
    for side in range(2):
        angle = towards + (2 * side - 1) * math.acos(S[0, 0] / steep)
        s1, s2 = math.cos(angle), math.sin(angle)
        for k in range(ORDER + 1):
            c.turned[k] = s1 * c.w2[k] - s2 * c.w1[k]
        before, beyond = c.turned[0], value(c.turned, ORDER, length)
        if abs(before) > 1e-12 * c.r[0] and (before > 0.0) != (beyond > 0.0):
            length = first_reach(c.turned, ORDER, 0.0, length)
    return length
