"""Friction between tip and surface inside a step: what its law makes of the present slip, and where it points."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.loop.step.entries import HOLD, SLIDE
from closedloop.loop.step.memory import RIGID_STICK, SMOOTH, SPRING_STICK, Constants, State, Work
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, IMMOBILE, STUCK
from closedloop.mechanics.friction.law import STILL

Array = NDArray[np.float64]


@kernel
def turn_with_slip(w: Work, h: float) -> bool:
    """Turn the friction of a slow tip to where its slip points at the end of the step; return whether it was slow.

    Friction turns a slip u with the rate μ|f| s/|u|, s the mobility along the surface. Where that is above 1/h, a step
    that takes friction against the present u throws the tip from side to side, and at last no step is short enough.
    There the direction d is that of the slip u⁺ at the end of the step,

        u⁺ + h μ|f| S_t d = u + h (a_t + S_tn f − S_t w),    d = u⁺/|u⁺|

    as in time stepping (J. J. Moreau, 1988): one equation for |u⁺|, by bisection. If friction is enough to stop the tip
    within the step, d is such that the tip goes straight to rest. A slip that has only just broken away is u = 0: what
    rounding has left of it has no direction, and must decide nothing.

    Parameters
    ----------
    w : Work
        In: u, direction, S, a, w, and c = ±μ u/|u| with the F of it (minus where the closure pulls). Written: c.
    h : float
        The step, s.
    """
    level, speed, f = math.hypot(w.friction.c[0], w.friction.c[1]), math.hypot(w.tip.u[1], w.tip.u[2]), w.tip.F[0]
    reach = h * level * abs(f)
    if not reach * (w.tip.S[1, 1] + w.tip.S[2, 2]) > speed:
        return False
    u1, u2, before1, before2 = w.tip.u[1], w.tip.u[2], w.tip.u[1], w.tip.u[2]
    if speed <= STILL:
        u1, u2, before1, before2 = 0.0, 0.0, w.friction.direction[0], w.friction.direction[1]
    elif not u1 * w.friction.direction[0] + u2 * w.friction.direction[1] > 0.0:
        return False  # past the end of slip
    det = w.tip.S[1, 1] * w.tip.S[2, 2] - w.tip.S[1, 2] * w.tip.S[1, 2]
    trace, largest = w.tip.S[1, 1] + w.tip.S[2, 2], level * f
    if not det > IMMOBILE * trace * trace:
        return False  # a tip that moves along a line does not turn
    a1 = w.tip.a[1] + w.tip.S[1, 0] * f - w.tip.S[1, 1] * w.friction.viscous[0] - w.tip.S[1, 2] * w.friction.viscous[1]
    a2 = w.tip.a[2] + w.tip.S[2, 0] * f - w.tip.S[1, 2] * w.friction.viscous[0] - w.tip.S[2, 2] * w.friction.viscous[1]
    p1, p2 = (w.tip.S[2, 2] * u1 - w.tip.S[1, 2] * u2) / det, (w.tip.S[1, 1] * u2 - w.tip.S[1, 2] * u1) / det
    q1, q2 = (w.tip.S[2, 2] * a1 - w.tip.S[1, 2] * a2) / det, (w.tip.S[1, 1] * a2 - w.tip.S[1, 2] * a1) / det
    if math.hypot(p1 / h + q1, p2 / h + q2) < level * abs(f):
        if speed <= STILL:
            return False  # it does not leave: friction is against the direction in which it is pulled
        along, square = p1 * q1 + p2 * q2, p1 * p1 + p2 * p2
        rate = (math.sqrt(along * along + square * (largest * largest - q1 * q1 - q2 * q2)) - along) / square
        d1, d2 = rate * p1 + q1, rate * p2 + q2
    else:
        g11, g12, g22 = reach * w.tip.S[1, 1], reach * w.tip.S[1, 2], reach * w.tip.S[2, 2]
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
    along = math.copysign(level / size, f)
    w.friction.c[0], w.friction.c[1] = along * d1, along * d2
    return True


@kernel
def surface_friction(w: Work, constants: Constants, state: State, rows: Array) -> None:
    """Write c and w of the tip's friction F_t = −c f − w in the present mode; zero where there is none."""
    w.friction.c[0], w.friction.c[1], w.friction.viscous[0], w.friction.viscous[1] = 0.0, 0.0, 0.0, 0.0
    sticking = state.friction.sticking
    if sticking == SMOOTH or state.mode == FREE or (state.mode == STUCK and sticking == RIGID_STICK):
        return
    if state.mode == STUCK:
        call_at(state.friction.entry, state.address, HOLD)
        return
    speed = math.hypot(w.tip.u[1], w.tip.u[2])
    w.friction.delayed_slip = delayed_speed(w, constants, state, rows, constants.lag, speed)
    s = w.friction.slip
    s[0], s[1] = w.tip.u[1], w.tip.u[2]
    along = s[0] * w.friction.direction[0] + s[1] * w.friction.direction[1]
    if sticking != RIGID_STICK and sticking != SPRING_STICK:
        along = 1.0
    if along < 0.0 or speed <= w.friction.straight_speed:
        # Past the instant at which slip stops the law goes on as before, so that the instant can be found.
        s[0], s[1] = speed * w.friction.direction[0], speed * w.friction.direction[1]
    call_at(state.friction.entry, state.address, SLIDE)


