"""What an event does: an impact, the end of contact, of slip or of sticking, and the mode that follows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    factorise,
    normal_rounding,
    pressed_force,
    strike,
    stuck_force,
)
from closedloop.closure.solve import CHATTER, OK
from closedloop.control.laws import restart
from closedloop.events.locate import cone
from closedloop.events.phases import (
    ARRIVING,
    ASK,
    BEGINNING,
    CLOSE,
    COLLIDE,
    DIRECTIONS,
    ENLARGE,
    FAIL,
    INSTANT,
    MOST_IN_STEP,
    MOST_RUSHED,
    RESTING,
    RUSH,
    SET_OUT,
    STRIKE,
    STRIKING,
    TOUCHING,
    TRANSIT,
    TRANSITING,
    ask,
    extra_states,
)
from closedloop.events.table import IMPACT, LIFTOFF, REVERSAL, SLIP_AGAIN, STICK, TOUCHDOWN, write_event
from closedloop.friction.laws import capture_speed, contact_states, memory_delay, sliding, stick_limit, stick_states
from closedloop.impact import CUT as ENERGY_CUT
from closedloop.impact import MODES, energy_lost, impact
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.step.evaluate import LAW_GIVEN
from closedloop.step.memory import (
    CERTAIN,
    CUT,
    EVENTS,
    FRAME,
    FRICTION,
    FRICTION_AT,
    FRICTION_STATES,
    FRICTION_WIDTH,
    GAP,
    GAUGE,
    GIVEN,
    H_STEP,
    IMPACT_FRICTION,
    IMPACT_LAW,
    IN_STEP,
    KIND,
    LAST_EVENT,
    LAW,
    LAW_STATES,
    LAW_WIDTH,
    LENGTH,
    MODE,
    MOVES,
    NEXT,
    PHASE,
    PIECE,
    RATE,
    REACH,
    REST_SPEED,
    RESTITUTION,
    RIGID,
    RIGID_STICK,
    RISEN,
    ROW,
    RUSHED,
    SENSOR_RING,
    SENSOR_STATES,
    SPRING_STICK,
    STAGES,
    STATUS,
    STICK_SPEED,
    STICKING,
    SUPPLIED,
    TIME,
    UNILATERAL,
    Whole,
    Work,
    law_at,
    workspace,
)
from closedloop.step.tip_friction import delayed_speed

Array = NDArray[np.float64]


@kernel
def begin_piece(C: Array, w: Work, k: Array, state: Whole, more: int | None) -> int:
    """Look at the state just after an event, and set out from it for the end of the step, unless its mode cannot be."""
    now = w.now
    if state[MODE] == FREE:
        # A tip that the surface has just let go, and that would fall back at once, has not left: on the closure, where
        # its last act has put the tip, f is still positive; or the law pushes when free and pulls when pressed.
        let_go = state[KIND] == LIFTOFF and now[LAST_EVENT] == now[TIME]
        back = let_go and now[GAP] <= TOUCHING and abs(now[RATE]) <= RESTING and w.a[0] < 0.0
        if back and w.a[0] < -normal_rounding(w.L, w.X, w.drift_c, w.torque, w.loss, C, w.column):
            make_contact(w, k, state, np.hypot(w.u[1], w.u[2]))
            state[EVENTS] -= 1
            state[IN_STEP] += 1
            if state[IN_STEP] > MOST_IN_STEP or state[RUSHED] > MOST_RUSHED:
                state[STATUS] = CHATTER
                return FAIL
            ask(state, BEGINNING)
            return ASK
    elif (state[UNILATERAL] != 0 and now[RIGID] < 0.0) or (
        more is not None and state[MODE] == STUCK and cone(w, k, state) < 0.0
    ):
        return TRANSIT
    left = state[ROW] * k[H_STEP] - now[TIME]
    if left <= INSTANT:
        state[CERTAIN] = 1
        now[TIME] = state[ROW] * k[H_STEP]
        ask(state, ARRIVING)
        return ASK
    state[PIECE] = 1
    now[LENGTH] = left
    return SET_OUT


@kernel
def transit(H: Array, w: Work, k: Array, state: Whole, rows: Array, events: Array, more: int | None) -> int:
    """Apply the event at this state: an impact, the end of the contact, of slip or of sticking."""
    now = w.now
    if state[EVENTS] >= events.shape[0]:
        state[PHASE] = TRANSITING
        return ENLARGE
    state[IN_STEP] += 1
    if now[TIME] - now[LAST_EVENT] > RUSH:
        state[RUSHED] = 0
    else:
        state[RUSHED] += 1
    now[LAST_EVENT] = now[TIME]
    if state[IN_STEP] > MOST_IN_STEP or (state[RUSHED] > MOST_RUSHED and state[MODE] != FREE):
        state[STATUS] = CHATTER
        return FAIL
    if state[MODE] == FREE:
        state[STATUS] = factorise(H, w.A, w.L, w.X, w.S, k[REACH])
        if state[STATUS] != OK:
            return FAIL
    for i in range(3):
        w.before[i] = w.u[i]
        w.after[i] = w.u[i]
        w.compression[i] = 0.0
        w.decompression[i] = 0.0
    now[CUT], now[GIVEN] = 0.0, 0.0
    if state[MODE] == FREE:
        # A step of first order may bring a tip down that its velocity already takes up again: contact, no impulse.
        state[PHASE], state[KIND] = STRIKING, TOUCHDOWN
        return COLLIDE if w.u[0] < 0.0 else STRIKE
    if state[UNILATERAL] != 0 and now[RIGID] < 0.0:
        state[MODE], state[RISEN], state[KIND] = FREE, 0, LIFTOFF
        w.after[0] = 0.0
        log(w, k, state, events, 0.5 * w.u[0] * w.u[0] / w.S[0, 0])
        # The last act of the closure: the tip leaves from the surface itself, without what the stabiliser owed.
        state[MOVES], state[NEXT] = 0, BEGINNING
        return CLOSE
    if more is not None:
        return turn(w, k, state, rows, events)
    ask(state, BEGINNING)
    return ASK


@kernel
def turn(w: Work, k: Array, state: Whole, rows: Array, events: Array) -> int:
    """Apply the end of sticking, or of slip: it sticks, or goes on in another direction."""
    kind, par = state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH]
    at = state[LAW_STATES] + state[SENSOR_STATES]
    z = w.z[at : at + state[FRICTION_STATES]]
    loss, size = 0.0, np.hypot(w.F[1], w.F[2])
    if state[MODE] == STUCK and not size > 0.0:  # nothing drags it: f is about to end, and it is not negative yet
        ask(state, BEGINNING)
        return ASK
    if state[MODE] == STUCK:  # the force that held the tip is what it now slides against
        state[MODE], state[KIND] = PRESSED, SLIP_AGAIN
        w.direction[0], w.direction[1] = -w.F[1] / size, -w.F[2] / size
        if state[STICKING] == RIGID_STICK:  # slip starts from rest: what errors have left of a velocity goes
            loss = halt(w)
    else:
        speed = np.hypot(w.u[1], w.u[2])
        slow = speed <= max(2.0 * k[STICK_SPEED], capture_speed(kind, par) * (1.0 + 1e-9))
        if state[STICKING] == SPRING_STICK:
            now = w.now
            delayed = delayed_speed(w, k, state, rows, memory_delay(kind, par), speed)
            now[GAUGE] = 0.0
            stick_states(kind, par, delayed, w.direction, z)
            state[MODE], state[KIND] = STUCK, STICK
        else:
            held = OK
            for i in range(3):
                w.b[i] = 0.0
            held = stuck_force(w.S, w.a, w.b, w.F, w.share)
            size = np.hypot(w.F[1], w.F[2])
            if held == OK and slow and size <= stick_limit(kind, par, z) * abs(w.F[0]):
                state[MODE], state[KIND] = STUCK, STICK
                w.anchor[0], w.anchor[1] = w.p[1], w.p[2]
                loss = halt(w)
            elif not slow:  # it has only turned by a right angle since the substep began
                w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
                ask(state, BEGINNING)
                return ASK
            else:
                state[KIND] = REVERSAL
                find_direction(w, k, state, z)
    log(w, k, state, events, loss)
    ask(state, BEGINNING)
    return ASK


@kernel
def halt(w: Work) -> float:
    """Take away what is left of the tip's velocity u, by an impulse as small; return the energy that goes, J."""
    for i in range(3):
        w.a[i], w.b[i] = w.u[i], 0.0
    stuck_force(w.S, w.a, w.b, w.compression, w.share)
    for i in range(3):
        w.after[i] = 0.0
    strike(w.L, w.X, w.compression, w.column, w.v)
    return float(energy_lost(w.before, w.after, w.compression))


