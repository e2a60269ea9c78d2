"""The beginning and the end of a substep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.loop.events.locate import choose_trial, event_function, refine_bracket
from closedloop.loop.events.phases import (
    ADVANCE,
    APPLY_EVENT,
    AT_EVENT,
    BEGIN_SUBSTEP,
    CHECK_STAGE,
    INSTANT,
    LARGEST_TURN,
    LEAVING,
    LOCATE_EVENT,
    LOCATE_MINIMUM,
    MAX_IN_STEP,
    NEED_TERMS,
    NO_TRIAL,
    PART_END,
    PROJECTION,
    RAPID,
    REACH_EVENT,
    RESTING,
    RETRY_SUBSTEP,
    SHALLOW,
    STAGE,
    STAGE_CHECKED,
    STEP_END,
    TOUCHING,
    TRIAL_END,
    request_terms,
)
from closedloop.loop.events.table import REVERSAL, SLIP_AGAIN, STICK
from closedloop.loop.step.contacts import SAVE
from closedloop.loop.step.energy_supplied import save_power
from closedloop.loop.step.entries import ADVANCE_STATES
from closedloop.loop.step.joint_friction import advance_joint_friction
from closedloop.loop.step.memory import SMOOTH, Constants, State, Work
from closedloop.loop.step.singular import near_singular, remember_approach
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.closure.solve import CHATTER, CROWDED, RUBS

Array = NDArray[np.float64]


@kernel_inlined
def save_state(w: Work, constants: Constants, state: State) -> None:
    """Save the state and its derivative at the beginning of a substep of length w.length."""
    n, extra = w.q.shape[0], w.z.shape[0]
    if state.contacts != 0:
        divide_step(w, state)
    for j in range(n):
        w.begin[j] = w.q[j]
        w.begin[n + j] = w.v[j]
        w.slope[j] = w.qdd[j]
        w.held[j] = w.torque[j]
    for j in range(extra):
        w.begin[2 * n + j] = w.z[j]
        w.slope[n + j] = w.dz[j]
    w.begin_time, w.tau = w.time, w.length
    w.start_gap, w.start_rate, w.start_contact_margin = w.gap, w.rate, w.contact_margin
    state.trial, state.stage, state.no_search, state.watched = NO_TRIAL, 0, 0, 0
    if state.sticking != SMOOTH:
        speed = np.hypot(w.u[1], w.u[2])
        w.start_slip_speed = speed
        w.start_slip[0], w.start_slip[1] = w.u[1], w.u[2]
        if state.mode == PRESSED and speed > max(constants.stick_speed, w.straight_speed):
            w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
    if state.mode == PRESSED and near_singular(w.S):
        remember_approach(w, state)
    else:
        state.approached = 0
    if state.contacts != 0:
        call_at(state.contacts, state.contacts_at, SAVE)
    w.start_event_value = event_function(w, constants, state)
    save_power(w, state)


@kernel
def divide_step(w: Work, state: State) -> None:
    """Shorten a substep in which a joint would turn by more than `LARGEST_TURN`, and say whether it was."""
    fastest, left = 0.0, w.length
    for j in range(w.q.shape[0]):
        fastest = max(fastest, abs(w.v[j]))
    state.divided = 0
    if fastest * left > LARGEST_TURN and state.steps > 0:
        w.length = left / np.ceil(fastest * left / LARGEST_TURN)
        state.divided = 1


@kernel_inlined
def restore_state(w: Work, state: State) -> None:
    """Restore the saved state, for a step of another length, w.tau, from it."""
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
        call_at(state.friction, state.address, ADVANCE_STATES)
    advance_joint_friction(w, state, h)


@kernel_inlined
def finish_stage(w: Work, h: float, state: State, tableau: Array) -> None:
    """Request the terms after a stage: those of the next stage, or of the substep's end."""
    stage, tau = state.stage, w.tau
    if stage + 1 < state.stages:
        state.stage = stage + 1
        node = 0.0
        for i in range(stage + 1):
            node += tableau[stage + 1, i]
        w.time = w.begin_time + node * tau
        request_terms(state, STAGE)
    elif state.trial > STAGE_CHECKED:
        w.time = w.begin_time + tau
        request_terms(state, AT_EVENT if state.trial == REACH_EVENT else TRIAL_END)
    else:
        w.time = state.row * h if state.divided == 0 else w.begin_time + tau
        end = STEP_END if state.divided == 0 else PART_END
        if state.project != 0 and state.mode != FREE:
            state.projections, state.next_phase = 0, end
            request_terms(state, PROJECTION)
        else:
            request_terms(state, end)


