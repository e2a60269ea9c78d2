"""What an event does: an impact, the end of contact, of slip or of sticking, and the mode that follows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    apply_impulse,
    normal_rounding,
    pressed_force,
    stuck_force,
    stuck_tangentially,
)
from closedloop.closure.solve import CHATTER, OK
from closedloop.events.contacts import apply_contact_event, resume_with_contacts
from closedloop.events.locate import cone_margin
from closedloop.events.phases import (
    AFTER_EVENT,
    APPLY_EVENT,
    APPLY_IMPACT,
    AT_EVENT,
    BEGIN_SUBSTEP,
    DIRECTIONS,
    ENLARGE_TABLE,
    FAIL,
    IMPULSES_KNOWN,
    INSTANT,
    MAX_IN_STEP,
    MAX_RAPID,
    NEED_TERMS,
    PROJECT,
    RAPID,
    RESTING,
    SOLVE_IMPACT,
    STEP_END,
    TOUCHING,
    request_terms,
)
from closedloop.events.stops import (
    BEYOND,
    MOST_TRIALS,
    REACHED,
    energy_of_jump,
    note_sides,
    reach_stops,
    release_stops,
    yield_stops,
)
from closedloop.events.table import (
    EDGE,
    IMPACT,
    LIFTOFF,
    RELEASE,
    REVERSAL,
    SLIP_AGAIN,
    STICK,
    STOP,
    TOUCHDOWN,
    write_event,
)
from closedloop.impact import CUT as ENERGY_CUT
from closedloop.impact import MODES, energy_lost, impact
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.step.closed_loops import factorise_tip
from closedloop.step.entries import LIMIT, RESTART, SLIDE
from closedloop.step.entries import STICK as END_OF_SLIP
from closedloop.step.evaluate import call_law
from closedloop.step.locate import set_anchor
from closedloop.step.memory import RIGID_STICK, SPRING_STICK, Constants, State, Work, loop_at
from closedloop.step.soft_contact import spring_energy
from closedloop.step.tip_friction import delayed_speed

Array = NDArray[np.float64]


@kernel
def resume_after_event(C: Array, w: Work, constants: Constants, state: State, events: Array) -> int:
    """Continue after an event to the end of the step, unless the mode is inconsistent with the state."""
    if state.contacts != 0:
        return resume_with_contacts(w, constants, state, events)
    if state.mode == FREE:
        # A tip just after liftoff that accelerates towards the surface has not left it: at the projected state f is
        # still positive; or the law presses when the tip is free and lifts when it is in contact.
        let_go = state.kind == LIFTOFF and w.last_event == w.time
        back = let_go and w.gap <= TOUCHING and abs(w.rate) <= RESTING and w.a[0] < 0.0
        if back and w.a[0] < -normal_rounding(w.L, w.X, w.drift_c, w.torque, w.joint_friction, C, w.column):
            make_contact(w, constants, state, np.hypot(w.u[1], w.u[2]))
            state.events -= 1
            state.events_in_step += 1
            if state.events_in_step > MAX_IN_STEP or state.rapid_events > MAX_RAPID:
                state.status = CHATTER
                return FAIL
            request_terms(state, AFTER_EVENT)
            return NEED_TERMS
    elif (state.unilateral != 0 and w.rigid_force < 0.0) or (state.mode == STUCK and cone_margin(w, state) < 0.0):
        return APPLY_EVENT
    if state.stops != 0 and w.stop_margin < 0.0:
        return APPLY_EVENT
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
def apply_event(H: Array, w: Work, constants: Constants, state: State, rows: Array, events: Array) -> int:
    """Apply the event at this state: an impact, the end of the contact, of slip or of sticking."""
    if state.events >= events.shape[0]:
        state.phase = AT_EVENT
        return ENLARGE_TABLE
    if state.contacts != 0:
        return apply_contact_event(w, state, events)
    if state.mode == FREE and state.surface != 0 and w.inside < 0.0:  # there is no surface to touch
        state.beside = 1
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    state.events_in_step += 1
    if w.time - w.last_event > RAPID:
        state.rapid_events = 0
    else:
        state.rapid_events += 1
    w.last_event = w.time
    if state.events_in_step > MAX_IN_STEP or (state.rapid_events > MAX_RAPID and state.mode != FREE):
        state.status = CHATTER
        return FAIL
    if state.mode == FREE:
        state.status = factorise_tip(H, w, constants, state)
        if state.status != OK:
            return FAIL
    for i in range(3):
        w.before[i] = w.u[i]
        w.after[i] = w.u[i]
        w.compression[i] = 0.0
        w.decompression[i] = 0.0
    w.discarded_rebound, w.restitution_given = 0.0, 0.0
    if state.stops != 0 and w.stop_margin < BEYOND + REACHED:
        if reach_stops(w, constants, state):
            state.kind = STOP
            log_event(w, constants, state, events, energy_of_jump(w))
            if state.law != 0:
                call_law(state, RESTART)
            request_terms(state, AFTER_EVENT)
            return NEED_TERMS
        if release_stops(w):
            state.kind = RELEASE
            log_event(w, constants, state, events, 0.0)
            request_terms(state, AFTER_EVENT)
            return NEED_TERMS
    if state.stops != 0 and state.mode == FREE and w.gap > TOUCHING + REACHED:  # it was for a stop, and there is none
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    if state.mode == FREE:
        # At the end of a step of first order the gap may be negative and the velocity upwards: contact, no impulse.
        state.phase, state.kind = IMPULSES_KNOWN, TOUCHDOWN
        return SOLVE_IMPACT if w.u[0] < 0.0 and state.compliance == 0 else APPLY_IMPACT
    if state.surface != 0 and w.inside < 0.0:
        # The velocity stays what it is: f ends, there and then. What the spring has stored is not the arm's.
        state.mode, state.risen, state.beside, state.kind = FREE, 0, 1, EDGE
        stored = spring_energy(w, constants, state) if state.compliance != 0 else 0.0
        log_event(w, constants, state, events, stored)
        w.supplied += stored
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    if state.unilateral != 0 and w.rigid_force < 0.0:
        state.mode, state.risen, state.kind = FREE, 0, LIFTOFF
        if state.compliance != 0:
            log_event(w, constants, state, events, 0.0)
            request_terms(state, AFTER_EVENT)
            return NEED_TERMS
        w.after[0] = 0.0
        log_event(w, constants, state, events, 0.5 * w.u[0] * w.u[0] / w.S[0, 0])
        # The tip leaves from the surface itself: the error that the stabiliser had not yet removed is projected out.
        state.projections, state.next_phase = 0, AFTER_EVENT
        return PROJECT
    if state.sticking in (RIGID_STICK, SPRING_STICK):
        return end_stick_or_slip(w, constants, state, rows, events)
    request_terms(state, AFTER_EVENT)
    return NEED_TERMS


@kernel
def end_stick_or_slip(w: Work, constants: Constants, state: State, rows: Array, events: Array) -> int:
    """Apply the end of sticking, or of slip: it sticks, or goes on in another direction."""
    loss, size = 0.0, np.hypot(w.F[1], w.F[2])
    if state.mode == STUCK and not size > 0.0:  # no tangential force: f goes to zero, and is not negative yet
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    if state.mode == STUCK:  # slip starts against the friction force that held the tip
        state.mode, state.kind = PRESSED, SLIP_AGAIN
        w.direction[0], w.direction[1] = -w.F[1] / size, -w.F[2] / size
        if state.sticking == RIGID_STICK:  # slip starts from rest: the velocity left by errors is removed
            loss = stop_tip(w, state)
    else:
        speed = np.hypot(w.u[1], w.u[2])
        slow = speed <= max(2.0 * constants.stick_speed, constants.capture_speed * (1.0 + 1e-9))
        if state.sticking == SPRING_STICK:
            w.delayed_slip = delayed_speed(w, constants, state, rows, constants.lag, speed)
            w.event_value = 0.0
            call_at(state.friction, state.address, END_OF_SLIP)
            state.mode, state.kind = STUCK, STICK
        else:
            held = OK
            for i in range(3):
                w.b[i] = 0.0
            if state.compliance != 0:
                stuck_tangentially(w.S, w.a, w.b, w.F)
            else:
                held = stuck_force(w.S, w.a, w.b, w.F, w.stabiliser_force)
            size = np.hypot(w.F[1], w.F[2])
            call_at(state.friction, state.address, LIMIT)
            if held == OK and slow and size <= w.stick_limit * abs(w.F[0]):
                state.mode, state.kind = STUCK, STICK
                set_anchor(w, state)
                loss = stop_tip(w, state)
            elif not slow:  # slip has turned by a right angle since the substep began, and goes on
                w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
                request_terms(state, AFTER_EVENT)
                return NEED_TERMS
            else:
                state.kind = REVERSAL
                find_direction(w, state)
    log_event(w, constants, state, events, loss)
    request_terms(state, AFTER_EVENT)
    return NEED_TERMS


@kernel
def stop_tip(w: Work, state: State) -> float:
    """Set the tip's velocity u to zero by an impulse, on a soft surface that along it; return the energy lost, J."""
    for i in range(3):
        w.a[i], w.b[i], w.after[i] = w.u[i], 0.0, 0.0
    if state.compliance != 0:
        w.compression[0] = 0.0
        stuck_tangentially(w.S, w.a, w.b, w.compression)
        w.after[0] = w.u[0] + w.S[0, 1] * w.compression[1] + w.S[0, 2] * w.compression[2]
    else:
        stuck_force(w.S, w.a, w.b, w.compression, w.stabiliser_force)
    apply_impulse(w.L, w.X, w.compression, w.column, w.v)
    return float(energy_lost(w.before, w.after, w.compression))


