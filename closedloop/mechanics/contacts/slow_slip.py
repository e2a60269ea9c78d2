"""Slow slips of several contacts: friction against what they are at the end of the step, found for all together."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import row_of
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.given_modes import own_mobility
from closedloop.mechanics.contacts.memory import LINE, RAY, Contacts
from closedloop.mechanics.friction.slow_slip import turn_to_end

Array = NDArray[np.float64]

# Turns through all contacts at most, and the change of a direction that is rounding.
SWEEPS, TURNED = 200, 1e-13


@kernel
def turn_slow_slips(c: Contacts, k: int, h: float) -> float:
    """Turn the friction of contacts that slip slowly to their slips at the end of the step h, s; return the change.

    Each in turn, with the normal forces as they are and the friction of the others: with these forces given, the sum of
    the powers is least where all agree, and turns through the contacts come to it (block coordinate descent).

    Parameters
    ----------
    c : Contacts
        In: u, direction, W, a, viscous, and `along` with the F of it. Written: `along`, and F_t.
    k : int
        Contacts.

    Returns
    -------
    float
        The largest change of a direction; 0 if no slip is slow.
    """
    most, d = 0.0, c.scratch.vector
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(k):
            if (c.problem.form[i] != RAY and c.problem.form[i] != LINE) or not stops_slipping(c, i):
                continue
            at, along = 3 * i, row_of(c.problem.along, i)
            level, f = math.hypot(along[0], along[1]), c.F[at]
            if not level * abs(f) > 0.0:
                continue
            own_mobility(c, i, c.scratch.slope)
            x1, x2 = -along[0] * f, -along[1] * f
            a1 = c.a[at + 1] - c.W[at + 1, at + 1] * x1 - c.W[at + 1, at + 2] * x2
            a2 = c.a[at + 2] - c.W[at + 2, at + 1] * x1 - c.W[at + 2, at + 2] * x2
            for j in range(3 * k):
                a1 += c.W[at + 1, j] * c.F[j]
                a2 += c.W[at + 2, j] * c.F[j]
            if not turn_to_end(
                c.scratch.slope, c.u[at + 1], c.u[at + 2], a1, a2, level * abs(f), h, row_of(c.direction, i), d
            ):
                continue
            side = math.copysign(level, f)
            change = max(change, math.hypot(side * d[0] - along[0], side * d[1] - along[1]) / level)
            along[0], along[1] = side * d[0], side * d[1]
            c.F[at + 1], c.F[at + 2] = -along[0] * f - c.viscous[at + 1], -along[1] * f - c.viscous[at + 2]
        most = max(most, change)
        if change <= TURNED:
            break
    return most