@kernel
def resume_step(w: Work, constants: Constants, state: State) -> int:
    """Continue after an event to the end of the step, or let the step end here."""
    left = state.row * constants.h - w.time
    if left <= INSTANT:
        state.no_search = 1
        w.time = state.row * constants.h
        request_terms(state, STEP_END)
        return NEED_TERMS
    state.after_event = 1
    w.length = left
    return BEGIN_SUBSTEP


@kernel
def count_event(w: Work, state: State) -> None:
    """Count an event of this step, and those in a row within `RAPID` of each other."""
    state.events_in_step += 1
    if w.time - w.last_event > RAPID:
        state.rapid_events = 0
    else:
        state.rapid_events += 1
    w.last_event = w.time


@kernel
def too_many_events(state: State, most_rapid: int) -> bool:
    """Return whether there are too many events at one instant, or in the latest steps, and write the status then."""
    if state.events_in_step > MAX_IN_STEP:
        state.status = CROWDED
        return True
    if state.rapid_events > most_rapid:
        state.status = RUBS if state.kind in (STICK, SLIP_AGAIN, REVERSAL) else CHATTER
        return True
    return False


@kernel_inlined
def check_stage(w: Work, state: State) -> int:
    """Return ADVANCE, or if f is negative at a stage RETRY_SUBSTEP, with a trial step to the stage's instant.

    So a negative f that begins and ends within the step is found if a stage samples it. A stage is of lower order than
    the step: the event is searched for only if f is negative at the end of the trial step too.
    """
    tau = w.time - w.begin_time
    if (
        state.together != 0
        or state.trial != NO_TRIAL
        or state.mode == FREE
        or not w.rigid_force < 0.0
        or tau > w.length - INSTANT
    ):
        return ADVANCE
    state.trial, state.trials = CHECK_STAGE, 0
    w.low, w.high, w.tau = 0.0, tau, tau
    w.at_low = max(w.start_event_value, 0.0)
    return RETRY_SUBSTEP


@kernel
def end_before_stage(w: Work, state: State) -> int:
    """Search for the event before a stage at which no forces go with the modes of the contacts."""
    if state.trial == REACH_EVENT:
        w.tau = w.low
        return RETRY_SUBSTEP
    if state.trial > STAGE_CHECKED:
        w.event_value = -1.0
        return int(refine_bracket(w, state))
    state.trial, state.trials = LOCATE_EVENT, 0
    w.low, w.high = 0.0, w.tau - INSTANT
    w.at_low, w.at_high = max(w.start_event_value, 0.0), -1.0
    choose_trial(w, state)
    return RETRY_SUBSTEP


@kernel_inlined
def check_step(w: Work, drift: float, state: State) -> int:
    """Return the action at the end of a step: BEGIN_SUBSTEP, APPLY_EVENT here, or RETRY_SUBSTEP to locate an event."""
    here = state.row == 0 or state.no_search != 0  # there is no earlier instant to search
    trial = NO_TRIAL
    if state.mode != FREE or state.together != 0:
        if w.event_value < 0.0:
            trial = REACH_EVENT if here else LOCATE_EVENT
    elif state.unilateral != 0:
        leaving = LEAVING + (w.length * w.length * abs(drift) if state.stages == 1 else 0.0)
        if state.beside != 0:
            if w.gap > leaving:
                state.beside = 0
        elif here:
            if w.gap <= TOUCHING and w.rate < -RESTING:
                trial = REACH_EVENT
        elif w.gap < -(SHALLOW if state.risen != 0 else leaving):
            trial = LOCATE_EVENT
        elif state.risen != 0 and w.start_rate < -RESTING and w.rate > 0.0:
            trial = LOCATE_MINIMUM  # down and up again: locate the lowest point
        if w.gap > leaving:
            state.risen = 1
    if state.together == 0:
        if state.stops != 0 and w.stop_margin < 0.0:
            trial = REACH_EVENT if here else LOCATE_EVENT
        if state.contacts != 0 and w.contact_margin < 0.0:
            trial, state.watched = REACH_EVENT if here else LOCATE_EVENT, 1
            w.start_event_value = min(w.start_event_value, w.start_contact_margin)
            w.event_value = min(w.event_value, w.contact_margin)
    state.trial = trial
    if trial == NO_TRIAL:
        return BEGIN_SUBSTEP
    if trial == REACH_EVENT:
        return APPLY_EVENT
    state.trials = 0
    w.low, w.high = 0.0, w.length
    if trial == LOCATE_MINIMUM:
        w.at_low, w.at_high = -w.start_rate, -w.rate
    else:
        w.at_low, w.at_high = max(w.start_event_value, 0.0), w.event_value
    choose_trial(w, state)
    return RETRY_SUBSTEP