@kernel
def find_direction(w: Work, state: State) -> None:
    """Write the direction in which slip starts that friction cannot prevent: that in which the tip then accelerates.

    The tip's mobility is anisotropic, so the direction is a root of the angle between it and the acceleration with
    friction against it, found by a scan of the circle and bisection.
    """
    w.slip[0], w.slip[1], w.delayed_slip = 0.0, 0.0, 0.0
    best, here, before = -1.0, 0.0, 0.0
    low = 0.0
    for i in range(DIRECTIONS + 1):
        angle = 2.0 * np.pi * i / DIRECTIONS
        across, along = slip_onset(w, state, angle)
        if i > 0 and before * across <= 0.0 and along > 0.0:
            a, b, sign = low, angle, before
            for _ in range(60):
                middle = 0.5 * (a + b)
                across_middle, along_middle = slip_onset(w, state, middle)
                if across_middle * sign > 0.0:
                    a = middle
                else:
                    b = middle
            across_middle, along_middle = slip_onset(w, state, b)
            if along_middle > best:
                best, here = along_middle, b
        low, before = angle, across
    w.direction[0], w.direction[1] = math.cos(here), math.sin(here)


@kernel
def slip_onset(w: Work, state: State, angle: float) -> tuple[float, float]:
    """Return the acceleration across and along a direction if slip starts in it, m/s²."""
    w.direction[0], w.direction[1] = math.cos(angle), math.sin(angle)
    call_at(state.friction, state.address, SLIDE)
    pressed_force(w.S, w.a, 0.0, w.c, w.viscous, w.F)
    a1 = w.a[1] + w.S[1, 0] * w.F[0] + w.S[1, 1] * w.F[1] + w.S[1, 2] * w.F[2]
    a2 = w.a[2] + w.S[2, 0] * w.F[0] + w.S[2, 1] * w.F[1] + w.S[2, 2] * w.F[2]
    d1, d2 = w.direction[0], w.direction[1]
    return float(d1 * a2 - d2 * a1), float(d1 * a1 + d2 * a2)


