"""The loop as a machine that asks for what it needs: steps, events, impacts and projections in one place.

`proceed` is called with the terms (H, C, Jᵣ, r, J̇ᵣq̇) of the state it asked for, does everything that can be done with
them, and returns with the next state to be evaluated in `Work.q` and `Work.v`. Who evaluates it is not its business:
Pinocchio, called from Python, or terms of our own, compiled. This way of turning a loop inside out is known as reverse
communication.

The phase says what the terms that have just arrived are for:

    ARRIVE    the end of a step (or the start): record the row, or find that something happened on the way
    STAGE     a later stage of a Runge-Kutta step
    PROBE_END the end of a trial step, taken to locate an event inside a step
    TRANSIT   the state at the instant of an event: apply the impact, change the mode
    STRIKE    (no terms) the impulses of the impact are known
    BEGIN     the state just after an event: go on from there to the end of the step
    CLOSE     a state to be put back on the closure (projection)

An event shows when a step arrives and its gauge is negative: the gap while the tip is free, the force of the rigid
closure while it is pressed, the speed along the old direction while it slides, and what is left of the friction cone
while it sticks. The step is then taken again, shorter, until the instant is bracketed to `INSTANT`; a
step to that instant, the event, and a step for the remainder replace it. Every piece is a full step of the
integrator, so its order is kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.addresses import address_of, fortran_at, matrix_at, vector_at, whole_at
from closedloop.compiled import brief_entry, entry_kernel, inlined_kernel, kernel, kernel_inlined
from closedloop.contact import FREE, PRESSED, STUCK, factorise, pressed_force, strike, stuck_force
from closedloop.control.laws import restart
from closedloop.events import EVENT_WIDTH, IMPACT, LIFTOFF, REVERSAL, SLIP_AGAIN, STICK, TOUCHDOWN, write_event
from closedloop.friction.laws import (
    advance_states,
    capture_speed,
    contact_states,
    memory_delay,
    sliding,
    stick_limit,
    stick_states,
)
from closedloop.impact import energy_lost, impact
from closedloop.integrate import advance
from closedloop.joint_friction import advance_joint_friction, stick_or_slip_joints
from closedloop.solve import CHATTER, OK
from closedloop.step import LAW_GIVEN, delayed_speed, evaluate, locate_tip, record
from closedloop.tip import tip_kinematics
from closedloop.workspace import (
    AT_HIGH,
    AT_LOW,
    BEGIN,
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
    GRAVITY,
    H_STEP,
    HIGH,
    HOLD,
    IMPACT_FRICTION,
    IMPACT_LAW,
    IN_STEP,
    JOINT_STATES,
    JOINTS,
    KIND,
    LAST_EVENT,
    LAW,
    LAW_STATES,
    LAW_WIDTH,
    LENGTH,
    LOW,
    MODE,
    MOVES,
    NEXT,
    PHASE,
    PIECE,
    PROJECT,
    RATE,
    REST_SPEED,
    RESTITUTION,
    RIGID,
    RIGID_STICK,
    RISEN,
    ROW,
    RUSHED,
    SAMPLED,
    SEMI_IMPLICIT,
    SENSOR_RING,
    SENSOR_STATES,
    SMOOTH,
    SPRING_STICK,
    STAGE,
    STAGES,
    START_GAP,
    START_GAUGE,
    START_RATE,
    START_SLIP,
    STATUS,
    STEPS,
    STICK_SPEED,
    STICKING,
    TAU,
    TIME,
    TIP,
    TRIAL,
    TRIES,
    UNILATERAL,
    WHOLES,
    Whole,
    Work,
    law_at,
    workspace,
)

Array = NDArray[np.float64]

# What `proceed` returns.
DONE, TERMS, TERMS_AND_LAW, ROOM, IMPACT_LAW_WANTED, FAILED = range(6)

# Phases.
ARRIVING, STAGING, PROBING, TRANSITING, STRIKING, BEGINNING, CLOSING = range(7)

# What a trial step is for.
NO_TRIAL, SEARCH_EVENT, SEARCH_LOWEST, TAKE_EVENT = range(4)

# What is to be done next inside `proceed`: ask (the terms of w.q, w.v are wanted), or one of these.
ASK, LEAVE, SET_OUT, SET_OUT_AGAIN, TRANSIT, STRIKE, CLOSE, FINISH, FAIL, ENLARGE, COLLIDE = range(11)

# An event is located to this, s; nearer than that to a row it happens at the row.
INSTANT = 1e-14
# Nearer than this the tip is on the surface, m: the rounding of n·r − d is a few 1e-16, of a located touch 1e-14.
TOUCHING = 1e-12
# A gap this little below zero is rounding, not yet a touch, m. A tip that the surface has let go rises with the cube of
# time at first, no faster than an integrator's error grows. Until it is farther off than a stabiliser holds it on, and
# than a step of first order misses the curve of its way by, h² nᵀJ̇ᵣq̇, a gap within that is none.
SHALLOW, LEAVING = 1e-13, 1e-9
# A rate this small is the rounding of a velocity that was set to zero, m/s.
RESTING = 1e-11
# Bounces that follow each other faster than `RUSH`, s, for this many times are an end of bouncing, whatever the speed;
# and so many changes of mode in one step are no motion any more.
RUSH, MOST_RUSHED = 1e-12, 20
MOST_IN_STEP = 100_000
# Directions of the circle at which the onset of slip is tried before it is bracketed.
DIRECTIONS = 36
# e = n·r − d is a sum of a few products of numbers of a metre: 4 ε each way. Newton's method is quadratic, and from the
# nanometres or micrometres that a step leaves it is there after one move; five are for a start a millimetre off.
CLOSED, MOST_MOVES = 2e-15, 5


@inlined_kernel
def proceed(
    H: Array, C: Array, w: Work, k: Array, state: Whole, table: Array, tableau: Array, rows: Array, events: Array,
    more: int | None,
) -> int:  # fmt: skip
    """Use the terms of the state that was asked for, and ask for the next.

    Parameters
    ----------
    H, C : (n, n), (n,) arrays
        Terms at (q, q̇) in `w`; Jᵣ, r and J̇ᵣq̇ are in `w`.
    w, k, state
        See `closedloop.workspace`.
    table : (P, 2 n + 11) array
        What is desired at the instants of the stages, see `closedloop.step.reference_row`.
    tableau : (S + 1, S) array
        See `closedloop.integrate.Integrator.tableau`.
    rows : (N, width) array
        The record, see `closedloop.step.Row`; row state[ROW] is the next to be written.
    events : (M, EVENT_WIDTH) array
        The table of events, of which state[EVENTS] rows are written.
    more : int or None
        See `closedloop.step`.

    Returns
    -------
    int
        TERMS: evaluate the terms at (q, q̇) and call again. TERMS_AND_LAW: and write the torque for now[TIME]. ROOM:
        give a larger table of events and call again. IMPACT_LAW_WANTED: call `collide`, then again. DONE, or FAILED
        with state[STATUS].
    """
    now, phase = w.now, state[PHASE]
    if phase in (ARRIVING, STAGING, BEGINNING) or (phase in (PROBING, TRANSITING) and state[MODE] != FREE):
        status = evaluate(H, C, w, k, state, table, rows, more)
        if status != OK:
            state[STATUS] = status
            return FAILED
    elif phase != STRIKING:
        locate_tip(w, k)
    todo = ASK
    if phase == ARRIVING:
        now[GAUGE] = gauge(w, k, state, more)
        todo = _arrive(now, w.drift_c[0], state)
        if todo == SET_OUT:
            if more is not None:
                stick_or_slip_joints(w, k, state, rows)
            record(H, C, w, k, state, table, rows, more)
            if state[ROW] == state[STEPS]:
                return DONE
            state[ROW] += 1
            state[IN_STEP], state[PIECE] = 0, 0
            now[LENGTH] = k[H_STEP]
        elif todo == SET_OUT_AGAIN and state[HOLD] > 0 and state[SAMPLED] != 0:
            for j in range(w.torque.shape[0]):
                w.torque[j] = w.held[j]  # until the end of the step the torque of the last sample acted
    elif phase == STAGING:
        todo = LEAVE
    elif phase == PROBING:
        now[GAUGE] = gauge(w, k, state, more)
        todo = _narrow(now, state)
    elif phase == TRANSITING:
        todo = TRANSIT
    elif phase == STRIKING:
        todo = STRIKE
    elif phase == CLOSING:
        todo = CLOSE
    else:
        todo = _begin(w, k, state, more)

    if todo == TRANSIT:
        todo = _transit(H, w, k, state, rows, events, more)
    if todo == STRIKE:
        if state[STATUS] != OK:
            return FAILED
        _strike(w, k, state, events, more)
        todo = ASK
        if state[PROJECT] != 0 and state[MODE] != FREE:
            state[MOVES], state[NEXT] = 0, BEGINNING
            _ask(state, CLOSING)
        else:
            _ask(state, BEGINNING)
    if todo == CLOSE:
        todo = _close(H, w, k, state)
    if todo == SET_OUT:
        remember(w, k, state, more)
        todo = LEAVE
    elif todo == SET_OUT_AGAIN:
        _restore(w, state)
        todo = LEAVE
    if todo == LEAVE:
        stage, tau = state[STAGE], now[TAU]
        if more is not None and state[SEMI_IMPLICIT] != 0:
            _advance_friction(w, k, state, tau)
        advance(
            stage, tau, state[SEMI_IMPLICIT] != 0, state[PIECE] != 0, tableau, w.begin, w.stages,
            w.qdd, w.dz, w.q, w.v, w.z,
        )  # fmt: skip
        _leave_stage(now, k[H_STEP], state, tableau)
    elif todo == ENLARGE:
        return ROOM
    elif todo == COLLIDE:
        return IMPACT_LAW_WANTED
    elif todo == FAIL:
        return FAILED
    return TERMS_AND_LAW if state[LAW] == LAW_GIVEN and state[SAMPLED] != 0 else TERMS


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
    slow = k[STICK_SPEED]
    if w.now[START_SLIP] <= slow:  # slip has only begun, and its velocity is still of the size of rounding
        return float(along + slow)
    return float(along - (band if w.now[START_SLIP] > band else 0.0))


@kernel_inlined
def _ask(state: Whole, phase: int) -> None:
    """Say what the next terms are for, and whether the law is to be evaluated with them."""
    state[PHASE] = phase
    if phase == CLOSING:
        state[SAMPLED] = 0
    elif state[HOLD] > 0:
        state[SAMPLED] = 1 if phase == ARRIVING and state[ROW] % state[HOLD] == 0 else 0
    else:
        state[SAMPLED] = 0 if phase == TRANSITING and state[LAW] == LAW_GIVEN else 1


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
        if state[MODE] == PRESSED and speed > k[STICK_SPEED]:
            w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
    now[START_GAUGE] = gauge(w, k, state, more)


@kernel_inlined
def _restore(w: Work, state: Whole) -> None:
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
def _advance_friction(w: Work, k: Array, state: Whole, h: float) -> None:
    """Advance the states of friction by h at the velocity of the substep's beginning, exactly."""
    at = state[LAW_STATES] + state[SENSOR_STATES]
    if state[MODE] != FREE and state[FRICTION_STATES] > 0:
        advance_states(
            state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH], w.slip, state[MODE] == STUCK, h,
            w.z[at : at + state[FRICTION_STATES]],
        )  # fmt: skip
    advance_joint_friction(w, k, state, h)