@kernel
def find_direction(w: Work, k: Array, state: Whole, z: Array) -> None:
    """Write the direction in which slip starts that friction cannot prevent: that in which the tip then accelerates.

    Friction against a direction changes the acceleration, and the tip's mobility is not the same in all: the direction
    is a root of the angle between the two, found by a scan of the circle and bisection.
    """
    kind, par = state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH]
    at_rest = w.scratch[0:2]
    at_rest[0], at_rest[1] = 0.0, 0.0
    best, here, before = -1.0, 0.0, 0.0
    low = 0.0
    for i in range(DIRECTIONS + 1):
        angle = 2.0 * np.pi * i / DIRECTIONS
        across, along = onset(kind, par, at_rest, z, w, angle)
        if i > 0 and before * across <= 0.0 and along > 0.0:
            a, b, sign = low, angle, before
            for _ in range(60):
                middle = 0.5 * (a + b)
                across_middle, along_middle = onset(kind, par, at_rest, z, w, middle)
                if across_middle * sign > 0.0:
                    a = middle
                else:
                    b = middle
            across_middle, along_middle = onset(kind, par, at_rest, z, w, b)
            if along_middle > best:
                best, here = along_middle, b
        low, before = angle, across
    w.direction[0], w.direction[1] = math.cos(here), math.sin(here)


