"""Which piece of an impact comes next: along one direction of friction, turning, or from rest."""

from __future__ import annotations

import math

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.impact.modes import SLIP, STICK, TURN
from closedloop.mechanics.impact.rest import leave_rest
from closedloop.mechanics.impact.taylor import ORDER, ImpactWork, expand_straight, expand_turning, first_reach, value

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