@kernel_inlined
def _leave_stage(now: Array, h: float, state: Whole, tableau: Array) -> None:
    """Ask for the terms of the state that a stage has led to: the next stage's, or those of the substep's end."""
    stage, tau = state[STAGE], now[TAU]
    if stage + 1 < state[STAGES]:
        state[STAGE] = stage + 1
        node = 0.0
        for i in range(stage + 1):
            node += tableau[stage + 1, i]
        now[TIME] = now[BEGIN] + node * tau
        _ask(state, STAGING)
    elif state[TRIAL] != NO_TRIAL:
        now[TIME] = now[BEGIN] + tau
        _ask(state, TRANSITING if state[TRIAL] == TAKE_EVENT else PROBING)
    else:
        now[TIME] = state[ROW] * h
        if state[PROJECT] != 0 and state[MODE] != FREE:
            state[MOVES], state[NEXT] = 0, ARRIVING
            _ask(state, CLOSING)
        else:
            _ask(state, ARRIVING)


@kernel_inlined
def _arrive(now: Array, drift: float, state: Whole) -> int:
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
    _aim(now, state)
    return SET_OUT_AGAIN


@kernel
def _aim(now: Array, state: Whole) -> None:
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
def _narrow(now: Array, state: Whole) -> int:
    """Use the gauge at the end of a trial step to shrink the bracket, until the instant of the event is known."""
    tau, value = now[TAU], now[GAUGE]
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
        _aim(now, state)
    elif state[TRIAL] == SEARCH_LOWEST or now[HIGH] == now[LENGTH]:
        # It only came near, or it happens at the row itself: the step stands as it was.
        state[TRIAL], state[CERTAIN] = NO_TRIAL, 1
        now[TAU] = now[LENGTH]
    else:
        # A tip that comes down is taken before it is inside, what else ends after it has ended.
        state[TRIAL] = TAKE_EVENT
        now[TAU] = now[LOW] if state[MODE] == FREE else now[HIGH]
    return SET_OUT_AGAIN


