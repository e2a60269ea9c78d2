"""Setting out on a substep, and coming to its end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.events.locate import aim, gauge
from closedloop.events.phases import (
    ARRIVING,
    CLOSING,
    INSTANT,
    LEAVE,
    LEAVING,
    LOOK,
    LOOKED,
    NO_TRIAL,
    PROBING,
    RESTING,
    SEARCH_EVENT,
    SEARCH_LOWEST,
    SET_OUT,
    SET_OUT_AGAIN,
    SHALLOW,
    STAGING,
    TAKE_EVENT,
    TOUCHING,
    TRANSIT,
    TRANSITING,
    ask,
)
from closedloop.friction.laws import advance_states
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.step.energy_supplied import remember_power
from closedloop.step.joint_friction import advance_joint_friction
from closedloop.step.memory import (
    AT_HIGH,
    AT_LOW,
    BEGIN,
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
    MOVES,
    NEXT,
    PROJECT,
    RATE,
    RIGID,
    RISEN,
    ROW,
    SENSOR_STATES,
    SMOOTH,
    STAGE,
    STAGES,
    START_GAP,
    START_GAUGE,
    START_RATE,
    START_SLIP,
    STICK_SPEED,
    STICKING,
    STRAIGHT,
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
def remember(w: Work, k: Array, state: Whole, more: int | None) -> None:
    """Keep the state and its derivative: the beginning of a substep of length now[LENGTH]."""
    n, extra, now = w.q.shape[0], w.z.shape[0], w.now
    for j in range(n):
        w.begin[j] = w.q[j]
        w.begin[n + j] = w.v[j]
        w.slope[j] = w.qdd[j]
        w.held[j] = w.torque[j]
    for j in range(extra):
        w.begin[2 * n + j] = w.z[j]
        w.slope[n + j] = w.dz[j]
    now[BEGIN], now[TAU] = now[TIME], now[LENGTH]
    now[START_GAP], now[START_RATE] = now[GAP], now[RATE]
    state[TRIAL], state[STAGE], state[CERTAIN] = NO_TRIAL, 0, 0
    if more is not None and state[STICKING] != SMOOTH:
        speed = np.hypot(w.u[1], w.u[2])
        now[START_SLIP] = speed
        w.slip[0], w.slip[1] = w.u[1], w.u[2]
        if state[MODE] == PRESSED and speed > max(k[STICK_SPEED], now[STRAIGHT]):
            w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
    now[START_GAUGE] = gauge(w, k, state, more)
    remember_power(w, state)


@kernel_inlined
def restore(w: Work, state: Whole) -> None:
    """Go back to the remembered state, to take a step of another length, now[TAU], from it."""
    n, extra = w.q.shape[0], w.z.shape[0]
    for j in range(n):
        w.q[j] = w.begin[j]
        w.v[j] = w.begin[n + j]
        w.qdd[j] = w.slope[j]
    for j in range(extra):
        w.z[j] = w.begin[2 * n + j]
        w.dz[j] = w.slope[n + j]
    state[STAGE] = 0


@kernel
def advance_friction(w: Work, k: Array, state: Whole, h: float) -> None:
    """Advance the states of friction by h at the velocity of the substep's beginning, exactly."""
    at = state[LAW_STATES] + state[SENSOR_STATES]
    if state[MODE] != FREE and state[FRICTION_STATES] > 0:
        advance_states(
            state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH], w.slip, state[MODE] == STUCK, h,
            w.z[at : at + state[FRICTION_STATES]],
        )  # fmt: skip
    advance_joint_friction(w, k, state, h)


@kernel_inlined
def leave_stage(now: Array, h: float, state: Whole, tableau: Array) -> None:
    """Ask for the terms of the state that a stage has led to: the next stage's, or those of the substep's end."""
    stage, tau = state[STAGE], now[TAU]
    if stage + 1 < state[STAGES]:
        state[STAGE] = stage + 1
        node = 0.0
        for i in range(stage + 1):
            node += tableau[stage + 1, i]
        now[TIME] = now[BEGIN] + node * tau
        ask(state, STAGING)
    elif state[TRIAL] > LOOKED:
        now[TIME] = now[BEGIN] + tau
        ask(state, TRANSITING if state[TRIAL] == TAKE_EVENT else PROBING)
    else:
        now[TIME] = state[ROW] * h
        if state[PROJECT] != 0 and state[MODE] != FREE:
            state[MOVES], state[NEXT] = 0, ARRIVING
            ask(state, CLOSING)
        else:
            ask(state, ARRIVING)


@kernel_inlined
def look(now: Array, state: Whole) -> int:
    """Say what a stage calls for: LEAVE, or a trial step to its instant if the surface would pull in it.

    A pull that begins and ends within the step is then found, if it lasts over a stage. A stage is of lower order than
    the step, and is not believed: only if f is negative at the end of the trial step too is the event searched for.
    """
    tau = now[TIME] - now[BEGIN]
    if state[TRIAL] != NO_TRIAL or state[MODE] == FREE or not now[RIGID] < 0.0 or tau > now[LENGTH] - INSTANT:
        return LEAVE
    state[TRIAL], state[TRIES] = LOOK, 0
    now[LOW], now[HIGH], now[TAU] = 0.0, tau, tau
    now[AT_LOW] = max(now[START_GAUGE], 0.0)
    return SET_OUT_AGAIN


@kernel_inlined
def arrive(now: Array, drift: float, state: Whole) -> int:
    """Say what a step that has just arrived calls for: SET_OUT, an event here (TRANSIT), or a search for one."""
    here = state[ROW] == 0 or state[CERTAIN] != 0  # there is no earlier instant to look at
    trial = NO_TRIAL
    if state[MODE] != FREE:
        if now[GAUGE] < 0.0:
            trial = TAKE_EVENT if here else SEARCH_EVENT
    elif state[UNILATERAL] != 0:
        leaving = LEAVING + (now[LENGTH] * now[LENGTH] * abs(drift) if state[STAGES] == 1 else 0.0)
        if here:
            if now[GAP] <= TOUCHING and now[RATE] < -RESTING:
                trial = TAKE_EVENT
        elif now[GAP] < -(SHALLOW if state[RISEN] != 0 else leaving):
            trial = SEARCH_EVENT
        elif state[RISEN] != 0 and now[START_RATE] < -RESTING and now[RATE] > 0.0:
            trial = SEARCH_LOWEST  # down and up again: how low was it?
        if now[GAP] > leaving:
            state[RISEN] = 1
    state[TRIAL] = trial
    if trial == NO_TRIAL:
        return SET_OUT
    if trial == TAKE_EVENT:
        return TRANSIT
    state[TRIES] = 0
    now[LOW], now[HIGH] = 0.0, now[LENGTH]
    if trial == SEARCH_LOWEST:
        now[AT_LOW], now[AT_HIGH] = -now[START_RATE], -now[RATE]
    else:
        now[AT_LOW], now[AT_HIGH] = max(now[START_GAUGE], 0.0), now[GAUGE]
    aim(now, state)
    return SET_OUT_AGAIN
