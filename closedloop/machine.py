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
closure while it is pressed. The step is then taken again, shorter, until the instant is bracketed to `INSTANT`; a
step to that instant, the event, and a step for the remainder replace it. Every piece is a full step of the
integrator, so its order is kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import entry_kernel, kernel
from closedloop.contact import FREE, PRESSED, STUCK, factorise, strike, stuck_force
from closedloop.events import IMPACT, LIFTOFF, TOUCHDOWN, write_event
from closedloop.impact import energy_lost, impact
from closedloop.integrate import advance
from closedloop.solve import CHATTER, OK
from closedloop.step import LAW_GIVEN, evaluate, locate_tip, record
from closedloop.tip import tip_kinematics
from closedloop.workspace import (
    AT_HIGH,
    AT_LOW,
    BEGIN,
    CERTAIN,
    CROSSING,
    CUT,
    EVENTS,
    EXTRA,
    FRAME,
    GAP,
    GAUGE,
    GRAVITY,
    H_STEP,
    HIGH,
    HOLD,
    IMPACT_FRICTION,
    IMPACT_LAW,
    IN_STEP,
    JOINTS,
    KIND,
    LAST_EVENT,
    LAW,
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
    RISEN,
    ROW,
    RUSHED,
    SAMPLED,
    SEMI_IMPLICIT,
    STAGE,
    STAGES,
    START_GAP,
    START_GAUGE,
    START_RATE,
    STATUS,
    STEPS,
    TAU,
    TIME,
    TIP,
    TRIAL,
    TRIES,
    UNILATERAL,
    Whole,
    Work,
    workspace,
)

Array = NDArray[np.float64]

# What `proceed` returns.
DONE, TERMS, TERMS_AND_LAW, ROOM, IMPACT_LAW_WANTED, FAILED = range(6)

# Phases.
ARRIVING, STAGING, PROBING, TRANSITING, STRIKING, BEGINNING, CLOSING = range(7)

# What a trial step is for.
NO_TRIAL, SEARCH_EVENT, SEARCH_LOWEST, TAKE_EVENT = range(4)

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
# e = n·r − d is a sum of a few products of numbers of a metre: 4 ε each way. Newton's method is quadratic, and from the
# nanometres or micrometres that a step leaves it is there after one move; five are for a start a millimetre off.
CLOSED, MOST_MOVES = 2e-15, 5