@kernel
def _begin(w: Work, k: Array, state: Whole, more: int | None) -> int:
    """Look at the state just after an event, and set out from it for the end of the step, unless its mode cannot be."""
    now = w.now
    if state[MODE] == FREE:
        # A tip that the surface has just let go, and that would fall back at once: the law pushes when free and pulls
        # when pressed. It stays.
        if now[GAP] <= TOUCHING and abs(now[RATE]) <= RESTING and w.a[0] < 0.0:
            state[MODE] = PRESSED
            state[IN_STEP] += 1
            if state[IN_STEP] > MOST_IN_STEP or state[RUSHED] > MOST_RUSHED:
                state[STATUS] = CHATTER
                return FAIL
            _ask(state, BEGINNING)
            return ASK
    elif (state[UNILATERAL] != 0 and now[RIGID] < 0.0) or (
        more is not None and state[MODE] == STUCK and cone(w, k, state) < 0.0
    ):
        return TRANSIT
    left = state[ROW] * k[H_STEP] - now[TIME]
    if left <= INSTANT:
        state[CERTAIN] = 1
        now[TIME] = state[ROW] * k[H_STEP]
        _ask(state, ARRIVING)
        return ASK
    state[PIECE] = 1
    now[LENGTH] = left
    return SET_OUT


