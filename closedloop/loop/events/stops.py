"""Stops of the joints: the instant at which a joint reaches one, the impact there, and its release.

A joint at a stop is a row q̈_j = 0 beside those of the loops (`closedloop.loop.step.closed_loops`): q stays at the
limit, and the stop's torque is what the row takes. The stop lets go when it would have to pull.

An impact there is Moreau's: with p the motion nearest to q̇ in the measure of H that all stops, the loops and the tip
in contact allow, q̇ becomes p + ε (p − q̇). Stops and the tip push and do not pull, so that the motions allowed are a
convex cone, p is at right angles to p − q̇, and ½ q̇ᵀH q̇ falls by (1 − ε²) of what p − q̇ has: never less than none,
whatever is struck at once. Of one joint ε is the ratio of the speeds. (J. J. Moreau, Unilateral contact and dry
friction in finite freedom dynamics, CISM 302, 1988.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.loop.events.phases import MAX_RAPID, RESTING
from closedloop.loop.step.closed_loops import BIND_TIP, IMPULSE, STOP_TORQUE, missing_torque
from closedloop.loop.step.memory import RIGID_STICK, Constants, State, Work, ask_loops
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK, apply_impulse, stuck_force
from closedloop.mechanics.closure.solve import forward_substitute_three
from closedloop.mechanics.contacts.impact import SLOWEST_REBOUND

Array = NDArray[np.float64]

# A joint no farther beyond its stop than this, rad (m), is at it: the rounding of a position. Nearer than the second to
# it, and moving there, it has reached it: an instant is located to 1e-14 s. One that is not beyond it moves there if it
# is faster than `LEAVING_SPEED`: a joint that a stop has just let go has the rounding of a velocity of zero.
BEYOND, REACHED = 1e-13, 1e-9
# The torque of a stop is known to this, N m (N): what pulls less does not pull.
PULLING = 1e-9
# The impulse of a stop is known to this, N m s (N s), and the speed after it to this, rad/s (m/s).
PULLING_IMPULSE, LEAVING_SPEED = 1e-11, 1e-11
# Stops that are let go or held again, one at a time, until each pushes or is left: more than any arm needs.
MOST_TRIALS = 200


@kernel
def measure_stops(H: Array, C: Array, w: Work, constants: Constants, state: State) -> None:
    """Write `stop_margin`, negative if a joint is beyond its stop or a stop would have to pull; and the torques."""
    least, holding = np.inf, False
    for j in range(w.q.shape[0]):
        w.stops.torque[j] = 0.0
        if w.stops.side[j] == 0.0:
            least = min(least, w.q[j] - constants.lower_stop[j] + BEYOND, constants.upper_stop[j] - w.q[j] + BEYOND)
        else:
            holding = True
    if holding:
        missing_torque(H, C, w, state)
        ask_loops(state, STOP_TORQUE)
        for j in range(w.q.shape[0]):
            if w.stops.side[j] != 0.0:
                least = min(least, PULLING - w.stops.side[j] * w.stops.torque[j])
    w.stops.margin = least


@kernel
def reach_stops(w: Work, constants: Constants, state: State) -> bool:
    """Let joints that have come to a stop strike it; return whether there were any.

    `before` and `after` are the tip's velocities, `compression` and `decompression` its impulses, `column` what q̇ has
    changed by. A joint that this drives into its stop strikes it next, in an event of its own.
    """
    n, fastest, sides = w.q.shape[0], 0.0, w.stops.held
    for j in range(n):
        to_lower, to_upper = w.q[j] - constants.lower_stop[j], constants.upper_stop[j] - w.q[j]
        low = to_lower <= REACHED and w.v[j] < (0.0 if to_lower + BEYOND < 0.0 else -LEAVING_SPEED)
        high = to_upper <= REACHED and w.v[j] > (0.0 if to_upper + BEYOND < 0.0 else LEAVING_SPEED)
        if w.stops.side[j] == 0.0 and (low or high):
            w.stops.side[j] = -1.0 if low else 1.0
            w.q[j] = constants.lower_stop[j] if low else constants.upper_stop[j]  # not beyond it, by rounding
            fastest = max(fastest, abs(w.v[j]))
        sides[j] = w.stops.side[j]
        w.stops.before[j] = w.v[j]
    if fastest == 0.0:
        return False
    mode = state.mode
    for _ in range(MOST_TRIALS):
        compress(w, state)
        if not change_stop(w, state, sides):
            break
        state.mode = mode
        for j in range(n):
            w.v[j] = w.stops.before[j]
    rebound = constants.stop_restitution
    if rebound * fastest < SLOWEST_REBOUND or state.event.rapid >= MAX_RAPID:
        rebound = 0.0
    for j in range(n):
        w.scratch.column[j] = (1.0 + rebound) * (w.v[j] - w.stops.before[j])
        w.v[j] = w.stops.before[j] + w.scratch.column[j]
        if rebound > 0.0 and sides[j] * w.stops.before[j] > LEAVING_SPEED:
            w.stops.side[j] = 0.0
    for i in range(3):
        w.impact.decompression[i] = rebound * w.impact.compression[i]
    tip_velocity(w, w.impact.after)
    return True


@kernel
def compress(w: Work, state: State) -> None:
    """Make q̇ obey the stops that hold, the loops and the tip in contact, and write the tip's impulse."""
    ask_loops(state, IMPULSE)
    bind_again(w, state)
    tip_velocity(w, w.tip.a)
    for i in range(3):
        w.tip.b[i], w.impact.compression[i] = 0.0, 0.0
    if state.mode != FREE and state.compliance.entry == 0:
        if state.settings.unilateral != 0 and w.tip.a[0] > RESTING:
            state.mode, state.cleared = FREE, 0
        else:
            if state.mode == STUCK and state.friction.sticking == RIGID_STICK:
                stuck_force(w.tip.S, w.tip.a, w.tip.b, w.impact.compression, w.tip.stabiliser_force)
            elif state.mode == PRESSED and w.tip.S[0, 0] > 0.0:
                w.impact.compression[0] = -w.tip.a[0] / w.tip.S[0, 0]
            apply_impulse(w.L, w.tip.X, w.impact.compression, w.scratch.column, w.v)


