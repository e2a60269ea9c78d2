"""When an event happens: the gauge that tells that a mode has ended, and the bracket that closes in on the instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, STUCK
from closedloop.events.phases import (
    INSTANT,
    LOOK,
    LOOKED,
    NO_TRIAL,
    SEARCH_EVENT,
    SEARCH_LOWEST,
    SET_OUT_AGAIN,
    SHALLOW,
    TAKE_EVENT,
)
from closedloop.friction.laws import capture_speed, stick_limit
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.step.memory import (
    AT_HIGH,
    AT_LOW,
    CERTAIN,
    FRICTION,
    FRICTION_AT,
    FRICTION_STATES,
    FRICTION_WIDTH,
    GAP,
    GAUGE,
    HIGH,
    LAW_STATES,
    LENGTH,
    LOW,
    MODE,
    RATE,
    RIGID,
    RIGID_STICK,
    SENSOR_STATES,
    SPRING_STICK,
    START_GAP,
    START_SLIP,
    STICK_SPEED,
    STICKING,
    TAU,
    TIME,
    TRIAL,
    TRIES,
    UNILATERAL,
    Whole,
    Work,
)

Array = NDArray[np.float64]


@kernel_inlined
def gauge(w: Work, k: Array, state: Whole, more: int | None) -> float:
    """Return the number that is positive as long as the mode lasts: a gap, m, a force, N, or a speed, mm/s."""
    if state[MODE] == FREE:
        return float(w.now[GAP])
    least: float = w.now[RIGID] if state[UNILATERAL] != 0 else 1.0
    if more is not None and state[STICKING] in (RIGID_STICK, SPRING_STICK):
        least = min(least, cone(w, k, state) if state[MODE] == STUCK else 1e3 * slip_left(w, k, state))
    return least


@kernel
def cone(w: Work, k: Array, state: Whole) -> float:
    """Return what is left of the friction cone to a tip that sticks, μ_s f − |F_t|, N."""
    kind, par = state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH]
    at = state[LAW_STATES] + state[SENSOR_STATES]
    limit = stick_limit(kind, par, w.z[at : at + state[FRICTION_STATES]])
    return float(limit * abs(w.F[0]) - np.hypot(w.F[1], w.F[2]))


@kernel
def slip_left(w: Work, k: Array, state: Whole) -> float:
    """Return the speed along the direction in which slip began, m/s, above the speed at which sticking is tried."""
    band = capture_speed(state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH])
    along = w.u[1] * w.direction[0] + w.u[2] * w.direction[1]
    if w.now[START_SLIP] <= k[STICK_SPEED]:  # slip has only begun, and its velocity is still of the size of rounding
        return float(along + k[STICK_SPEED])
    return float(along - (band if w.now[START_SLIP] > band else 0.0))


@kernel
def aim(now: Array, state: Whole) -> None:
    """Choose the next instant between LOW and HIGH: by the secant, and every third time halfway."""
    low, high = now[LOW], now[HIGH]
    a, b = now[AT_LOW], now[AT_HIGH]
    tau = 0.5 * (low + high)
    if state[TRIES] % 3 != 2 and a > 0.0 > b and a > 1e-6 * -b:
        tau = low + (high - low) * (a / (a - b))
        tau = min(max(tau, low + 0.4 * INSTANT), high - 0.4 * INSTANT)
    state[TRIES] += 1
    now[TAU] = tau


@kernel
def narrow(now: Array, state: Whole) -> int:
    """Use the gauge at the end of a trial step to shrink the bracket, until the instant of the event is known."""
    tau, value = now[TAU], now[GAUGE]
    if state[TRIAL] == LOOK:
        state[TRIAL] = SEARCH_EVENT if value < 0.0 else LOOKED
        if state[TRIAL] == LOOKED:
            now[TAU] = now[LENGTH]
            return SET_OUT_AGAIN
    if state[TRIAL] == SEARCH_LOWEST:
        if now[GAP] < -SHALLOW:  # it went through: look for the crossing before
            state[TRIAL] = SEARCH_EVENT
            now[LOW], now[AT_LOW] = 0.0, max(now[START_GAP], 0.0)
        else:
            value = -now[RATE]
    # The end that stays twice has its value halved, so that the secant moves towards it (Illinois).
    if value > 0.0 or (value == 0.0 and state[MODE] == FREE):
        now[LOW], now[AT_LOW] = tau, value
        now[AT_HIGH] *= 0.5 if state[TRIES] > 1 else 1.0
    else:
        now[HIGH], now[AT_HIGH] = tau, value
        now[AT_LOW] *= 0.5 if state[TRIES] > 1 else 1.0
    if now[HIGH] - now[LOW] > max(INSTANT, 4e-16 * now[TIME]):
        aim(now, state)
    elif state[TRIAL] == SEARCH_LOWEST or now[HIGH] == now[LENGTH]:
        # It only came near, or it happens at the row itself: the step stands as it was.
        state[TRIAL], state[CERTAIN] = NO_TRIAL, 1
        now[TAU] = now[LENGTH]
    else:
        # A tip that comes down is taken before it is inside, what else ends after it has ended.
        state[TRIAL] = TAKE_EVENT
        now[TAU] = now[LOW] if state[MODE] == FREE else now[HIGH]
    return SET_OUT_AGAIN