@kernel
def proceed(
    H: Array, C: Array, w: Work, k: Array, state: Whole, table: Array, tableau: Array, rows: Array, events: Array
) -> int:  # fmt: skip
    """Use the terms of the state that was asked for, and ask for the next.

    Parameters
    ----------
    H, C : (n, n), (n,) arrays
        Terms at (q, q̇) in `w`; Jᵣ, r and J̇ᵣq̇ are in `w`.
    w, k, state
        See `closedloop.workspace`.
    table : (P, 2 n + 10) array
        What is desired at the instants of the stages, see `closedloop.step.reference_row`.
    tableau : (S + 1, S) array
        See `closedloop.integrate.Integrator.tableau`.
    rows : (N, width) array
        The record, see `closedloop.step.Row`; row state[ROW] is the next to be written.
    events : (M, EVENT_WIDTH) array
        The table of events, of which state[EVENTS] rows are written.

    Returns
    -------
    int
        TERMS: evaluate the terms at (q, q̇) and call again. TERMS_AND_LAW: and write the torque for now[TIME]. ROOM:
        give a larger table of events and call again, nothing has changed. IMPACT_LAW_WANTED: call `collide`, and again. DONE, or FAILED with state[STATUS].
    """
    phase = state[PHASE]
    if phase == ARRIVING:
        status = evaluate(H, C, w, k, state, table)
        if status != OK:
            return _fail(state, status)
        if state[UNILATERAL] != 0:
            state[TRIAL] = _what_happened(w, state)
            if state[TRIAL] == TAKE_EVENT:  # here and now
                return _transit(H, w, k, state, events, tableau)
            if state[TRIAL] != NO_TRIAL:
                return _search(w, k, state, tableau)
        i = state[ROW]
        record(H, C, w, k, state, rows[i])
        if i == state[STEPS]:
            return DONE
        state[ROW] = i + 1
        state[IN_STEP], state[PIECE] = 0, 0
        return _set_out(w, k, state, tableau, k[H_STEP])
    if phase == STAGING:
        status = evaluate(H, C, w, k, state, table)
        if status != OK:
            return _fail(state, status)
        return _leave_stage(w, k, state, tableau)
    if phase == CLOSING:
        return _close(H, w, k, state)
    if phase == PROBING:
        if state[MODE] == FREE:
            locate_tip(w, k)
            w.now[GAUGE] = w.now[GAP]
        else:
            status = evaluate(H, C, w, k, state, table)
            if status != OK:
                return _fail(state, status)
            w.now[GAUGE] = w.now[RIGID]
        return _narrow(w, k, state, tableau)
    if phase == TRANSITING:
        return _transit(H, w, k, state, events, tableau)
    if phase == STRIKING:
        if state[STATUS] != OK:
            return FAILED
        return _strike(w, k, state, events)
    # just after an event
    status = evaluate(H, C, w, k, state, table)
    if status != OK:
        return _fail(state, status)
    if state[MODE] == FREE:
        # A tip that the surface has just let go, and that would fall back at once: the law pushes when free and pulls
        # when pressed. It stays.
        if w.now[GAP] <= TOUCHING and abs(w.now[RATE]) <= RESTING and w.a[0] < 0.0:
            return _change(w, state, PRESSED)
    elif w.now[RIGID] < 0.0:
        state[CROSSING] = LIFTOFF
        return _transit(H, w, k, state, events, tableau)
    left = state[ROW] * k[H_STEP] - w.now[TIME]
    if left <= INSTANT:
        state[CERTAIN] = 1
        w.now[TIME] = state[ROW] * k[H_STEP]
        return _ask(w, state, ARRIVING)
    state[PIECE] = 1
    return _set_out(w, k, state, tableau, left)


@kernel
def _fail(state: Whole, status: int) -> int:
    state[STATUS] = status
    return FAILED


@kernel
def _ask(w: Work, state: Whole, phase: int) -> int:
    """Say what the next terms are for, and whether the law is to be evaluated with them."""
    state[PHASE] = phase
    if phase in (CLOSING, TRANSITING):
        return TERMS
    hold = state[HOLD]
    sampled = 1
    if hold > 0:
        sampled = 1 if phase == ARRIVING and state[ROW] % hold == 0 else 0
        if sampled == 1:
            for j in range(w.torque.shape[0]):
                w.held[j] = w.torque[j]
    state[SAMPLED] = sampled
    return TERMS_AND_LAW if state[LAW] == LAW_GIVEN and sampled == 1 else TERMS


@kernel
def _set_out(w: Work, k: Array, state: Whole, tableau: Array, length: float) -> int:
    """Remember the state and its derivative, and take a step of this length, s, from it."""
    n, extra = w.q.shape[0], w.z.shape[0]
    for j in range(n):
        w.begin[j] = w.q[j]
        w.begin[n + j] = w.v[j]
        w.slope[j] = w.qdd[j]
    for j in range(extra):
        w.begin[2 * n + j] = w.z[j]
        w.slope[n + j] = w.dz[j]
    w.now[BEGIN], w.now[LENGTH], w.now[TAU] = w.now[TIME], length, length
    w.now[START_GAP], w.now[START_RATE] = w.now[GAP], w.now[RATE]
    w.now[START_GAUGE] = w.now[GAP] if state[MODE] == FREE else w.now[RIGID]
    state[TRIAL], state[STAGE], state[CERTAIN] = NO_TRIAL, 0, 0
    return _leave_stage(w, k, state, tableau)


@kernel
def _set_out_again(w: Work, k: Array, state: Whole, tableau: Array, tau: float) -> int:
    """Take a step of another length, s, from the remembered state."""
    n, extra = w.q.shape[0], w.z.shape[0]
    for j in range(n):
        w.q[j] = w.begin[j]
        w.v[j] = w.begin[n + j]
        w.qdd[j] = w.slope[j]
    for j in range(extra):
        w.z[j] = w.begin[2 * n + j]
        w.dz[j] = w.slope[n + j]
    w.now[TAU] = tau
    state[STAGE] = 0
    return _leave_stage(w, k, state, tableau)


