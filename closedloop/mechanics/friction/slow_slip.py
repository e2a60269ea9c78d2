"""The direction of friction where slip is so slow that friction turns it within a step."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import IMMOBILE
from closedloop.mechanics.friction.law import STILL

Array = NDArray[np.float64]


@kernel
def turn_to_end(
    S: Array, u1: float, u2: float, a1: float, a2: float, largest: float, h: float, before: Array, d: Array
) -> bool:
    """Write the direction of a slow slip at the end of the step; return whether the slip is slow.

    Friction turns a slip u with the rate L s/|u|, L = μ|f| its size and s the mobility along the surface. Where that is
    above 1/h, a step that takes friction against the present u throws the point from side to side, and at last no step
    is short enough. There the direction d is that of the slip u⁺ at the end of the step,

        u⁺ + h L S_t d = u + h a_t,    d = u⁺/|u⁺|

    as in time stepping (J. J. Moreau, 1988): one equation for |u⁺|, by bisection. If friction is enough to stop the
    point within the step, d is such that it goes straight to rest. A slip that has only just broken away is u = 0: what
    rounding has left of it has no direction, and must decide nothing.

    Parameters
    ----------
    S : (3, 3) array
        Mobility along n, t1, t2, 1/kg.
    u1, u2, a1, a2 : float
        Slip, m/s, and its acceleration without the friction L d, m/s².
    largest : float
        L, N.
    h : float
        The step, s.
    before : (2,) array
        Direction of the slip at the beginning of the substep.
    d : (2,) array
        Written, of unit length, if the slip is slow.
    """
    speed, reach, trace = math.hypot(u1, u2), h * largest, S[1, 1] + S[2, 2]
    if not reach * trace > speed:
        return False
    before1, before2, rests = u1, u2, speed <= STILL
    if rests:
        u1, u2, before1, before2 = 0.0, 0.0, before[0], before[1]
    elif not u1 * before[0] + u2 * before[1] > 0.0:
        return False  # past the end of slip
    det = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    if not det > IMMOBILE * trace * trace:
        return False  # a point that moves along a line does not turn
    p1, p2 = (S[2, 2] * u1 - S[1, 2] * u2) / det, (S[1, 1] * u2 - S[1, 2] * u1) / det
    q1, q2 = (S[2, 2] * a1 - S[1, 2] * a2) / det, (S[1, 1] * a2 - S[1, 2] * a1) / det
    if math.hypot(p1 / h + q1, p2 / h + q2) < largest:
        if rests:
            return False  # it does not leave: friction is against the direction in which it is pulled
        along, square = p1 * q1 + p2 * q2, p1 * p1 + p2 * p2
        rate = (math.sqrt(along * along + square * (largest * largest - q1 * q1 - q2 * q2)) - along) / square
        d1, d2 = rate * p1 + q1, rate * p2 + q2
    else:
        g11, g12, g22 = reach * S[1, 1], reach * S[1, 2], reach * S[2, 2]
        x1, x2 = u1 + h * a1, u2 + h * a2
        low, high, d1, d2 = 0.0, math.hypot(x1, x2), x1, x2
        for _ in range(60):
            s = 0.5 * (low + high)
            det = (s + g11) * (s + g22) - g12 * g12
            d1, d2 = ((s + g22) * x1 - g12 * x2) / det, ((s + g11) * x2 - g12 * x1) / det
            low, high = (s, high) if math.hypot(d1, d2) > 1.0 else (low, s)
            if high - low <= 1e-14 * high:
                break
    size = math.hypot(d1, d2)
    if not size > 0.0 or d1 * before1 + d2 * before2 < 0.0:
        return False  # slip ends within the step; until then friction is against it
    d[0], d[1] = d1 / size, d2 / size
    return True
