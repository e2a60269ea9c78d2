"""Setting out on a substep, and coming to its end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED
from closedloop.events.locate import aim, event_function
from closedloop.events.phases import (
    APPLY_EVENT,
    ARRIVING,
    AT_EVENT,
    INSTANT,
    LEAVE,
    LEAVING,
    LOOK,
    LOOKED,
    NO_TRIAL,
    PROBING,
    PROJECTING,
    RESTING,
    SEARCH_EVENT,
    SEARCH_LOWEST,
    SET_OUT,
    SET_OUT_AGAIN,
    SHALLOW,
    STAGING,
    TAKE_EVENT,
    TOUCHING,
    ask,
)
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.step.energy_supplied import remember_power
from closedloop.step.entries import ADVANCE
from closedloop.step.joint_friction import advance_joint_friction
from closedloop.step.memory import SMOOTH, Constants, State, Work

Array = NDArray[np.float64]


@kernel_inlined
def remember(w: Work, constants: Constants, state: State, more: int | None) -> None:
    """Keep the state and its derivative: the beginning of a substep of length w.length."""
    n, extra = w.q.shape[0], w.z.shape[0]
    for j in range(n):
        w.begin[j] = w.q[j]
        w.begin[n + j] = w.v[j]
        w.slope[j] = w.qdd[j]
        w.held[j] = w.torque[j]
    for j in range(extra):
        w.begin[2 * n + j] = w.z[j]
        w.slope[n + j] = w.dz[j]
    w.begin_time, w.tau = w.time, w.length
    w.start_gap, w.start_rate = w.gap, w.rate
    state.trial, state.stage, state.certain = NO_TRIAL, 0, 0
    if more is not None and state.sticking != SMOOTH:
        speed = np.hypot(w.u[1], w.u[2])
        w.start_slip_speed = speed
        w.start_slip[0], w.start_slip[1] = w.u[1], w.u[2]
        if state.mode == PRESSED and speed > max(constants.stick_speed, w.straight):
            w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
    w.start_event_value = event_function(w, constants, state, more)
    remember_power(w, state)


@kernel_inlined
def restore(w: Work, state: State) -> None:
    """Go back to the remembered state, to take a step of another length, w.tau, from it."""
    n, extra = w.q.shape[0], w.z.shape[0]
    for j in range(n):
        w.q[j] = w.begin[j]
        w.v[j] = w.begin[n + j]
        w.qdd[j] = w.slope[j]
    for j in range(extra):
        w.z[j] = w.begin[2 * n + j]
        w.dz[j] = w.slope[n + j]
    state.stage = 0


@kernel
def advance_friction(w: Work, state: State, h: float) -> None:
    """Advance the states of friction by h at the velocity of the substep's beginning, exactly."""
    if state.mode != FREE and state.friction_states > 0:
        w.slip[0], w.slip[1], w.friction_span = w.start_slip[0], w.start_slip[1], h
        call_at(state.friction, state.address, ADVANCE)
    advance_joint_friction(w, state, h)


@kernel_inlined
def leave_stage(w: Work, h: float, state: State, tableau: Array) -> None:
    """Ask for the terms of the state that a stage has led to: the next stage's, or those of the substep's end."""
    stage, tau = state.stage, w.tau
    if stage + 1 < state.stages:
        state.stage = stage + 1
        node = 0.0
        for i in range(stage + 1):
            node += tableau[stage + 1, i]
        w.time = w.begin_time + node * tau
        ask(state, STAGING)
    elif state.trial > LOOKED:
        w.time = w.begin_time + tau
        ask(state, AT_EVENT if state.trial == TAKE_EVENT else PROBING)
    else:
        w.time = state.row * h
        if state.project != 0 and state.mode != FREE:
            state.moves, state.next_phase = 0, ARRIVING
            ask(state, PROJECTING)
        else:
            ask(state, ARRIVING)


@kernel_inlined
def look(w: Work, state: State) -> int:
    """Say what a stage calls for: LEAVE, or a trial step to its instant if the surface would pull in it.

    A pull that begins and ends within the step is then found, if it lasts over a stage. A stage is of lower order than
    the step, and is not believed: only if f is negative at the end of the trial step too is the event searched for.
    """
    tau = w.time - w.begin_time
    if state.trial != NO_TRIAL or state.mode == FREE or not w.rigid_force < 0.0 or tau > w.length - INSTANT:
        return LEAVE
    state.trial, state.tries = LOOK, 0
    w.low, w.high, w.tau = 0.0, tau, tau
    w.at_low = max(w.start_event_value, 0.0)
    return SET_OUT_AGAIN


@kernel_inlined
def arrive(w: Work, drift: float, state: State) -> int:
    """Say what a step that has just arrived calls for: SET_OUT, an event here (APPLY_EVENT), or a search for one."""
    here = state.row == 0 or state.certain != 0  # there is no earlier instant to look at
    trial = NO_TRIAL
    if state.mode != FREE:
        if w.event_value < 0.0:
            trial = TAKE_EVENT if here else SEARCH_EVENT
    elif state.unilateral != 0:
        leaving = LEAVING + (w.length * w.length * abs(drift) if state.stages == 1 else 0.0)
        if here:
            if w.gap <= TOUCHING and w.rate < -RESTING:
                trial = TAKE_EVENT
        elif w.gap < -(SHALLOW if state.risen != 0 else leaving):
            trial = SEARCH_EVENT
        elif state.risen != 0 and w.start_rate < -RESTING and w.rate > 0.0:
            trial = SEARCH_LOWEST  # down and up again: how low was it?
        if w.gap > leaving:
            state.risen = 1
    state.trial = trial
    if trial == NO_TRIAL:
        return SET_OUT
    if trial == TAKE_EVENT:
        return APPLY_EVENT
    state.tries = 0
    w.low, w.high = 0.0, w.length
    if trial == SEARCH_LOWEST:
        w.at_low, w.at_high = -w.start_rate, -w.rate
    else:
        w.at_low, w.at_high = max(w.start_event_value, 0.0), w.event_value
    aim(w, state)
    return SET_OUT_AGAIN