@kernel
def _transit(H: Array, w: Work, k: Array, state: Whole, rows: Array, events: Array, more: int | None) -> int:
    """Apply the event at this state: an impact, the end of the contact, of slip or of sticking."""
    now = w.now
    if state[EVENTS] >= events.shape[0]:
        state[PHASE] = TRANSITING
        return ENLARGE
    state[IN_STEP] += 1
    if now[TIME] - now[LAST_EVENT] > RUSH or state[EVENTS] == 0:
        state[RUSHED] = 0
    else:
        state[RUSHED] += 1
    now[LAST_EVENT] = now[TIME]
    if state[IN_STEP] > MOST_IN_STEP or (state[RUSHED] > MOST_RUSHED and state[MODE] != FREE):
        state[STATUS] = CHATTER
        return FAIL
    if state[MODE] == FREE:
        state[STATUS] = factorise(H, w.A, w.L, w.X, w.S)
        if state[STATUS] != OK:
            return FAIL
    for i in range(3):
        w.before[i] = w.u[i]
        w.after[i] = w.u[i]
        w.compression[i] = 0.0
        w.decompression[i] = 0.0
    now[CUT] = 0.0
    if state[MODE] == FREE:
        # A step of first order may bring a tip down that its velocity already takes up again: contact, no impulse.
        state[PHASE], state[KIND] = STRIKING, TOUCHDOWN
        return COLLIDE if w.u[0] < 0.0 else STRIKE
    if state[UNILATERAL] != 0 and now[RIGID] < 0.0:
        state[MODE], state[RISEN], state[KIND] = FREE, 0, LIFTOFF
        w.after[0] = 0.0
        _log(w, k, state, events, 0.5 * w.u[0] * w.u[0] / w.S[0, 0])
        # The last act of the closure: the tip leaves from the surface itself, without what the stabiliser owed.
        state[MOVES], state[NEXT] = 0, BEGINNING
        return CLOSE
    if more is not None:
        return _turn(w, k, state, rows, events)
    _ask(state, BEGINNING)
    return ASK