@kernel
def _leave_stage(w: Work, k: Array, state: Whole, tableau: Array) -> int:
    """Advance from a stage whose derivatives are known, and ask for the terms of what comes next."""
    stage, tau = state[STAGE], w.now[TAU]
    advance(
        stage, tau, state[SEMI_IMPLICIT] != 0, state[PIECE] != 0, tableau, w.begin, w.stages, w.qdd, w.dz, w.q, w.v, w.z
    )
    if stage + 1 < state[STAGES]:
        state[STAGE] = stage + 1
        node = 0.0
        for i in range(stage + 1):
            node += tableau[stage + 1, i]
        w.now[TIME] = w.now[BEGIN] + node * tau
        return _ask(w, state, STAGING)
    if state[TRIAL] == TAKE_EVENT:
        w.now[TIME] = w.now[BEGIN] + tau
        return _ask(w, state, TRANSITING)
    if state[TRIAL] != NO_TRIAL:
        w.now[TIME] = w.now[BEGIN] + tau
        return _ask(w, state, PROBING)
    w.now[TIME] = state[ROW] * k[H_STEP]
    if state[PROJECT] != 0 and state[MODE] != FREE:
        state[MOVES], state[NEXT] = 0, ARRIVING
        return _ask(w, state, CLOSING)
    return _ask(w, state, ARRIVING)


@kernel
def _what_happened(w: Work, state: Whole) -> int:
    """Say what a step that has just arrived calls for: NO_TRIAL, a search, or TAKE_EVENT here and now."""
    first = state[ROW] == 0
    if state[MODE] != FREE:
        state[CROSSING] = LIFTOFF
        if not w.now[RIGID] < 0.0:
            return NO_TRIAL
        return TAKE_EVENT if first or state[CERTAIN] != 0 else SEARCH_EVENT
    state[CROSSING] = IMPACT
    if first or state[CERTAIN] != 0:
        return TAKE_EVENT if w.now[GAP] <= TOUCHING and w.now[RATE] < -RESTING else NO_TRIAL
    leaving = LEAVING + w.now[LENGTH] * w.now[LENGTH] * abs(w.drift_c[0])
    if w.now[GAP] < -(SHALLOW if state[RISEN] != 0 else leaving):
        return SEARCH_EVENT
    if w.now[GAP] > leaving:
        state[RISEN] = 1
    if state[RISEN] != 0 and w.now[START_RATE] < -RESTING and w.now[RATE] > 0.0:  # down and up again: how low was it?
        return SEARCH_LOWEST
    return NO_TRIAL


@kernel
def _search(w: Work, k: Array, state: Whole, tableau: Array) -> int:
    """Begin to look for an event between the beginning and the end of the substep."""
    if state[HOLD] > 0 and state[SAMPLED] != 0:  # until the end of the step the torque of the last sample acted
        for j in range(w.torque.shape[0]):
            w.torque[j] = w.held[j]
    state[TRIES] = 0
    w.now[LOW], w.now[HIGH] = 0.0, w.now[LENGTH]
    if state[TRIAL] == SEARCH_LOWEST:
        w.now[AT_LOW], w.now[AT_HIGH] = -w.now[START_RATE], -w.now[RATE]
    else:
        w.now[AT_LOW] = max(w.now[START_GAUGE], 0.0)
        w.now[AT_HIGH] = w.now[GAP] if state[MODE] == FREE else w.now[RIGID]
    return _probe(w, k, state, tableau)


@kernel
def _probe(w: Work, k: Array, state: Whole, tableau: Array) -> int:
    """Choose the next instant between LOW and HIGH: by the secant, and every third time halfway."""
    low, high = w.now[LOW], w.now[HIGH]
    a, b = w.now[AT_LOW], w.now[AT_HIGH]
    tau = 0.5 * (low + high)
    if state[TRIES] % 3 != 2 and a > 0.0 > b and a > 1e-6 * -b:
        tau = low + (high - low) * (a / (a - b))
        tau = min(max(tau, low + 0.4 * INSTANT), high - 0.4 * INSTANT)
    state[TRIES] += 1
    return _set_out_again(w, k, state, tableau, tau)


