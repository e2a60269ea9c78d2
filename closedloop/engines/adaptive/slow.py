"""Slow slip: where friction turns with the slip faster than an explicit scheme can follow.

Dry friction μ|f| along a slip u turns it with the rate

    λ = μ|f| (S_11 + S_22)/|u|

towards the direction in which the tip accelerates, S the tip's mobility. Of a tip that has just broken away this is
beyond any bound: where static friction goes over into kinetic without a jump, |u| = j t²/2 with j the jerk of what
pulls, and an explicit scheme, whose steps are a few 1/λ, needs some μ|f| S/(3 j t₀) of them from t₀ on: 10⁶, if it
starts from where rounding ends. Yet the motion is smooth: the direction follows what pulls. So

    KEPT       up to SETTLED the friction keeps to the direction in which slip broke away. It turns by no more than
               1e-5 rad in that time, and what that makes of the motion is below 1e-14 m/s
    STIFF      from there on, as long as λ is large and slip changes slowly beside it, the scheme is implicit: Radau IIA
               of order five (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.8, as in scipy)
    PLAIN      everywhere else, DOP853

A tip that is braked to rest has a large λ too, but not for long: the speed falls as fast as λ grows, and the explicit
scheme needs a step or two for each halving of it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import PRESSED
from closedloop.step.memory import RIGID_STICK, State, Work

Array = NDArray[np.float64]
Rate = Callable[[float, Array], Array]

PLAIN, STIFF, KEPT = range(3)

# Slip faster than this, m/s, has a direction of its own: what rounding leaves of a velocity is 1e-7 of it.
SETTLED = 1e-9
# An explicit step is a few 1/λ. From this λ on, 1/s, that is shorter than what else happens asks for; and slip is in no
# hurry if it changes by less than this share of itself in 1/λ.
STIFF_RATE, CALM = 2e4, 0.1
# Error of the slip that a step may make, relative to the slip itself: of a direction, rad.
TURN = 1e-4


def manner_of(w: Work, state: State, before: int) -> int:
    """Return how to go on from the state evaluated last, in the memory `w`, `state`; `before` is how it went on.

    Leaving the implicit scheme takes a λ four times smaller than taking it up, so that the two do not alternate.
    """
    if state.sticking != RIGID_STICK or state.mode != PRESSED:
        return PLAIN
    slip, speed = w.u[1:], float(np.hypot(*w.u[1:]))
    if speed < 0.99 * SETTLED:  # not at it, where the step that has come so far ends
        return KEPT
    turning = float(np.hypot(*w.c) * abs(w.F[0]) * (w.S[1, 1] + w.S[2, 2]))
    gaining = abs(float(slip @ (w.A[1:] @ w.qdd + w.drift_c[1:]))) / speed
    ease = 4.0 if before == STIFF else 1.0
    return STIFF if ease * turning > STIFF_RATE * speed and ease * CALM * turning > gaining else PLAIN


def tolerance_for(w: Work, manner: int, tolerance: float) -> float:
    """Return the relative error that a step may make: that of the scenario, or less where slip is slow."""
    if manner == PLAIN:
        return tolerance
    return min(tolerance, TURN * max(SETTLED, float(np.hypot(*w.u[1:]))))


def jacobian(rate: Rate, t: float, y: Array, w: Work) -> Array:
    """Return ∂ẏ/∂y (N, N) by differences that are small against the slip, which alone makes it large.

    Parameters
    ----------
    rate : callable
        ẏ(t, y).
    t, y
        Instant, s, and state (N,).
    w : Work
        The memory in which `rate` leaves the slip u and the rows A of the state it was asked for.
    """
    n = w.q.shape[0]
    slope = rate(t, y)
    slip = max(SETTLED, float(np.hypot(*w.u[1:])))
    steps = np.maximum(1.0, np.abs(y)) * 1e-7
    steps[n : 2 * n] = np.minimum(1e-7, TURN * slip / np.maximum(np.hypot(w.A[1], w.A[2]), 1e-3))
    steps[:n] = np.minimum(1e-7, TURN * slip / max(float(np.max(np.abs(w.v))), 1e-3 * TURN))
    columns = []
    for j, step in enumerate(steps):
        near = y.copy()
        near[j] += step
        columns.append((rate(t, near) - slope) / (near[j] - y[j]))
    return np.stack(columns, axis=1)