@kernel
def _turn(w: Work, k: Array, state: Whole, rows: Array, events: Array) -> int:
    """Apply the end of sticking, or of slip: it sticks, or goes on in another direction."""
    kind, par = state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH]
    at = state[LAW_STATES] + state[SENSOR_STATES]
    z = w.z[at : at + state[FRICTION_STATES]]
    loss, size = 0.0, np.hypot(w.F[1], w.F[2])
    if state[MODE] == STUCK:  # the force that held the tip is what it now slides against
        state[MODE], state[KIND] = PRESSED, SLIP_AGAIN
        w.direction[0], w.direction[1] = -w.F[1] / size, -w.F[2] / size
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
                # What is left of the velocity within the plane goes, by an impulse as small.
                for i in range(3):
                    w.a[i] = w.u[i]
                stuck_force(w.S, w.a, w.b, w.compression, w.share)
                for i in range(3):
                    w.after[i] = 0.0
                strike(w.L, w.X, w.compression, w.column, w.v)
                loss = energy_lost(w.before, w.after, w.compression)
            elif not slow:  # it has only turned by a right angle since the substep began
                w.direction[0], w.direction[1] = w.u[1] / speed, w.u[2] / speed
                _ask(state, BEGINNING)
                return ASK
            else:
                state[KIND] = REVERSAL
                _find_direction(w, k, state, z)
    _log(w, k, state, events, loss)
    _ask(state, BEGINNING)
    return ASK


@kernel
def _find_direction(w: Work, k: Array, state: Whole, z: Array) -> None:
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
        across, along = _onset(kind, par, at_rest, z, w, angle)
        if i > 0 and before * across <= 0.0 and along > 0.0:
            a, b, sign = low, angle, before
            for _ in range(60):
                middle = 0.5 * (a + b)
                across_middle, along_middle = _onset(kind, par, at_rest, z, w, middle)
                if across_middle * sign > 0.0:
                    a = middle
                else:
                    b = middle
            across_middle, along_middle = _onset(kind, par, at_rest, z, w, b)
            if along_middle > best:
                best, here = along_middle, b
        low, before = angle, across
    w.direction[0], w.direction[1] = np.cos(here), np.sin(here)


@kernel
def _onset(kind: int, par: Array, at_rest: Array, z: Array, w: Work, angle: float) -> tuple[float, float]:
    """Return the acceleration across and along a direction if slip starts in it, m/s²."""
    w.direction[0], w.direction[1] = np.cos(angle), np.sin(angle)
    sliding(kind, par, at_rest, 0.0, z, w.direction, w.c, w.w)
    pressed_force(w.S, w.a, 0.0, w.c, w.w, w.F)
    a1 = w.a[1] + w.S[1, 0] * w.F[0] + w.S[1, 1] * w.F[1] + w.S[1, 2] * w.F[2]
    a2 = w.a[2] + w.S[2, 0] * w.F[0] + w.S[2, 1] * w.F[1] + w.S[2, 2] * w.F[2]
    d1, d2 = w.direction[0], w.direction[1]
    return float(d1 * a2 - d2 * a1), float(d1 * a1 + d2 * a2)


@kernel
def _log(w: Work, k: Array, state: Whole, events: Array, energy: float) -> None:
    """Write the event state[KIND] into the table."""
    write_event(
        events[state[EVENTS]], w.now[TIME], state[KIND], w.now[CUT], k[FRAME : FRAME + 9], w.r, w.before, w.after,
        w.compression, w.decompression, energy,
    )  # fmt: skip
    state[EVENTS] += 1


