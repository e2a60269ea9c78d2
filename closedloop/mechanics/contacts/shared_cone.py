"""The cone of a contact with its resistances to rolling and pivoting, which share its normal force.

It has F = f v + the parts x_a of those that stick, with |x_a| <= μ_a f, and v = (1, −along) of what slides or rolls.
Its point nearest to y, for forces of least norm, has the f at which

    |v|² f = v·y + Σ μ_a (|y_a| − μ_a f)   over those a that reach their edge, μ_a f < |y_a|

and x_a = y_a, or μ_a f y_a/|y_a| at the edge.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import CONE, OFF, Contacts
from closedloop.mechanics.contacts.resistance import resistance_of

# Parts of such a contact: its friction, its resistance to rolling and that to pivoting. The f of the nearest point is
# found within so many rounds, for in each another part reaches its edge.
PARTS = 3


@kernel
def part_of(c: Contacts, i: int, a: int) -> int:
    """Return the contact whose tangents are part a of contact i; −1 if there is none, or it gives nothing."""
    s = i if a == 0 else resistance_of(c, i, a - 1)
    return s if s >= 0 and c.problem.form[s] != OFF else -1


@kernel
def nearest_shared(c: Contacts, i: int, y: Array, spans: bool, F: Array) -> None:
    """Write F (3 k,) of contact i and its resistances nearest to y (3 k,); with `spans` in the space of their cones.

    The normal force of a resistance, which is that of its contact, is left zero.
    """
    fixed, along = 1.0, y[3 * i]
    for a in range(PARTS):
        s = part_of(c, i, a)
        if s >= 0 and c.problem.form[s] != CONE:
            for t in range(2):
                v = -c.problem.along[s, t]
                fixed += v * v
                along += v * y[3 * s + 1 + t]
    f = along / fixed
    for _ in range(0 if spans else PARTS + 1):
        above, below = along, fixed
        for a in range(PARTS):
            s = part_of(c, i, a)
            if s >= 0 and c.problem.form[s] == CONE:
                size = math.hypot(y[3 * s + 1], y[3 * s + 2])
                if size > c.mu[s] * f:
                    above += c.mu[s] * size
                    below += c.mu[s] * c.mu[s]
        f = above / below
    if not spans:
        f = max(f, 0.0)
    F[3 * i] = f
    for a in range(PARTS):
        s = i if a == 0 else resistance_of(c, i, a - 1)
        if s < 0:
            continue
        for t in range(2):
            r = 3 * s + 1 + t
            if c.problem.form[s] == OFF:
                F[r] = 0.0
            elif c.problem.form[s] != CONE:
                F[r] = -c.problem.along[s, t] * f
            else:
                size = math.hypot(y[3 * s + 1], y[3 * s + 2])
                F[r] = y[r] if spans or size <= c.mu[s] * f else c.mu[s] * f / size * y[r]


@kernel
def add_shared_slope(c: Contacts, i: int, y: Array, spans: bool, F: Array, Y: Array, S: Array) -> None:
    """Add Yᵀ D Y of contact i and its resistances to S; D is the derivative of `nearest_shared` at y, which gave F."""
    n, f = Y.shape[1], F[3 * i]
    if not spans and not f > 0.0:
        return
    square, v = 1.0, c.scratch.sum_trial
    for j in range(n):
        v[j] = Y[3 * i, j]
    for a in range(PARTS):
        s = part_of(c, i, a)
        if s < 0:
            continue
        t1, t2 = 3 * s + 1, 3 * s + 2
        if c.problem.form[s] != CONE:
            v1, v2 = -c.problem.along[s, 0], -c.problem.along[s, 1]
            square += v1 * v1 + v2 * v2
            for j in range(n):
                v[j] += v1 * Y[t1, j] + v2 * Y[t2, j]
            continue
        size, mu = math.hypot(y[t1], y[t2]), c.mu[s]
        if spans or size <= mu * f:
            for j in range(n):
                for m in range(n):
                    S[j, m] += Y[t1, j] * Y[t1, m] + Y[t2, j] * Y[t2, m]
            continue
        d1, d2, turn = y[t1] / size, y[t2] / size, mu * f / size
        square += mu * mu
        for j in range(n):
            v[j] += mu * (d1 * Y[t1, j] + d2 * Y[t2, j])
        for j in range(n):
            across = turn * (d1 * Y[t2, j] - d2 * Y[t1, j])
            for m in range(n):
                S[j, m] += across * (d1 * Y[t2, m] - d2 * Y[t1, m])
    for j in range(n):
        for m in range(n):
            S[j, m] += v[j] * v[m] / square