@kernel
def _narrow(w: Work, k: Array, state: Whole, tableau: Array) -> int:
    """Use the gauge at the end of a trial step to shrink the bracket, until the instant of the event is known."""
    tau = w.now[TAU]
    value = w.now[GAUGE]
    if state[TRIAL] == SEARCH_LOWEST:
        if w.now[GAP] < -SHALLOW:  # it went through: look for the crossing before
            state[TRIAL] = SEARCH_EVENT
            w.now[LOW], w.now[AT_LOW] = 0.0, max(w.now[START_GAP], 0.0)
        else:
            value = -w.now[RATE]
    # The end that stays twice has its value halved, so that the secant moves towards it (Illinois).
    if value > 0.0 or (value == 0.0 and state[MODE] == FREE):
        w.now[LOW], w.now[AT_LOW] = tau, value
        w.now[AT_HIGH] *= 0.5 if state[TRIES] > 1 else 1.0
    else:
        w.now[HIGH], w.now[AT_HIGH] = tau, value
        w.now[AT_LOW] *= 0.5 if state[TRIES] > 1 else 1.0
    if w.now[HIGH] - w.now[LOW] > max(INSTANT, 4e-16 * w.now[TIME]):
        return _probe(w, k, state, tableau)
    if state[TRIAL] == SEARCH_LOWEST or w.now[HIGH] == w.now[LENGTH]:
        # It only came near, or it happens at the row itself: the step stands as it was.
        state[TRIAL], state[CERTAIN] = NO_TRIAL, 1
        return _set_out_again(w, k, state, tableau, w.now[LENGTH])
    # A tip that comes down is taken before it is inside, a force that fades after it is gone.
    state[TRIAL] = TAKE_EVENT
    return _set_out_again(w, k, state, tableau, w.now[LOW] if state[MODE] == FREE else w.now[HIGH])


@kernel
def _transit(H: Array, w: Work, k: Array, state: Whole, events: Array, tableau: Array) -> int:
    """Apply the event at this state: an impact or the end of the contact."""
    if state[EVENTS] >= events.shape[0]:
        state[PHASE] = TRANSITING
        return ROOM
    state[IN_STEP] += 1
    if state[IN_STEP] > MOST_IN_STEP:
        return _fail(state, CHATTER)
    locate_tip(w, k)
    status = factorise(H, w.A, w.L, w.X, w.S)
    if status != OK:
        return _fail(state, status)
    for i in range(3):
        w.before[i] = w.u[i]
        w.after[i] = w.u[i]
        w.compression[i] = 0.0
        w.decompression[i] = 0.0
    t = w.now[TIME]
    if t - w.now[LAST_EVENT] > RUSH or state[EVENTS] == 0:
        state[RUSHED] = 0
    else:
        state[RUSHED] += 1
    w.now[LAST_EVENT] = t
    if state[CROSSING] == LIFTOFF:
        if state[RUSHED] > MOST_RUSHED:
            return _fail(state, CHATTER)
        state[MODE], state[RISEN] = FREE, 0
        w.after[0] = 0.0
        loss = 0.5 * w.u[0] * w.u[0] / w.S[0, 0] if w.S[0, 0] > 0.0 else 0.0
        write_event(
            events[state[EVENTS]], t, LIFTOFF, 0.0, k[FRAME : FRAME + 9], w.r, w.before, w.after,
            w.compression, w.decompression, loss,
        )  # fmt: skip
        state[EVENTS] += 1
        # The last act of the closure: the tip leaves from the surface itself, without what the stabiliser owed.
        state[MOVES], state[NEXT] = 0, BEGINNING
        return _close(H, w, k, state)
    # A step of first order may bring a tip down that its velocity already takes up again: contact, without an impulse.
    state[PHASE], state[KIND], w.now[CUT] = STRIKING, TOUCHDOWN, 0.0
    return IMPACT_LAW_WANTED if w.u[0] < 0.0 else _strike(w, k, state, events)