@kernel
def _strike(w: Work, k: Array, state: Whole, events: Array, more: int | None) -> None:
    """Apply the impulses of an impact to q̇, and go on in the mode that it leaves."""
    n = w.q.shape[0]
    for i in range(3):
        w.F[i] = w.compression[i] + w.decompression[i]
    strike(w.L, w.X, w.F, w.column, w.v)
    _log(w, k, state, events, energy_lost(w.before, w.after, w.F))
    state[RISEN] = 1
    if state[KIND] == TOUCHDOWN:
        state[MODE] = PRESSED
    if more is not None:
        if state[LAW] != LAW_GIVEN:
            at = law_at(n)
            restart(state[LAW], k[at : at + LAW_WIDTH + 2 * n], w.column, w.z[0 : state[LAW_STATES]])
        at = state[LAW_STATES] + state[SENSOR_STATES]
        if state[FRICTION_STATES] > 0:
            contact_states(w.z[at : at + state[FRICTION_STATES]])
        speed = np.hypot(w.after[1], w.after[2])
        if state[KIND] == TOUCHDOWN and speed <= k[STICK_SPEED] and state[STICKING] in (RIGID_STICK, SPRING_STICK):
            state[MODE] = STUCK
            w.anchor[0], w.anchor[1] = w.p[1], w.p[2]
        elif speed > 0.0:
            w.direction[0], w.direction[1] = w.after[1] / speed, w.after[2] / speed


@kernel
def _close(H: Array, w: Work, k: Array, state: Whole) -> int:
    """Move the state towards the closure: q by −H⁻¹Aᵀ(A H⁻¹Aᵀ)⁻¹e until e is rounding, then q̇ likewise by its rate.

    Of all moves that close the loop these are the smallest in the norm of the mass matrix: what a contact impulse would
    do. The force of Eq. 24 carries no share of it.
    """
    state[STATUS] = factorise(H, w.A, w.L, w.X, w.S)
    if state[STATUS] != OK:
        return FAIL
    stuck = state[MODE] == STUCK and state[STICKING] == RIGID_STICK
    for level in range(2):
        w.a[0] = w.now[GAP] if level == 0 else w.u[0]
        size = abs(w.a[0])
        for i in range(1, 3):
            w.a[i] = 0.0
            if stuck:
                w.a[i] = w.p[i] - w.anchor[i - 1] if level == 0 else w.u[i]
                size = max(size, abs(w.a[i]))
        if level == 0 and (size <= CLOSED or state[MOVES] >= MOST_MOVES):
            continue
        if stuck:
            for i in range(3):
                w.b[i] = 0.0
            state[STATUS] = stuck_force(w.S, w.a, w.b, w.F, w.share)
            if state[STATUS] != OK:
                return FAIL
        else:
            w.F[0] = -w.a[0] / w.S[0, 0] if w.S[0, 0] > 0.0 else 0.0
            w.F[1], w.F[2] = 0.0, 0.0
        if level == 0:
            strike(w.L, w.X, w.F, w.column, w.q)
            state[MOVES] += 1
            _ask(state, CLOSING)
            return ASK
        strike(w.L, w.X, w.F, w.column, w.v)
    _ask(state, state[NEXT])
    return ASK


