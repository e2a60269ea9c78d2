"""Slow slip: dry friction makes the equation of motion stiff.

Dry friction μ|f| against a slip u turns the direction of u at the rate

    λ = μ|f| (S_11 + S_22)/|u|

towards the direction in which the tip accelerates, S the tip's mobility. Just after break-away λ is unbounded: where
static friction goes over into kinetic without a jump, |u| = j t²/2 with j the rate of the applied acceleration, and an
explicit scheme, whose steps are a few 1/λ, needs some μ|f| S/(3 j t₀) of them from t₀ on: 10⁶, if t₀ is where u exceeds
rounding. The solution is smooth: the direction follows the applied force. So

    FIXED_DIRECTION  up to the speed SETTLED, friction acts against the direction of break-away. The slip turns by no
                     more than 1e-5 rad in that time, with an effect below 1e-14 m/s
    IMPLICIT         from there on, as long as λ is large and slip changes slowly in 1/λ: Radau IIA of order five
                     (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.8, as in scipy)
    EXPLICIT         everywhere else: DOP853

A tip that is braked to rest has a large λ too, but briefly: the speed falls as fast as λ grows, and the explicit scheme
needs a step or two for each halving of it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from closedloop.base.arrays import Array
from closedloop.loop.step.memory import RIGID_STICK, State, Work
from closedloop.mechanics.closure.contact_force import PRESSED

Rate = Callable[[float, Array], Array]

EXPLICIT, IMPLICIT, FIXED_DIRECTION = range(3)

# Slip faster than this, m/s, has a well-defined direction: the rounding of a velocity is 1e-7 of it.
SETTLED = 1e-9
# From this λ on, 1/s, an explicit step of a few 1/λ is shorter than accuracy requires; slip changes slowly if by less
# than this share of itself in 1/λ.
STIFF_RATE, SLOW_CHANGE = 2e4, 0.1
# Tolerance of the slip in a step, relative to the slip itself: of its direction, rad.
DIRECTION_ERROR = 1e-4


def choose_scheme(w: Work, state: State, before: int) -> int:
    """Return the scheme for the next step, from the state evaluated last; `before` is the scheme of the last step.

    The implicit scheme ends at a λ four times smaller than that at which it begins, so that the two do not alternate.
    """
    if state.friction.sticking != RIGID_STICK or state.mode != PRESSED:
        return EXPLICIT
    slip, speed = w.tip.u[1:], float(np.hypot(*w.tip.u[1:]))
    if speed < 0.99 * SETTLED:  # not at it, where the step that has come so far ends
        return FIXED_DIRECTION
    turning = float(np.hypot(*w.friction.c) * abs(w.tip.F[0]) * (w.tip.S[1, 1] + w.tip.S[2, 2]))
    gaining = abs(float(slip @ (w.tip.A[1:] @ w.qdd + w.tip.drift_c[1:]))) / speed
    ease = 4.0 if before == IMPLICIT else 1.0
    return IMPLICIT if ease * turning > STIFF_RATE * speed and ease * SLOW_CHANGE * turning > gaining else EXPLICIT


def tolerance_for(w: Work, scheme: int, tolerance: float) -> float:
    """Return the relative tolerance of a step: that of the scenario, or less where slip is slow."""
    if scheme == EXPLICIT:
        return tolerance
    return min(tolerance, DIRECTION_ERROR * max(SETTLED, float(np.hypot(*w.tip.u[1:]))))


def jacobian(rate: Rate, t: float, y: Array, w: Work) -> Array:
    """Return ∂ẏ/∂y (N, N) by forward differences, with steps small against the slip, on which it depends most.

    Parameters
    ----------
    rate : callable
        ẏ(t, y).
    t, y
        Instant, s, and state (N,).
    w : Work
        The memory in which `rate` writes the slip u and the rows A of the state evaluated.
    """
    n = w.q.shape[0]
    slope = rate(t, y)
    slip = max(SETTLED, float(np.hypot(*w.tip.u[1:])))
    steps = np.maximum(1.0, np.abs(y)) * 1e-7
    steps[n : 2 * n] = np.minimum(1e-7, DIRECTION_ERROR * slip / np.maximum(np.hypot(w.tip.A[1], w.tip.A[2]), 1e-3))
    steps[:n] = np.minimum(1e-7, DIRECTION_ERROR * slip / max(float(np.max(np.abs(w.v))), 1e-3 * DIRECTION_ERROR))
    columns = []
    for j, step in enumerate(steps):
        near = y.copy()
        near[j] += step
        columns.append((rate(t, near) - slope) / (near[j] - y[j]))
    return np.stack(columns, axis=1)
