"""The loop by reverse communication: steps, events, impacts and projections in one kernel.

`proceed` is called with the terms (H, C, Jᵣ, r, J̇ᵣq̇) of the state it requested, does everything that can be done with
them, and returns with the next state to be evaluated in `Work.q` and `Work.v`. The terms come from Pinocchio, called
from Python, or from compiled terms of our own (`closedloop.mechanics.robot.tree`).

The phase says what the terms are for:

    STEP_END        the end of a step (or the start): record the row, unless an event happened in the step
    PART_END        the end of a part of a step that is divided for joints that turn fast: go on with the next
    STAGE           a later stage of a Runge-Kutta step
    TRIAL_END       the end of a trial step, taken to locate an event inside a step
    AT_EVENT        the state at the instant of an event: apply the impact, change the mode
    IMPULSES_KNOWN  (no terms) the impulses of the impact have been computed
    AFTER_EVENT     the state just after an event: continue from there to the end of the step
    PROJECTION      a state to be projected onto the closure
    MEASURED        what encoders read of the state at the end of a step, before STEP_END: ask the law

An event is detected where the event function is negative at the end of a step: the gap while the tip is free, the
distance from the surface's edge while it touches, the force of the rigid closure while it is pressed, the speed along
the old direction while it slides, and the margin to the friction cone while it sticks. It is also detected where f of
the rigid closure is negative at a stage, and where a free tip moves down at the beginning of a step and up at its end.
The step is then repeated with other lengths until the instant is bracketed to `INSTANT`; a step to that instant, the
event, and a step for the remainder replace it. Every substep is a full step of the integrator, so its order is kept.
What begins and ends between two evaluations is not detected: a negative f that no stage samples, and a free tip that
penetrates and rises again in one step after moving up at its beginning.

A state is projected onto the closure at position and velocity level. In the phase QUERY an integrator that evaluates
any state at any instant is told what it wants of one.
"""

from closedloop.base.arrays import Array
from closedloop.jit.dual8 import has_derivatives, sought
from closedloop.jit.kernel import inlined_kernel, kernel
from closedloop.loop.events.contacts import apply_contact_impulses
from closedloop.loop.events.locate import (
    ADVANCE,
    AFTER_EVENT,
    APPLY_EVENT,
    APPLY_IMPACT,
    AT_EVENT,
    BEGIN_SUBSTEP,
    DONE,
    ENLARGE_TABLE,
    FAIL,
    FAILED,
    IMPACT_LAW_WANTED,
    IMPULSES_KNOWN,
    MEASURED,
    NEED_TERMS,
    PART_END,
    PROJECT,
    PROJECTION,
    QUERY,
    RETRY_SUBSTEP,
    SOLVE_IMPACT,
    STAGE,
    STEP_END,
    TABLE_FULL,
    TERMS,
    TRIAL_END,
    event_function,
    note_stage,
    refine_bracket,
    request_terms,
    slip_margin,
)
from closedloop.loop.events.substep import (
    advance_friction,
    begin_anew,
    check_stage,
    check_step,
    end_before_stage,
    finish_stage,
    restore_state,
    save_state,
)
from closedloop.loop.events.transitions import apply_event, apply_impact, resume_after_event
from closedloop.loop.step.advance import advance, advance_decaying, advance_on_manifold, keep_decays, move
from closedloop.loop.step.closed_loops import CLOSE, factorise_tip
from closedloop.loop.step.contacts import CLOSE_GAPS, CLOSE_RATES, NO_FORCES, WATCH
from closedloop.loop.step.energy_supplied import add_stage_work, commit_work, power
from closedloop.loop.step.entries import lead_motors
from closedloop.loop.step.evaluate import evaluate, evaluate_law
from closedloop.loop.step.joint_friction import stick_or_slip_joints
from closedloop.loop.step.locate import back_to_true, locate_tip, off_anchor, read_joints
from closedloop.loop.step.memory import (
    RIGID_STICK,
    Constants,
    State,
    Work,
    ask_contacts,
    ask_loops,
    is_semi_implicit,
    takes_one_stage,
)
from closedloop.loop.step.record_row import record
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK, answer_impulse, apply_impulse, stuck_force
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.memory import OFF, ContactLinks, Contacts, contacts_at
from closedloop.mechanics.limits import CLOSED, OUTPACED, REFINEMENTS