@entry_kernel
def collide(k: Array, state: Whole, memory: Array, n: int) -> None:
    """Find the impulses of the impact at which the machine stands, and whether it ends in contact.

    It is apart from `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    w = workspace(memory, n, extra_states(state, n), state[STAGES], state[SENSOR_RING])
    bounces = state[RUSHED] <= MOST_RUSHED
    state[KIND], w.now[CUT] = IMPACT if bounces else TOUCHDOWN, 0.0
    for _ in range(2):
        restitution = k[RESTITUTION] if state[KIND] == IMPACT else 0.0
        state[STATUS] = impact(
            w.S, w.before, restitution, state[IMPACT_LAW], k[IMPACT_FRICTION], w.scratch,
            w.compression, w.decompression, w.after,
        )  # fmt: skip
        if state[STATUS] != OK or state[KIND] == TOUCHDOWN or w.after[0] >= k[REST_SPEED]:
            return
        state[KIND], w.now[CUT] = TOUCHDOWN, w.after[0]


@kernel
def extra_states(state: Whole, n: int) -> int:
    """Return how many numbers of state there are beside q and q̇."""
    count = state[LAW_STATES] + state[SENSOR_STATES] + state[FRICTION_STATES] + n * state[JOINT_STATES]
    return int(count)


# What `proceed_on_pinocchio` is told, by place in one block of whole numbers: the addresses of all arrays, and sizes.
(
    AT_H, AT_C, AT_JACOBIAN, AT_ROTATION, AT_ORIGIN, AT_VELOCITY, AT_ACCELERATION,
    AT_K, AT_STATE, AT_MEMORY, AT_TABLE, AT_TABLEAU, AT_ROWS, AT_EVENTS,
    SIZE_N, SIZE_K, SIZE_MEMORY, INSTANTS, WANTED_WIDTH, ROWS, ROW_WIDTH, EVENT_ROOM,
) = range(22)  # fmt: skip
PLACES = 22


def places_of(
    views: tuple[Array, ...], k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array,
) -> Whole:  # fmt: skip
    """Write down where the arrays of a run are: for `proceed_on_pinocchio`, as long as they all are kept.

    Parameters
    ----------
    views : tuple of 7 arrays
        See `closedloop.robot.Robot.views` and `closedloop.tip.tip_kinematics`.
    k, state, memory, table, tableau, rows, events
        See `proceed`. When `events` is replaced, so must be its address and its length, EVENT_ROOM.
    """
    H, jacobian, rotation = views[0], views[2], views[3]
    arrays = (*views, k, state, memory, table, tableau, rows, events)
    for array in arrays:
        columns_first = array is H or array is jacobian or array is rotation  # as Eigen has them
        assert array.flags.f_contiguous if columns_first else array.flags.c_contiguous
    sizes = (H.shape[0], k.size, memory.size, *table.shape, *rows.shape, events.shape[0])
    return np.array([*(address_of(x) for x in arrays), *sizes], dtype=np.int64)


@inlined_kernel
def on_pinocchio(n: int, places: int, more: int | None) -> int:
    """Do `proceed_on_pinocchio` for n joints."""
    a = whole_at(places, PLACES)
    k, state = vector_at(a[AT_K], a[SIZE_K]), whole_at(a[AT_STATE], WHOLES)
    memory = vector_at(a[AT_MEMORY], a[SIZE_MEMORY])
    w = workspace(memory, n, extra_states(state, n), state[STAGES], state[SENSOR_RING])
    tip_kinematics(
        fortran_at(a[AT_JACOBIAN], 6, n), fortran_at(a[AT_ROTATION], 3, 3), vector_at(a[AT_ORIGIN], 3),
        vector_at(a[AT_VELOCITY], 6), vector_at(a[AT_ACCELERATION], 6),
        k[TIP : TIP + 3], k[GRAVITY : GRAVITY + 3], k[JOINTS : JOINTS + n], w.J, w.r, w.drift,
    )  # fmt: skip
    return proceed(
        fortran_at(a[AT_H], n, n), vector_at(a[AT_C], n), w, k, state,
        matrix_at(a[AT_TABLE], a[INSTANTS], a[WANTED_WIDTH]),
        matrix_at(a[AT_TABLEAU], state[STAGES] + 1, state[STAGES]),
        matrix_at(a[AT_ROWS], a[ROWS], a[ROW_WIDTH]), matrix_at(a[AT_EVENTS], a[EVENT_ROOM], EVENT_WIDTH), more,
    )  # fmt: skip


@brief_entry
def proceed_on_pinocchio(places: int) -> int:
    """Do `proceed` on what `pinocchio.crba` and `pinocchio.nonLinearEffects` left in their data.

    Parameters
    ----------
    places : int
        Address of what `places_of` returned.
    """
    return on_pinocchio(whole_at(places, PLACES)[SIZE_N], places, None)


@brief_entry
def proceed_with_more_on_pinocchio(places: int) -> int:
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return on_pinocchio(whole_at(places, PLACES)[SIZE_N], places, 1)
