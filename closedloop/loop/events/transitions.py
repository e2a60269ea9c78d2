"""What an event does: impacts of the tip, the end of contact, of slip or of sticking, and the mode that follows."""

import math

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at, row_of
from closedloop.jit.dual8 import along, has_derivatives, settled, slope_of, sought
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.loop.events.contacts import apply_contact_event, resume_with_contacts
from closedloop.loop.events.locate import (
    AFTER_EVENT,
    APPLY_EVENT,
    APPLY_IMPACT,
    AT_EVENT,
    DIRECTIONS,
    ENLARGE_TABLE,
    FAIL,
    IMPULSES_KNOWN,
    NEED_TERMS,
    PROJECT,
    SOLVE_IMPACT,
    cone_margin,
    request_terms,
)
from closedloop.loop.events.substep import count_event, resume_step, too_many_events
from closedloop.loop.events.table import EDGE, IMPACT, LIFTOFF, REVERSAL, SLIP_AGAIN, STICK, TOUCHDOWN, write_event
from closedloop.loop.step.closed_loops import factorise_tip, impulse_of_frames
from closedloop.loop.step.entries import RESTART
from closedloop.loop.step.evaluate import call_law
from closedloop.loop.step.locate import set_anchor
from closedloop.loop.step.memory import RIGID_STICK, SPRING_STICK, Constants, State, Work, loop_at
from closedloop.loop.step.solve_contact import rub_softly, rubbed_force, spring_energy
from closedloop.loop.step.tip_friction import delayed_speed
from closedloop.mechanics.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    apply_impulse,
    normal_rounding,
    stuck_force,
    stuck_tangentially,
)
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.friction import friction_of_impact
from closedloop.mechanics.contacts.impact import own_rest_speed
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.friction.answers import LIMIT, SLIDE
from closedloop.mechanics.friction.answers import STICK as END_OF_SLIP
from closedloop.mechanics.impact import CUT as ENERGY_CUT
from closedloop.mechanics.impact import ImpactWork, energy_lost, impact
from closedloop.mechanics.limits import FOUND, ITERATIONS, MAX_IN_STEP, RESTING, TOUCHING


@kernel
def log_event(w: Work, constants: Constants, state: State, events: Array, energy: float) -> None:
    """Write the event state.event.kind into the table, and subtract its energy loss from the energy supplied."""
    x = w.impact
    write_event(
        row_of(events, state.event.rows), w.time, state.event.kind, x.discarded_rebound, x.restitution_given,
        w.tip.frame, w.r, x.before, x.after, x.compression, x.decompression, energy, x.energy_rested,
    )  # fmt: skip
    state.event.rows += 1
    w.supply.energy -= energy
    for i in range(3):  # a surface that moves does work on the arm
        w.supply.energy += (x.compression[i] + x.decompression[i]) * w.tip.carried[i]
    if state.loops.frames != 0:
        for i in range(3):
            w.scratch.target[i] = x.compression[i] + x.decompression[i]
        w.supply.energy += impulse_of_frames(w, w.tip.X, w.scratch.target, x.after, w.tip.carried)


@kernel
def apply_impact(w: Work, constants: Constants, state: State, events: Array) -> None:
    """Apply the impulses of an impact to q̇, and set the mode after it."""
    lost = lost_in_both(w)
    apply_impulse(w.L, w.tip.X, w.tip.F, w.scratch.column, w.v)
    log_event(w, constants, state, events, lost)
    state.cleared = 1
    if state.settings.general != 0:
        call_law(state, RESTART)
        at = state.law_states + state.sensor.states
        for i in range(at, at + state.friction.states):
            w.z[i] = 0.0  # of a contact just made
        speed = np.hypot(w.impact.after[1], w.impact.after[2])
        if speed > 0.0:
            w.friction.direction[0], w.friction.direction[1] = w.impact.after[1] / speed, w.impact.after[2] / speed
    if state.event.kind == TOUCHDOWN:
        make_contact(w, constants, state, np.hypot(w.impact.after[1], w.impact.after[2]))


@kernel
def make_contact(w: Work, constants: Constants, state: State, speed: float) -> None:
    """Set the mode of a tip on the surface: STUCK if its law of friction sticks and it is slow enough, else PRESSED."""
    state.mode = PRESSED
    if state.friction.sticking in (RIGID_STICK, SPRING_STICK) and speed <= constants.stick_speed:
        state.mode = STUCK
        set_anchor(w, state)