# A projection after an event moves no joint further than this share of the largest gap, rad/m: levers of a centimetre.
FARTHEST = 100.0
# `State.projection.moves` once the derivatives of a state of dual numbers (`closedloop.jit.dual8`) have been projected.
MOVED_ALONG = 1000


@kernel
def project(H: Array, w: Work, constants: Constants, state: State) -> int:
    """Project the state onto the closure: q by −H⁻¹Aᵀ(A H⁻¹Aᵀ)⁻¹e until e is rounding, then q̇ likewise by ė.

    Of all corrections that close the loop these are the smallest in the norm of H, as a contact impulse's is. They do
    not contribute to the force of Eq. 24.
    """
    state.status = factorise_tip(H, w, constants, state)
    if state.status != OK:
        return FAIL
    if state.coupled != 0:
        return project_contacts(w, constants, state)
    stuck = state.mode == STUCK and state.friction.sticking == RIGID_STICK
    for level in range(2):
        w.tip.a[0] = w.tip.gap if level == 0 else w.tip.u[0]
        size = abs(w.tip.a[0])
        for i in range(1, 3):
            w.tip.a[i] = 0.0
            if stuck:
                w.tip.a[i] = off_anchor(w, state, i) if level == 0 else w.tip.u[i]
                size = max(size, abs(w.tip.a[i]))
        if level == 0 and (size <= CLOSED or state.projection.moves >= REFINEMENTS):
            if not has_derivatives(size) or state.projection.moves >= MOVED_ALONG:
                continue
            state.projection.moves = MOVED_ALONG  # the value stays: the derivatives are moved onto the closure
            for i in range(3):
                w.tip.a[i] -= sought(w.tip.a[i])
        if stuck:
            for i in range(3):
                w.tip.b[i] = 0.0
            state.status = stuck_force(w.tip.S, w.tip.a, w.tip.b, w.tip.F, w.tip.stabiliser_force)
            if state.status != OK:
                return FAIL
        else:
            w.tip.F[0] = -w.tip.a[0] / w.tip.S[0, 0] if w.tip.S[0, 0] > 0.0 else 0.0
            w.tip.F[1], w.tip.F[2] = 0.0, 0.0
        if level == 0:
            if state.settings.balls == 0:
                apply_impulse(w.L, w.tip.X, w.tip.F, w.scratch.column, w.q)
            else:
                answer_impulse(w.L, w.tip.X, w.tip.F, w.scratch.column)
                move(w, constants)
            state.projection.moves += 1
            request_terms(state, PROJECTION)
            return NEED_TERMS
        apply_impulse(w.L, w.tip.X, w.tip.F, w.scratch.column, w.v)
    request_terms(state, state.projection.next_phase)
    return NEED_TERMS


@kernel
def project_contacts(w: Work, constants: Constants, state: State) -> int:
    """Do `project` for all contacts that are closed, where they are solved together."""
    links, c = contacts_at(state.contacts.at)
    state.status = ask_contacts(state, CLOSE_GAPS)
    if state.status != OK:
        return FAIL
    after_event = state.projection.next_phase == AFTER_EVENT  # whose velocities obey the modes already
    if after_event and too_far(links, c, w):
        links.moved = 0
    if links.moved != 0 and state.projection.moves < REFINEMENTS:
        move(w, constants)
        state.projection.moves += 1
        request_terms(state, PROJECTION)
        return NEED_TERMS
    if not after_event:
        state.status = ask_contacts(state, CLOSE_RATES)
        if state.status != OK:
            return FAIL
        for j in range(w.v.shape[0]):
            w.v[j] += w.scratch.column[j]
    request_terms(state, state.projection.next_phase)
    return NEED_TERMS


@kernel
def too_far(links: ContactLinks, c: Contacts, w: Work) -> bool:
    """Whether the move in `column` is far beside the gaps that it closes, as of rows that nearly depend on others."""
    gap, far = 0.0, 0.0
    for i in range(links.points + links.stops):
        if c.problem.form[i] != OFF:
            gap = max(gap, abs(c.located[3 * i]))
    for j in range(links.n):
        far = max(far, abs(w.scratch.column[j]))
    return bool(far > FARTHEST * gap)


