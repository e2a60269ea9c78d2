"""Projection of a state onto the closure, at position and velocity level."""

from closedloop.base.arrays import Array
from closedloop.jit.dual8 import has_derivatives, sought
from closedloop.jit.kernel import kernel
from closedloop.loop.events.phases import AFTER_EVENT, FAIL, NEED_TERMS, PROJECTION, request_terms
from closedloop.loop.step.advance import move
from closedloop.loop.step.closed_loops import factorise_tip
from closedloop.loop.step.contacts import CLOSE_GAPS, CLOSE_RATES
from closedloop.loop.step.locate import off_anchor
from closedloop.loop.step.memory import RIGID_STICK, Constants, State, Work, ask_contacts
from closedloop.mechanics.closure.contact_force import STUCK, answer_impulse, apply_impulse, stuck_force
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.memory import OFF, ContactLinks, Contacts, contacts_at
from closedloop.mechanics.limits import CLOSED, REFINEMENTS

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
    n = w.q.shape[0]
    links, c = contacts_at(state.contacts.at)
    state.status = ask_contacts(state, CLOSE_GAPS)
    if state.status != OK:
        return FAIL
    after_event = state.projection.next_phase == AFTER_EVENT  # whose velocities obey the modes already
    if after_event and too_far(links, c, w):
        links.moved = 0
    if links.moved != 0 and state.projection.moves < REFINEMENTS:
        if state.settings.balls == 0:
            for j in range(n):
                w.q[j] += w.scratch.column[j]
        else:
            move(w, constants)
        state.projection.moves += 1
        request_terms(state, PROJECTION)
        return NEED_TERMS
    if not after_event:
        state.status = ask_contacts(state, CLOSE_RATES)
        if state.status != OK:
            return FAIL
        for j in range(n):
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