@kernel
def log_event(w: Work, constants: Constants, state: State, events: Array, energy: float) -> None:
    """Write the event state.kind into the table, and subtract its energy loss from the energy supplied."""
    write_event(
        events[state.events], w.time, state.kind, w.discarded_rebound, w.restitution_given, w.frame, w.r,
        w.before, w.after, w.compression, w.decompression, energy,
    )  # fmt: skip
    state.events += 1
    w.supplied -= energy
    for i in range(3):  # a surface that moves does work on the arm
        w.supplied += (w.compression[i] + w.decompression[i]) * w.carried[i]


@kernel
def apply_impact(w: Work, constants: Constants, state: State, events: Array) -> None:
    """Apply the impulses of an impact to q̇, and set the mode after it."""
    for i in range(3):
        w.F[i] = w.compression[i] + w.decompression[i]
    apply_impulse(w.L, w.X, w.F, w.column, w.v)
    log_event(w, constants, state, events, energy_lost(w.before, w.after, w.F))
    state.risen = 1
    if state.law != 0:
        call_law(state, RESTART)
        at = state.law_states + state.sensor_states
        for i in range(at, at + state.friction_states):
            w.z[i] = 0.0  # of a contact just made
        speed = np.hypot(w.after[1], w.after[2])
        if speed > 0.0:
            w.direction[0], w.direction[1] = w.after[1] / speed, w.after[2] / speed
    if state.kind == TOUCHDOWN:
        make_contact(w, constants, state, np.hypot(w.after[1], w.after[2]))


@kernel
def make_contact(w: Work, constants: Constants, state: State, speed: float) -> None:
    """Set the mode of a tip on the surface: STUCK if its law of friction sticks and it is slow enough, else PRESSED."""
    state.mode = PRESSED
    if state.sticking in (RIGID_STICK, SPRING_STICK) and speed <= constants.stick_speed:
        state.mode = STUCK
        set_anchor(w, state)


@entry_kernel
def collide(address: int) -> None:
    """Compute the impulses of the impact at the present state, and whether it ends in contact.

    The address is that of the loop's memory, see `closedloop.step.memory.loop_at`. The function is separate from
    `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    state, constants, w = loop_at(address)
    if state.stops == 0:
        strike_surface(w, constants, state)
        return
    note_sides(w)
    for _ in range(MOST_TRIALS):
        strike_surface(w, constants, state)
        if state.status != OK or not yield_stops(w, state):
            return


@kernel
def strike_surface(w: Work, constants: Constants, state: State) -> None:
    """Do the same with the stops that hold joints now."""
    bounces = state.rapid_events <= MAX_RAPID
    state.kind, w.discarded_rebound, w.restitution_given = IMPACT if bounces else TOUCHDOWN, 0.0, 0.0
    for _ in range(2):
        restitution = constants.restitution if state.kind == IMPACT else 0.0
        state.status = impact(
            w.S, w.before, restitution, state.impact_law, constants.impact_friction, w.scratch,
            (w.compression, w.decompression), w.after,
        )  # fmt: skip
        if state.status != OK or state.kind == TOUCHDOWN:
            return
        if w.after[0] >= constants.rest_speed:
            cut = int(w.scratch[MODES]) & ENERGY_CUT != 0
            w.restitution_given = -w.after[0] / w.before[0] if cut else restitution
            return
        state.kind, w.discarded_rebound = TOUCHDOWN, w.after[0]