@kernel
def _strike(w: Work, k: Array, state: Whole, events: Array) -> int:
    """Apply the impulses of an impact to q̇, and go on in the mode that it leaves."""
    for i in range(3):
        w.F[i] = w.compression[i] + w.decompression[i]
    loss = energy_lost(w.before, w.after, w.F)
    strike(w.L, w.X, w.F, w.column, w.v)
    write_event(
        events[state[EVENTS]], w.now[TIME], state[KIND], w.now[CUT], k[FRAME : FRAME + 9], w.r, w.before, w.after,
        w.compression, w.decompression, loss,
    )  # fmt: skip
    state[EVENTS] += 1
    state[RISEN] = 1
    if state[KIND] == TOUCHDOWN:
        state[MODE] = PRESSED
    return _ask(w, state, BEGINNING)


@kernel
def _change(w: Work, state: Whole, mode: int) -> int:
    """Change the mode without an event, and look at the same state again."""
    state[MODE] = mode
    state[IN_STEP] += 1
    if state[IN_STEP] > MOST_IN_STEP or state[RUSHED] > MOST_RUSHED:
        return _fail(state, CHATTER)
    return _ask(w, state, BEGINNING)


@kernel
def _close(H: Array, w: Work, k: Array, state: Whole) -> int:
    """Move the state towards the closure: q by −H⁻¹Aᵀ(A H⁻¹Aᵀ)⁻¹e until e is rounding, then q̇ likewise by its rate.

    Of all moves that close the loop these are the smallest in the norm of the mass matrix: what a contact impulse would
    do. The force of Eq. 24 carries no share of it.
    """
    locate_tip(w, k)
    status = factorise(H, w.A, w.L, w.X, w.S)
    if status != OK:
        return _fail(state, status)
    stuck = state[MODE] == STUCK
    off = w.now[GAP]
    for level in range(2):
        w.a[0] = off if level == 0 else w.u[0]
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
            status = stuck_force(w.S, w.a, w.b, w.F, w.share)
            if status != OK:
                return _fail(state, status)
        else:
            w.F[0] = -w.a[0] / w.S[0, 0] if w.S[0, 0] > 0.0 else 0.0
            w.F[1], w.F[2] = 0.0, 0.0
        if level == 0:
            strike(w.L, w.X, w.F, w.column, w.q)
            state[MOVES] += 1
            return _ask(w, state, CLOSING)
        strike(w.L, w.X, w.F, w.column, w.v)
    return _ask(w, state, state[NEXT])


@entry_kernel
def collide(k: Array, state: Whole, memory: Array, n: int) -> None:
    """Find the impulses of the impact at which the machine stands, and whether it ends in contact.

    It is apart from `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    w = workspace(memory, n, state[EXTRA], state[STAGES])
    bounces = state[RUSHED] <= MOST_RUSHED
    state[KIND], w.now[CUT] = (IMPACT, 0.0) if bounces else (TOUCHDOWN, 0.0)
    for _ in range(2):
        restitution = k[RESTITUTION] if state[KIND] == IMPACT else 0.0
        state[STATUS] = impact(
            w.S, w.before, restitution, state[IMPACT_LAW], k[IMPACT_FRICTION], w.scratch,
            w.compression, w.decompression, w.after,
        )  # fmt: skip
        if state[STATUS] != OK or state[KIND] == TOUCHDOWN or w.after[0] >= k[REST_SPEED]:
            return
        state[KIND], w.now[CUT] = TOUCHDOWN, w.after[0]


@entry_kernel
def proceed_on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array, events: Array,
) -> int:  # fmt: skip
    """Do `proceed` on what `pinocchio.crba` and `pinocchio.nonLinearEffects` left in their data.

    See `proceed`, and `closedloop.tip.tip_kinematics` for the parameters that only this function has.
    """
    n = C.shape[0]
    w = workspace(memory, n, state[EXTRA], state[STAGES])
    tip_kinematics(
        joint_jacobian, rotation, origin, velocity, acceleration,
        k[TIP : TIP + 3], k[GRAVITY : GRAVITY + 3], k[JOINTS : JOINTS + n], w.J, w.r, w.drift,
    )  # fmt: skip
    return proceed(H, C, w, k, state, table, tableau, rows, events)