@kernel
def lost_in_both(w: Work) -> float:
    """Return the energy that the two phases of an impact take, J, and write their impulse as F."""
    for i in range(3):
        w.tip.F[i] = w.impact.compression[i] + w.impact.decompression[i]
    return float(energy_lost(w.impact.before, w.impact.after, w.tip.F))


@entry_kernel
def collide(address: int) -> None:
    """Compute the impulses of the impact at the present state, and whether it ends in contact.

    The address is that of the loop's memory, see `closedloop.loop.step.memory.loop_at`. The function is separate from
    `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    state, constants, w = loop_at(address)
    if state.coupled != 0:
        links, c = contacts_at(state.contacts.at)
        mu, rest = friction_of_impact(links, c, state.striking), own_rest_speed(c, state.striking, constants.rest_speed)
        strike_surface(c.S[state.striking], mu, rest, w, constants, state)
        return
    strike_surface(w.tip.S, constants.impact_friction, constants.rest_speed, w, constants, state)


@kernel
def strike_surface(S: Array, mu: float, rest_speed: float, w: Work, constants: Constants, state: State) -> None:
    """Write the impulses on a point of mobility S (3, 3), 1/kg, that strikes with `before`, and the kind of event.

    If the rebound is slower than `rest_speed`, m/s, the tip stays in contact.
    """
    bounces = state.event.rapid <= ITERATIONS
    state.event.kind, w.impact.discarded_rebound, w.impact.restitution_given = (
        IMPACT if bounces else TOUCHDOWN,
        0.0,
        0.0,
    )
    w.impact.energy_rested, bounced = 0.0, 0.0
    for _ in range(2):
        restitution = constants.restitution if state.event.kind == IMPACT else 0.0
        state.status = impact(
            S, w.impact.before, restitution, state.settings.impact_law, mu, w.scratch.numbers,
            (w.impact.compression, w.impact.decompression), w.impact.after,
        )  # fmt: skip
        if state.status != OK or state.event.kind == TOUCHDOWN:
            if w.impact.discarded_rebound > 0.0:
                w.impact.energy_rested = lost_in_both(w) - bounced
            return
        if w.impact.after[0] >= rest_speed:
            cut = int(ImpactWork(w.scratch.numbers).happened) & ENERGY_CUT != 0
            w.impact.restitution_given = -w.impact.after[0] / w.impact.before[0] if cut else restitution
            return
        state.event.kind, w.impact.discarded_rebound, bounced = TOUCHDOWN, w.impact.after[0], lost_in_both(w)


@kernel_inlined
def would_pull(w: Work, state: State) -> bool:
    """Whether a surface from which the tip can lift off would have to pull at it."""
    return state.settings.unilateral != 0 and w.tip.rigid_force < 0.0


@kernel
def resume_after_event(C: Array, w: Work, constants: Constants, state: State, events: Array) -> int:
    """Continue after an event to the end of the step, unless the mode is inconsistent with the state."""
    if state.coupled != 0:
        return resume_with_contacts(w, constants, state, events)
    if state.mode == FREE:
        # A tip just after liftoff that accelerates towards the surface has not left it: at the projected state f is
        # still positive; or the law presses when the tip is free and lifts when it is in contact.
        let_go = state.event.kind == LIFTOFF and w.last_event == w.time
        back = let_go and w.tip.gap <= TOUCHING and abs(w.tip.rate) <= RESTING and w.tip.a[0] < 0.0
        if back and w.tip.a[0] < -normal_rounding(C, w):
            make_contact(w, constants, state, np.hypot(w.tip.u[1], w.tip.u[2]))
            state.event.rows -= 1
            state.event.in_step += 1
            if too_many_events(state, ITERATIONS):
                return FAIL
            request_terms(state, AFTER_EVENT)
            return NEED_TERMS
    elif would_pull(w, state) or (state.mode == STUCK and cone_margin(w, state) < 0.0):
        return APPLY_EVENT
    if w.contacts.margin < 0.0:
        return APPLY_EVENT
    return resume_step(w, constants, state)


@kernel
def apply_event(H: Array, w: Work, constants: Constants, state: State, rows: Array, events: Array) -> int:
    """Apply the event at this state: an impact, the end of the contact, of slip or of sticking."""
    if state.event.rows >= events.shape[0]:
        state.phase = AT_EVENT
        return ENLARGE_TABLE
    # The instant may be a rounding before the one at which a contact closes.
    closes = w.contacts.margin < 0.0 or (state.mode == FREE and w.contacts.margin <= min(w.tip.gap, TOUCHING))
    if state.coupled != 0 or closes:
        return apply_contact_event(w, constants, state, events)
    if state.mode == FREE and w.tip.inside < 0.0:  # there is no surface to touch
        state.past_edge = 1
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    count_event(w, state)
    if too_many_events(state, ITERATIONS if state.mode != FREE else MAX_IN_STEP):
        return FAIL
    if state.mode == FREE:
        state.status = factorise_tip(H, w, constants, state)
        if state.status != OK:
            return FAIL
    for i in range(3):
        w.impact.before[i] = w.tip.u[i]
        w.impact.after[i] = w.tip.u[i]
        w.impact.compression[i] = 0.0
        w.impact.decompression[i] = 0.0
    w.impact.discarded_rebound, w.impact.restitution_given, w.impact.energy_rested = 0.0, 0.0, 0.0
    if state.mode == FREE:
        # At the end of a step of first order the gap may be negative and the velocity upwards: contact, no impulse.
        state.phase, state.event.kind = IMPULSES_KNOWN, TOUCHDOWN
        return SOLVE_IMPACT if w.tip.u[0] < 0.0 and state.compliance.entry == 0 else APPLY_IMPACT
    if w.tip.inside < 0.0:
        # The velocity stays what it is: f ends, there and then. What the spring has stored is not the arm's.
        state.mode, state.cleared, state.past_edge, state.event.kind = FREE, 0, 1, EDGE
        stored = spring_energy(w, constants, state) if state.compliance.entry != 0 else 0.0
        log_event(w, constants, state, events, stored)
        w.supply.energy += stored
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    if would_pull(w, state) and not held_by_pulling(w, state):
        state.mode, state.cleared, state.event.kind = FREE, 0, LIFTOFF
        if state.compliance.entry != 0:
            log_event(w, constants, state, events, 0.0)
            request_terms(state, AFTER_EVENT)
            return NEED_TERMS
        w.impact.after[0] = 0.0
        log_event(w, constants, state, events, 0.5 * w.tip.u[0] * w.tip.u[0] / w.tip.S[0, 0])
        # The tip leaves from the surface itself: the error that the stabiliser had not yet removed is projected out.
        state.projection.moves, state.projection.next_phase = 0, AFTER_EVENT
        return PROJECT
    if state.friction.sticking in (RIGID_STICK, SPRING_STICK):
        return end_stick_or_slip(w, constants, state, rows, events)
    request_terms(state, AFTER_EVENT)
    return NEED_TERMS


@kernel
def held_by_pulling(w: Work, state: State) -> bool:
    """Whether the surface would have to pull at a tip that sticks, though without any force the tip comes towards it.

    The force that holds it along the surface lifts it. It cannot leave, nor stick: it slips.
    """
    return state.mode == STUCK and w.tip.a[0] < 0.0 and state.compliance.entry == 0


@kernel
def end_stick_or_slip(w: Work, constants: Constants, state: State, rows: Array, events: Array) -> int:
    """Apply the end of sticking, or of slip: it sticks, or goes on in another direction."""
    loss, size = 0.0, np.hypot(w.tip.F[1], w.tip.F[2])
    if state.mode == STUCK and not size > 0.0:  # no tangential force: f goes to zero, and is not negative yet
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    if state.mode == STUCK:  # slip starts against the friction force that held the tip
        state.mode, state.event.kind = PRESSED, SLIP_AGAIN
        w.friction.direction[0], w.friction.direction[1] = -w.tip.F[1] / size, -w.tip.F[2] / size
        if would_pull(w, state):
            find_direction(w, state)
        if state.friction.sticking == RIGID_STICK:  # slip starts from rest: the velocity left by errors is removed
            loss = stop_tip(w, state)
            w.start.slip_speed = 0.0  # that of the substep before was such an error, and judges this slip no more
    else:
        speed = np.hypot(w.tip.u[1], w.tip.u[2])
        slow = speed <= max(2.0 * constants.stick_speed, constants.capture_speed * (1.0 + FOUND))
        if state.friction.sticking == SPRING_STICK:
            w.friction.delayed_slip = delayed_speed(w, constants, state, rows, constants.lag, speed)
            w.search.value = 0.0
            call_at(state.friction.entry, state.address, END_OF_SLIP)
            state.mode, state.event.kind = STUCK, STICK
        else:
            held = OK
            for i in range(3):
                w.tip.b[i] = 0.0
            if state.compliance.entry != 0:
                stuck_tangentially(w.tip.S, w.tip.a, w.tip.b, w.tip.F)
            else:
                held = stuck_force(w.tip.S, w.tip.a, w.tip.b, w.tip.F, w.tip.stabiliser_force)
            size = np.hypot(w.tip.F[1], w.tip.F[2])
            call_at(state.friction.entry, state.address, LIMIT)
            pulls = state.settings.unilateral != 0 and w.tip.F[0] < 0.0
            if held == OK and slow and not pulls and size <= w.friction.stick_limit * abs(w.tip.F[0]):
                state.mode, state.event.kind = STUCK, STICK
                set_anchor(w, state)
                loss = stop_tip(w, state)
            elif not slow:  # slip has turned by a right angle since the substep began, and goes on
                w.friction.direction[0], w.friction.direction[1] = w.tip.u[1] / speed, w.tip.u[2] / speed
                request_terms(state, AFTER_EVENT)
                return NEED_TERMS
            else:
                state.event.kind = REVERSAL
                w.start.slip_speed = 0.0  # as where sticking ends: the slip in the new direction starts from rest
                find_direction(w, state)
    log_event(w, constants, state, events, loss)
    request_terms(state, AFTER_EVENT)
    return NEED_TERMS


@kernel
def stop_tip(w: Work, state: State) -> float:
    """Set the tip's velocity u to zero by an impulse, on a soft surface that along it; return the energy lost, J."""
    for i in range(3):
        w.tip.a[i], w.tip.b[i], w.impact.after[i] = w.tip.u[i], 0.0, 0.0
    if state.compliance.entry != 0:
        w.impact.compression[0] = 0.0
        stuck_tangentially(w.tip.S, w.tip.a, w.tip.b, w.impact.compression)
        w.impact.after[0] = (
            w.tip.u[0] + w.tip.S[0, 1] * w.impact.compression[1] + w.tip.S[0, 2] * w.impact.compression[2]
        )
    else:
        stuck_force(w.tip.S, w.tip.a, w.tip.b, w.impact.compression, w.tip.stabiliser_force)
    apply_impulse(w.L, w.tip.X, w.impact.compression, w.scratch.column, w.v)
    return float(energy_lost(w.impact.before, w.impact.after, w.impact.compression))