@kernel
def onset(kind: int, par: Array, at_rest: Array, z: Array, w: Work, angle: float) -> tuple[float, float]:
    """Return the acceleration across and along a direction if slip starts in it, m/s²."""
    w.direction[0], w.direction[1] = math.cos(angle), math.sin(angle)
    sliding(kind, par, at_rest, 0.0, z, w.direction, w.c, w.w)
    pressed_force(w.S, w.a, 0.0, w.c, w.w, w.F)
    a1 = w.a[1] + w.S[1, 0] * w.F[0] + w.S[1, 1] * w.F[1] + w.S[1, 2] * w.F[2]
    a2 = w.a[2] + w.S[2, 0] * w.F[0] + w.S[2, 1] * w.F[1] + w.S[2, 2] * w.F[2]
    d1, d2 = w.direction[0], w.direction[1]
    return float(d1 * a2 - d2 * a1), float(d1 * a1 + d2 * a2)


@kernel
def log(w: Work, k: Array, state: Whole, events: Array, energy: float) -> None:
    """Write the event state[KIND] into the table, and book the energy that it took."""
    write_event(
        events[state[EVENTS]], w.now[TIME], state[KIND], w.now[CUT], w.now[GIVEN], k[FRAME : FRAME + 9], w.r, w.before,
        w.after, w.compression, w.decompression, energy,
    )  # fmt: skip
    state[EVENTS] += 1
    w.now[SUPPLIED] -= energy


@kernel
def strike_tip(w: Work, k: Array, state: Whole, events: Array, more: int | None) -> None:
    """Apply the impulses of an impact to q̇, and go on in the mode that it leaves."""
    n = w.q.shape[0]
    for i in range(3):
        w.F[i] = w.compression[i] + w.decompression[i]
    strike(w.L, w.X, w.F, w.column, w.v)
    log(w, k, state, events, energy_lost(w.before, w.after, w.F))
    state[RISEN] = 1
    if more is not None:
        if state[LAW] != LAW_GIVEN:
            at = law_at(n)
            restart(state[LAW], k[at : at + LAW_WIDTH + 2 * n], w.column, w.z[0 : state[LAW_STATES]])
        at = state[LAW_STATES] + state[SENSOR_STATES]
        if state[FRICTION_STATES] > 0:
            contact_states(w.z[at : at + state[FRICTION_STATES]])
        speed = np.hypot(w.after[1], w.after[2])
        if speed > 0.0:
            w.direction[0], w.direction[1] = w.after[1] / speed, w.after[2] / speed
    if state[KIND] == TOUCHDOWN:
        make_contact(w, k, state, np.hypot(w.after[1], w.after[2]))


@kernel
def make_contact(w: Work, k: Array, state: Whole, speed: float) -> None:
    """Let a tip on the surface slide, or stick where it is if its friction may hold it and it is slow enough, m/s."""
    state[MODE] = PRESSED
    if state[STICKING] in (RIGID_STICK, SPRING_STICK) and speed <= k[STICK_SPEED]:
        state[MODE] = STUCK
        w.anchor[0], w.anchor[1] = w.p[1], w.p[2]


@entry_kernel
def collide(k: Array, state: Whole, memory: Array, n: int) -> None:
    """Find the impulses of the impact at which the machine stands, and whether it ends in contact.

    It is apart from `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    w = workspace(memory, n, extra_states(state, n), state[STAGES], state[SENSOR_RING])
    bounces = state[RUSHED] <= MOST_RUSHED
    state[KIND], w.now[CUT], w.now[GIVEN] = IMPACT if bounces else TOUCHDOWN, 0.0, 0.0
    for _ in range(2):
        restitution = k[RESTITUTION] if state[KIND] == IMPACT else 0.0
        state[STATUS] = impact(
            w.S, w.before, restitution, state[IMPACT_LAW], k[IMPACT_FRICTION], w.scratch,
            w.compression, w.decompression, w.after,
        )  # fmt: skip
        if state[STATUS] != OK or state[KIND] == TOUCHDOWN:
            return
        if w.after[0] >= k[REST_SPEED]:
            cut = int(w.scratch[MODES]) & ENERGY_CUT != 0
            w.now[GIVEN] = -w.after[0] / w.before[0] if cut else restitution
            return
        state[KIND], w.now[CUT] = TOUCHDOWN, w.after[0]