@kernel
def bind_again(w: Work, state: State) -> None:
    """Write X and S of the tip with the joints at the stops that hold now."""
    n = w.q.shape[0]
    for k in range(3):
        for j in range(n):
            w.tip.X[k, j] = w.tip.A[k, j]
    forward_substitute_three(w.L, w.tip.X, 0, 0, n)
    ask_loops(state, BIND_TIP)


@kernel
def note_sides(w: Work) -> None:
    """Keep the joints at stops before an impact of the tip, for `yield_stops`."""
    for j in range(w.q.shape[0]):
        w.stops.held[j] = w.stops.side[j]


@kernel
def yield_stops(w: Work, state: State) -> bool:
    """Let go of a stop that would have to pull in the compression of an impact of the tip; return whether there was.

    Or hold one again that was let go, see `change_stop`; the mobility of the tip is then another.
    """
    for j in range(w.q.shape[0]):
        w.stops.before[j] = w.v[j]
    apply_impulse(w.L, w.tip.X, w.impact.compression, w.scratch.column, w.v)
    changed = change_stop(w, state, w.stops.held)
    for j in range(w.q.shape[0]):
        w.v[j] = w.stops.before[j]
    if changed:
        bind_again(w, state)
    return changed


@kernel
def change_stop(w: Work, state: State, sides: Array) -> bool:
    """Let go of the first stop that would have to pull, or hold the first joint that goes beyond its own.

    Least index first, so that it ends (K. G. Murty, Opsearch 11, 1974). `sides` (n,): 1 of a joint at its upper stop,
    −1 at its lower, else 0. Return whether there was any.
    """
    n = w.q.shape[0]
    for i in range(n):  # H (q̇ after − before) − Aᵀ P: what the loops and the stops gave, with H = L Lᵀ
        w.scratch.column[i] = (w.v[i] - w.stops.before[i]) / w.L[i, i]  # L's diagonal holds reciprocals
        for k in range(i + 1, n):
            w.scratch.column[i] += w.L[k, i] * (w.v[k] - w.stops.before[k])
    for i in range(n - 1, -1, -1):
        w.scratch.column[i] /= w.L[i, i]
        for k in range(i):
            w.scratch.column[i] += w.L[i, k] * w.scratch.column[k]
        for k in range(3):
            w.scratch.column[i] -= w.tip.A[k, i] * w.impact.compression[k]
    ask_loops(state, STOP_TORQUE)
    for j in range(n):
        if w.stops.side[j] * w.stops.torque[j] > PULLING_IMPULSE:
            w.stops.side[j] = 0.0
            return True
        if w.stops.side[j] == 0.0 and sides[j] * w.v[j] > LEAVING_SPEED:
            w.stops.side[j] = sides[j]
            return True
    return False


@kernel
def tip_velocity(w: Work, u: Array) -> None:
    """Write the tip's velocity relative to the surface, (3,), m/s, contact frame, at the present q̇."""
    for i in range(3):
        u[i] = -w.tip.carried[i]
        for j in range(w.v.shape[0]):
            u[i] += w.tip.A[i, j] * w.v[j]


@kernel
def energy_of_jump(w: Work) -> float:
    """Return the energy lost where q̇ jumped from what is kept in `Stops.before`, J, with H = L Lᵀ.

    What a surface that moves has given to the arm by the impulse at its tip is not lost: `log_event` counts it.
    """
    lost, n = 0.0, w.q.shape[0]
    for j in range(n):
        first, second = w.stops.before[j] / w.L[j, j], w.v[j] / w.L[j, j]  # L's diagonal holds reciprocals
        for i in range(j + 1, n):
            first += w.L[i, j] * w.stops.before[i]
            second += w.L[i, j] * w.v[i]
        lost += 0.5 * (first * first - second * second)
    for i in range(3):
        lost += (w.impact.compression[i] + w.impact.decompression[i]) * w.tip.carried[i]
    return lost


@kernel
def release_stops(w: Work) -> bool:
    """Let go of the joints that a stop would have to pull; return whether there were any."""
    released = False
    for j in range(w.q.shape[0]):
        if w.stops.side[j] * w.stops.torque[j] > PULLING:
            w.stops.side[j], released = 0.0, True
    return released
