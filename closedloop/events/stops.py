"""Stops of the joints: the instant at which a joint reaches one, the impact there, and its release.

A joint at a stop is a row q̈_j = 0 beside those of the loops (`closedloop.step.closed_loops`): q stays at the limit, and
the stop's torque is what the row takes. An impact there has no rebound; the tip in contact takes part in it. The stop
lets go when it would have to pull.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED, STUCK, apply_impulse, stuck_force
from closedloop.events.phases import RESTING
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.step.closed_loops import BIND_TIP, STOP_TORQUE, STRIKE, missing_torque
from closedloop.step.memory import RIGID_STICK, Constants, State, Work

Array = NDArray[np.float64]

# A joint no farther beyond its stop than this, rad (m), is at it: the rounding of a position. Nearer than the second to
# it, and moving there, it has reached it: an instant is located to 1e-14 s.
BEYOND, REACHED = 1e-13, 1e-9
# The torque of a stop is known to this, N m (N): what pulls less does not pull.
PULLING = 1e-9


@kernel
def measure_stops(H: Array, C: Array, w: Work, constants: Constants, state: State) -> None:
    """Write `stop_margin`, negative if a joint is beyond its stop or a stop would have to pull; and the torques."""
    least, holding = np.inf, False
    for j in range(w.q.shape[0]):
        w.stop_torque[j] = 0.0
        if w.stopped[j] == 0.0:
            least = min(least, w.q[j] - constants.lower_stop[j] + BEYOND, constants.upper_stop[j] - w.q[j] + BEYOND)
        else:
            holding = True
    if holding:
        missing_torque(H, C, w, state)
        call_at(state.loops, state.loops_at, STOP_TORQUE)
        for j in range(w.q.shape[0]):
            if w.stopped[j] != 0.0:
                least = min(least, PULLING - w.stopped[j] * w.stop_torque[j])
    w.stop_margin = least


@kernel
def reach_stops(w: Work, constants: Constants, state: State) -> bool:
    """Let joints that have come to a stop strike it; return whether there were any.

    `before` and `after` are the tip's velocities, `compression` its impulse, `column` what q̇ has changed by.
    """
    n, struck = w.q.shape[0], False
    for j in range(n):
        if w.stopped[j] == 0.0 and w.q[j] - constants.lower_stop[j] <= REACHED and w.v[j] < 0.0:
            w.stopped[j], struck = -1.0, True
        elif w.stopped[j] == 0.0 and constants.upper_stop[j] - w.q[j] <= REACHED and w.v[j] > 0.0:
            w.stopped[j], struck = 1.0, True
    if not struck:
        return False
    for j in range(n):
        w.slope[j] = w.v[j]
    call_at(state.loops, state.loops_at, STRIKE)
    call_at(state.loops, state.loops_at, BIND_TIP)  # X and S with the joints at their stops
    tip_velocity(w, w.a)
    for i in range(3):
        w.b[i], w.compression[i] = 0.0, 0.0
    if state.mode != FREE and state.compliance == 0:
        if state.unilateral != 0 and w.a[0] > RESTING:
            state.mode, state.risen = FREE, 0
        else:
            if state.mode == STUCK and state.sticking == RIGID_STICK:
                stuck_force(w.S, w.a, w.b, w.compression, w.stabiliser_force)
            elif state.mode == PRESSED and w.S[0, 0] > 0.0:
                w.compression[0] = -w.a[0] / w.S[0, 0]
            apply_impulse(w.L, w.X, w.compression, w.column, w.v)
    tip_velocity(w, w.after)
    for j in range(n):
        w.column[j] = w.v[j] - w.slope[j]
    return True


@kernel
def tip_velocity(w: Work, u: Array) -> None:
    """Write the tip's velocity relative to the surface, (3,), m/s, contact frame, at the present q̇."""
    for i in range(3):
        u[i] = -w.carried[i]
        for j in range(w.v.shape[0]):
            u[i] += w.A[i, j] * w.v[j]


@kernel
def energy_of_jump(w: Work) -> float:
    """Return the kinetic energy lost where q̇ jumped by `column` from what is kept in `slope`, J, with H = L Lᵀ."""
    lost, n = 0.0, w.q.shape[0]
    for j in range(n):
        first, second = w.slope[j] / w.L[j, j], w.v[j] / w.L[j, j]  # L's diagonal holds reciprocals
        for i in range(j + 1, n):
            first += w.L[i, j] * w.slope[i]
            second += w.L[i, j] * w.v[i]
        lost += 0.5 * (first * first - second * second)
    return lost


@kernel
def release_stops(w: Work) -> bool:
    """Let go of the joints that a stop would have to pull; return whether there were any."""
    released = False
    for j in range(w.q.shape[0]):
        if w.stopped[j] * w.stop_torque[j] > PULLING:
            w.stopped[j], released = 0.0, True
    return released