@kernel
def put_back(w: Work, constants: Constants, state: State) -> None:
    """Move q by what a step in time puts back of what is deep, see `closedloop.mechanics.contacts.stepping`."""
    _, c = contacts_at(state.contacts.at)
    if c.step.shifts == 0.0:
        return
    for j in range(w.q.shape[0]):
        w.scratch.column[j] = c.step.shift[j]
    move(w, constants)


# What a state is evaluated for: its derivative, to begin a step from it, to see how far an event is, to record it.
DERIVE, BEGIN_STEP, EVENT_VALUE, RECORD = range(4)


@kernel
def answer_query(
    H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, rows: Array
) -> int:  # fmt: skip
    """Write what `State.query` wants of the state that was evaluated, and return TERMS, or FAILED with `State.status`.

    The event function is in w.search.value, the row in `rows`; see `closedloop.loop.events.proceed` for the arguments.
    """
    alone = state.coupled == 0
    if alone and state.query != DERIVE:
        state.status = ask_contacts(state, WATCH)
        if state.status != OK:
            return FAILED
    if state.query == DERIVE:
        w.supply.power = power(w, state)
    elif state.query == BEGIN_STEP:
        save_state(w, constants, state)
    elif state.query == EVENT_VALUE:
        w.search.value = event_function(w, constants, state)
        if state.friction.sticking == RIGID_STICK and state.mode == PRESSED and alone:
            begun, band = w.start.slip_speed, constants.capture_speed
            if begun > constants.stick_speed and not begun > band > 0.0:  # see `Memory.apply_event`
                w.search.value = min(w.search.value, 1e3 * (slip_margin(w, constants) - constants.stick_speed))
    else:
        record(H, C, w, constants, state, table, rows, state.row)
    return TERMS