@kernel
def find_direction(w: Work, state: State) -> None:
    """Write the direction in which slip starts that friction cannot prevent: that in which the tip then accelerates.

    The tip's mobility is anisotropic, so the direction is a root of the angle between it and the acceleration with
    friction against it, found by a scan of the circle and bisection.
    """
    w.friction.slip[0], w.friction.slip[1], w.friction.delayed_slip = 0.0, 0.0, 0.0
    best, here, before = -1.0, 0.0, 0.0
    low = 0.0
    for i in range(DIRECTIONS + 1):
        angle = 2.0 * np.pi * i / DIRECTIONS
        across, forward = slip_onset(w, state, angle)
        if i > 0 and before * across <= 0.0 and forward > 0.0:
            a, b, sign = low, angle, before
            for _ in range(60):
                middle = 0.5 * (a + b)
                across_middle, along_middle = slip_onset(w, state, middle)
                if across_middle * sign > 0.0:
                    a = middle
                else:
                    b = middle
            if has_derivatives(across):
                across_middle, along_middle = slip_onset(w, state, along(b))
                slope = slope_of(across_middle)
                across_middle, along_middle = slip_onset(w, state, sought(b))
                b = settled(sought(b), across_middle, slope)
            across_middle, along_middle = slip_onset(w, state, b)
            if along_middle > best:
                best, here = along_middle, b
        low, before = angle, across
    w.friction.direction[0], w.friction.direction[1] = math.cos(here), math.sin(here)


@kernel
def slip_onset(w: Work, state: State, angle: float) -> tuple[float, float]:
    """Return the acceleration across and along a direction if slip starts in it, m/s²."""
    w.friction.direction[0], w.friction.direction[1] = math.cos(angle), math.sin(angle)
    call_at(state.friction.entry, state.address, SLIDE)
    if state.compliance.entry != 0:  # f is that of the depth
        rub_softly(w)
    else:
        rubbed_force(0.0, w, state)
    a1 = w.tip.a[1] + w.tip.S[1, 0] * w.tip.F[0] + w.tip.S[1, 1] * w.tip.F[1] + w.tip.S[1, 2] * w.tip.F[2]
    a2 = w.tip.a[2] + w.tip.S[2, 0] * w.tip.F[0] + w.tip.S[2, 1] * w.tip.F[1] + w.tip.S[2, 2] * w.tip.F[2]
    d1, d2 = w.friction.direction[0], w.friction.direction[1]
    return float(d1 * a2 - d2 * a1), float(d1 * a1 + d2 * a2)
