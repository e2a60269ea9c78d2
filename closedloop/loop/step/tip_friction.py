"""Friction between tip and surface inside a step: what its law makes of the present slip, and where it points."""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.loop.step.memory import RIGID_STICK, SMOOTH, SPRING_STICK, Constants, State, Work
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.friction.answers import HOLD, SLIDE
from closedloop.mechanics.friction.turning import turn_friction


@kernel
def turn_with_slip(w: Work, h: float) -> bool:
    """Turn the friction of a slow tip to where its slip points at the end of the step h, s; return whether it was slow.

    In: u, direction, S, a, w, and c = ±μ u/|u| with the F of it (minus where the closure pulls). Written: c; see
    `closedloop.mechanics.friction.turning`.
    """
    S, f, viscous = w.tip.S, w.tip.F[0], w.friction.viscous
    a1 = w.tip.a[1] + S[1, 0] * f - S[1, 1] * viscous[0] - S[1, 2] * viscous[1]
    a2 = w.tip.a[2] + S[2, 0] * f - S[1, 2] * viscous[0] - S[2, 2] * viscous[1]
    return bool(turn_friction(S, a1, a2, w.tip.u, w.friction.direction, f, h, w.friction.c))


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

    `w`: in: S, the free acceleration a with a_n < 0, and w with a_n − S_nt w > 0. Written: F.
    `b`: that of the stabiliser, m/s²: 0 without one.
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
