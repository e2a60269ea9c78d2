"""What friction does to a tip that does not slip: it holds the tip, or the tip leaves in one direction.

A tangential impulse t per unit of normal impulse, |t| <= μ, changes the slip velocity by S_tn + S_tt t. The tip sticks
if some t makes that zero. Else it starts to slide along the one unit direction s whose own friction t = −μ s drives it
on: S_tn − μ S_tt s = k s, k > 0. Both are one statement: t minimises (1, t)·S (1, t) over the disk |t| <= μ. That is a
convex problem, so there is no second direction (found case by case by Bhatt & Koechling, J. Appl. Mech. 62, 1995).
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel

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
