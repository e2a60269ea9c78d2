"""Slow slip: dry friction makes the equation of motion stiff.

Dry friction μ|f| against a slip u turns the direction of u at the rate

    λ = μ|f| (S_11 + S_22)/|u|

towards the direction in which the contact accelerates, S its mobility. Just after break-away λ is unbounded: where
static friction goes over into kinetic without a jump, |u| = j t²/2 with j the rate of the applied acceleration, and an
explicit scheme, whose steps are a few 1/λ, needs some μ|f| S/(3 j t₀) of them from t₀ on: 10⁶, if t₀ is where u exceeds
rounding. The solution is smooth: the direction follows the applied force. So

    FIXED_DIRECTION  up to the speed SETTLED, friction of the tip acts against the direction of break-away. The slip
                     turns by no more than 1e-5 rad in that time, with an effect below 1e-14 m/s. Contacts of links
                     do so by themselves up to that speed
    IMPLICIT         from there on, as long as λ is large and slip changes slowly in 1/λ: Radau IIA of order five
                     (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.8, as in scipy)
    EXPLICIT         everywhere else: DOP853

A tip that is braked to rest has a large λ too, but briefly: the speed falls as fast as λ grows, and the explicit scheme
needs a step or two for each halving of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.memory import RIGID_STICK, State, Work
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.contacts.friction import stops_slipping

stops_slip: Any = interpreted(stops_slipping)
Rate = Callable[[float, Array], Array]

EXPLICIT, IMPLICIT, FIXED_DIRECTION = range(3)

# Slip faster than this, m/s, has a well-defined direction: the rounding of a velocity is 1e-7 of it.
SETTLED = 1e-9
# From this λ on, 1/s, an explicit step of a few 1/λ is shorter than accuracy requires; slip changes slowly if by less
# than this share of itself in 1/λ.
STIFF_RATE, SLOW_CHANGE = 2e4, 0.1
# Tolerance of the slip in a step, relative to the slip itself: of its direction, rad.
DIRECTION_ERROR = 1e-4


class Slip(NamedTuple):
    """A contact that slides, at the state evaluated last."""

    speed: float  # |u|, m/s; of a soft contact as though friction that ends it had to begin
    turning: float  # λ |u|, m/s²
    gaining: float  # |d|u|/dt|, m/s²
    rows: Array  # (2, n), u = G q̇


def slips(w: Work, state: State) -> list[Slip]:
    """Return the contacts whose dry friction turns a slip: the tip while it is alone, else those of links with it."""
    if state.together == 0:
        if state.friction.sticking != RIGID_STICK or state.mode != PRESSED:
            return []
        rub, tip = float(np.hypot(*w.friction.c) * abs(w.tip.F[0])), w.tip
        return [_slip(tip.u[1:], rub, tip.S[1, 1] + tip.S[2, 2], tip.A[1:], tip.A[1:] @ w.qdd + tip.drift_c[1:])]
    links, c = w.kept["contacts"]
    found = []
    for i in range(int(links.joints)):
        t = slice(3 * i + 1, 3 * i + 3)
        if c.mode[i] == PRESSED and stops_slip(c, i):
            mobility, rows, shared = c.W[t, t].trace(), c.G[t], float(c.friction.shared[i])
            rub = shared * abs(c.F[3 * i]) or float(np.hypot(*c.F[t]))
            slip = _slip(c.u[t], rub, mobility, rows, rows @ w.qdd + c.drift[t])
            # friction that ends a slip within `settling` turns none faster
            found.append(slip._replace(speed=slip.speed + c.step.settling * slip.turning) if shared else slip)
    return [slip for slip in found if slip.speed > SETTLED]


def _slip(u: Array, rub: float, mobility: float, rows: Array, acceleration: Array) -> Slip:
    speed = float(np.hypot(*u))
    return Slip(speed, rub * mobility, abs(float(u @ acceleration)) / max(speed, 1e-300), rows)


def choose_scheme(sliding: list[Slip], before: int) -> int:
    """Return the scheme for the next step, from the state evaluated last; `before` is the scheme of the last step.

    The implicit scheme ends at a λ four times smaller than that at which it begins, so that the two do not alternate.
    """
    ease = 4.0 if before == IMPLICIT else 1.0
    for slip in sliding:
        if slip.speed < 0.99 * SETTLED:  # not at it, where the step that has come so far ends
            return FIXED_DIRECTION
        if ease * slip.turning > STIFF_RATE * slip.speed and ease * SLOW_CHANGE * slip.turning > slip.gaining:
            return IMPLICIT
    return EXPLICIT


def tolerance_for(sliding: list[Slip], scheme: int, tolerance: float) -> float:
    """Return the relative tolerance of a step: that of the scenario, or less where slip is slow."""
    if scheme == EXPLICIT:
        return tolerance
    return min(tolerance, *(DIRECTION_ERROR * max(SETTLED, slip.speed) for slip in sliding))


def jacobian(rate: Rate, t: float, y: Array, w: Work, state: State) -> Array:
    """Return ∂ẏ/∂y (N, N) by forward differences, with steps small against the slips, on which it depends most.

    Parameters
    ----------
    rate : callable
        ẏ(t, y).
    t, y
        Instant, s, and state (N,).
    w, state : Work, State
        The memory in which `rate` writes the slips of the state evaluated.
    """
    n = w.q.shape[0]
    slope = rate(t, y)
    steps = np.maximum(1.0, np.abs(y)) * 1e-7
    for slip in slips(w, state):
        change = DIRECTION_ERROR * max(SETTLED, slip.speed)
        steps[n : 2 * n] = np.minimum(steps[n : 2 * n], change / np.maximum(np.hypot(*slip.rows), 1e-3))
        steps[:n] = np.minimum(steps[:n], change / max(float(np.max(np.abs(w.v))), 1e-3 * DIRECTION_ERROR))
    columns = []
    for j, step in enumerate(steps):
        near = y.copy()
        near[j] += step
        columns.append((rate(t, near) - slope) / (near[j] - y[j]))
    return np.stack(columns, axis=1)