@kernel
def rub_without_pressure(w: Work, b: float) -> float:
    """Write the force on a tip that stays on the surface with f = 0, and return its acceleration along n, m/s².

    The part w of F_t = −c f − w that does not depend on f, as viscous friction, moves the tip along n too where S_nt is
    not zero. Where with all of w the tip would be lifted off, and without friction it would be pressed on, neither mode
    is consistent: the tip neither stays nor leaves. Between them lies the motion of a tip that touches with f = 0 and
    the share of w that gives it the acceleration b of the closure: Filippov's solution, which the two would chatter
    about (A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer 1988).

    Parameters
    ----------
    w : Work
        In: S, the free acceleration a with a_n < 0, and w with a_n − S_nt w > 0. Written: F.
    b : float
        That of the stabiliser, m/s²: 0 without one.
    """
    lifting = -w.tip.S[0, 1] * w.friction.viscous[0] - w.tip.S[0, 2] * w.friction.viscous[1]
    share = min(max((b - w.tip.a[0]) / lifting, 0.0), 1.0)
    w.tip.F[0], w.tip.F[1], w.tip.F[2] = 0.0, -share * w.friction.viscous[0], -share * w.friction.viscous[1]
    return float(w.tip.a[0] + share * lifting)


@kernel
def delayed_speed(w: Work, constants: Constants, state: State, rows: Array, delay: float, speed: float) -> float:
    """Return the speed of slip `delay` seconds ago, m/s, on a line between rows; `speed` is the present one."""
    if delay <= 0.0:
        return speed
    n = w.q.shape[0]
    x = (w.time - delay) / constants.h
    last = state.row - 1
    if x <= 0.0 or last < 0:
        return slip_speed(rows[0], n) if last >= 0 else speed
    i = int(x)
    if i >= last:
        since = w.time - last * constants.h
        s = (w.time - delay - last * constants.h) / since if since > 0.0 else 1.0
        return float((1.0 - s) * slip_speed(rows[last], n) + s * speed)
    return float((1.0 - (x - i)) * slip_speed(rows[i], n) + (x - i) * slip_speed(rows[i + 1], n))


@kernel
def slip_speed(row: Array, n: int) -> float:
    """Return the speed of slip in a recorded row, m/s."""
    slip = Row(row, n).slip_velocity
    return math.sqrt(slip[0] * slip[0] + slip[1] * slip[1] + slip[2] * slip[2])