@inlined_kernel
def proceed(
    H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, tableau: Array, rows: Array,
    events: Array,
) -> int:  # fmt: skip
    """Use the terms of the state requested last, and request the next.

    Returns TERMS: evaluate the terms at (q, q̇) and call again. TABLE_FULL: give a larger table of events and call
    again. IMPACT_LAW_WANTED: call `collide`, then again. DONE, or FAILED with state.status.

    `H`, `C`, (n, n), (n,) arrays: terms at (q, q̇) in `w`; Jᵣ, r and J̇ᵣq̇ are in `w`.
    `w`, `constants`, `state`: see `closedloop.loop.step.memory`.
    `table` (P, 2 n + 14): the reference at the instants of the stages, see `closedloop.loop.step.entries`.
    `tableau` (S + 1, S): see `closedloop.mechanics.integrators.Scheme.tableau`.
    `rows` (N, width): the record, see `closedloop.loop.step.record_row.Row`; row state.row is the next to be written.
    `events` (M, EVENT_WIDTH): the table of events, of which state.event.rows rows are written.
    """
    phase = state.phase
    if state.settings.general != 0 and phase == MEASURED:
        status = evaluate_law(H, C, w, constants, state, table)
        if status != OK:
            state.status = status
            return FAILED
        back_to_true(w)
        state.phase = STEP_END
        return TERMS
    # The gap of a tip that is free is all that a trial step is for, unless there is more to watch.
    free = state.mode == FREE and state.coupled == 0
    state.begins = 1 if phase in (STEP_END, PART_END, AFTER_EVENT) else 0
    if phase in (STEP_END, PART_END, STAGE, AFTER_EVENT, QUERY) or (phase in (TRIAL_END, AT_EVENT) and not free):
        status = evaluate(H, C, w, constants, state, table, rows)
        if status != OK:
            state.status = status
            return FAILED
        if phase == QUERY:
            return answer_query(H, C, w, constants, state, table, rows)
    elif phase != IMPULSES_KNOWN:
        status = locate_tip(w, constants, state)
        if status != OK:
            state.status = status
            return FAILED
    if state.coupled == 0 and phase in (STEP_END, PART_END, TRIAL_END, AT_EVENT, AFTER_EVENT):
        state.status = ask_contacts(state, WATCH)
        if state.status != OK:
            return FAILED
    todo = NEED_TERMS
    if phase in (STEP_END, PART_END):
        w.search.value = event_function(w, constants, state)
        todo = check_step(w, w.tip.drift_c[0], state)
        if todo == BEGIN_SUBSTEP:
            todo = begin_anew(w, state, todo)
        if todo == BEGIN_SUBSTEP and phase == PART_END:
            commit_work(w)
            w.length = state.row * constants.h - w.time
        elif todo == BEGIN_SUBSTEP:
            commit_work(w)
            if state.row == 0:
                w.supply.energy = 0.0  # row 0 is the state after the events of t = 0, and the balance begins with it
            stick_or_slip_joints(w, constants, state, rows)
            record(H, C, w, constants, state, table, rows, state.row)
            if state.row == state.settings.steps:
                return DONE
            state.row += 1
            state.event.in_step, state.after_event = max(state.event.in_step - OUTPACED, 0), 0
            state.event.instants = 0
            w.length = constants.h
        if todo == RETRY_SUBSTEP and state.settings.hold > 0 and state.sampled != 0:
            for j in range(w.torque.shape[0]):
                w.torque[j] = w.drives.held[j]  # until the end of the step the torque of the last sample acted
    elif phase == STAGE:
        if has_derivatives(w.time) and state.trial.settling != 0:
            note_stage(w, constants, state)
        if state.coupled != 0 and w.contacts.margin > NO_FORCES:
            w.search.least = min(w.search.least, w.contacts.margin)
        todo = check_stage(w, state) if state.settings.unilateral != 0 else ADVANCE
        if state.coupled != 0 and w.contacts.margin <= NO_FORCES:
            todo = end_before_stage(w, state)
        elif todo == ADVANCE:
            todo = begin_anew(w, state, todo)
    elif phase == TRIAL_END:
        w.search.value = event_function(w, constants, state)
        todo = refine_bracket(w, state)
    elif phase == AT_EVENT:
        todo = APPLY_EVENT
    elif phase == IMPULSES_KNOWN:
        todo = APPLY_IMPACT
    elif phase == PROJECTION:
        todo = PROJECT
    else:
        todo = resume_after_event(C, w, constants, state, events)

    if todo == APPLY_EVENT:
        commit_work(w)
        todo = apply_event(H, w, constants, state, rows, events)
    if todo == APPLY_IMPACT:
        if state.status != OK:
            return FAILED
        if state.coupled != 0:
            todo = apply_contact_impulses(w, state, events)
        else:
            apply_impact(w, constants, state, events)
            todo = NEED_TERMS
            if state.settings.project != 0 and state.mode != FREE:
                state.projection.moves, state.projection.next_phase = 0, AFTER_EVENT
                request_terms(state, PROJECTION)
            else:
                request_terms(state, AFTER_EVENT)
    if todo == PROJECT:
        todo = project(H, w, constants, state)
    if todo == BEGIN_SUBSTEP:
        state.status = save_state(w, constants, state)
        if state.status != OK:
            return FAILED
        todo = ADVANCE
    elif todo == RETRY_SUBSTEP:
        restore_state(w, state)
        todo = ADVANCE
    if todo == ADVANCE:
        stage, tau = state.stage, w.search.tau
        semi_implicit, substep = is_semi_implicit(state), state.after_event != 0 and state.event.stepping == 0
        add_stage_work(w, state, stage, tau, 1.0 if takes_one_stage(state) else tableau[tableau.shape[0] - 1, stage])
        if state.settings.general != 0 and semi_implicit:
            advance_friction(w, state, tau)
            if state.settings.elastic != 0:
                lead_motors(w, tau, substep)
        if not semi_implicit:
            keep_decays(stage, w)
        if state.settings.balls == 0:
            advance(stage, tau, semi_implicit, substep, tableau, w)
        else:
            advance_on_manifold(stage, tau, semi_implicit, substep, tableau, w, constants)
        if state.event.stepping != 0:
            put_back(w, constants, state)
        if not semi_implicit:
            advance_decaying(stage, tau, tableau, w)
        finish_stage(w, constants.h, state, tableau)
        # at every stage: rows that depend on others do so only where the loops are closed
        state.status = ask_loops(state, CLOSE)
        if state.status != OK:
            return FAILED
    elif todo == ENLARGE_TABLE:
        return TABLE_FULL
    elif todo == SOLVE_IMPACT:
        return IMPACT_LAW_WANTED
    elif todo == FAIL:
        return FAILED
    if state.settings.encoder != 0 and state.phase == STEP_END:
        read_joints(w, constants, state, table)
        state.phase = MEASURED
    return TERMS
