"""Events of the contacts of the links: at one instant several may come together, part, slip or stick.

The stops of joints are contacts, too. While all but the tip's are open the tip is solved by itself (`State.coupled` is
0), and what is here begins once one of them closes. First contacts that come together strike each other; then, with
the terms of the state after that, the modes of all contacts are found (`closedloop.mechanics.contacts`). Each contact
to which something happened has its own row in the table.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.loop.events.locate import (
    AFTER_EVENT,
    APPLY_EVENT,
    AT_EVENT,
    ENLARGE_TABLE,
    FAIL,
    IMPULSES_KNOWN,
    NEED_TERMS,
    PROJECTION,
    SOLVE_IMPACT,
    request_terms,
)
from closedloop.loop.events.substep import count_event, resume_step, too_many_events
from closedloop.loop.events.table import EDGE, LIFTOFF, RELEASE, STOP, EventRow
from closedloop.loop.step.closed_loops import impulse_of_frames
from closedloop.loop.step.contact_rows import resolution
from closedloop.loop.step.contacts import DECIDE, IMPULSE, PLACE
from closedloop.loop.step.entries import RESTART
from closedloop.loop.step.evaluate import call_law
from closedloop.loop.step.memory import Constants, State, Work, ask_contacts
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.memory import ContactLinks, Contacts, contacts_at
from closedloop.mechanics.contacts.modes import open_margin, touches
from closedloop.mechanics.contacts.rolling import leave_seats
from closedloop.mechanics.contacts.soft import stored_in
from closedloop.mechanics.limits import HOVERING, ITERATIONS, OFF_SURFACE, STICK_SPEED, STILL, TOUCHING


@kernel
def apply_contact_event(w: Work, constants: Constants, state: State, events: Array) -> int:
    """Apply the impulses of the contacts that come together, if any do; the modes follow with the terms after them."""
    links, c = contacts_at(state.contacts.at)
    if state.event.rows + 3 * links.k > events.shape[0]:
        state.phase = AT_EVENT
        return ENLARGE_TABLE
    if state.event.stepping != 0:
        end_stepping(links, c, state)
        return NEED_TERMS
    if state.coupled == 0:
        if pass_beside(links, c):
            join_tip(w, c, state)
        request_terms(state, AT_EVENT if state.coupled != 0 else AFTER_EVENT)
        return NEED_TERMS
    if links.shapes != 0 and leave_seats(links, c, resolution(constants, state)):
        request_terms(state, AT_EVENT)
        return NEED_TERMS
    count_event(w, state)
    if c.step.follows != 0.0 and state.event.rapid == 0 and links.chattering < 2:
        state.event.instants -= 1  # a step of impulses ends there, which was taken since there are no modes
    leave_edges(w, links, c, state, events)
    state.event.kind = 0
    links.stepped, links.chattering = 0, 1 if state.event.rapid > ITERATIONS else 0
    if too_many_events(state, 2 * ITERATIONS):
        state.status, links.chattering = OK, 2
    ask_contacts(state, PLACE)
    if state.striking >= 0:
        state.event.instants = 0  # it may bounce as often as it will
        i = 3 * state.striking
        for j in range(3):
            w.impact.before[j] = c.u[i + j]
        state.phase = IMPULSES_KNOWN
        return SOLVE_IMPACT
    return apply_contact_impulses(w, state, events)


@kernel
def end_stepping(links: ContactLinks, c: Contacts, state: State) -> None:
    """Let modes be sought again, with the terms that are asked for, where none has changed for many steps."""
    state.event.stepping, links.undecided, c.step.reach = 0, 1, HOVERING
    for i in range(links.points + links.stops):
        gap, own = c.located[3 * i], c.gaps.cleared[i] != 0.0
        c.past_edge[i] = 1.0 if gap < 0.0 and not own else 0.0
        c.gaps.cleared[i], c.gaps.floor[i] = 1.0 if gap > HOVERING else 0.0, min(gap, 0.0)
        if c.mode[i] == STUCK:  # where, is to be found
            c.mode[i] = PRESSED
    state.past_edge = int(c.past_edge[0])
    request_terms(state, AT_EVENT)


@kernel
def pass_beside(links: ContactLinks, c: Contacts) -> bool:
    """Let open contacts of links that come to their surface's level beyond its edge pass; whether others close."""
    closes = False
    for i in range(1, links.points + links.stops):
        if open_margin(c, i) <= TOUCHING:
            c.past_edge[i] = 1.0 if c.inside[i] < 0.0 else 0.0
            closes = closes or c.past_edge[i] == 0.0
    return closes


@kernel
def leave_edges(w: Work, links: ContactLinks, c: Contacts, state: State, events: Array) -> None:
    """End the contacts that have come to the edge of their surface, let open ones beyond it pass, and others back.

    The velocity stays what it is. What the spring of a soft contact has stored is not the robot's.
    """
    told = False
    c.event.energy_lost = c.event.energy_rested = 0.0
    for i in range(3 * links.k):
        c.F[i], c.before[i], c.problem.after[i] = 0.0, c.u[i], c.u[i]
    for i in range(links.k):
        c.event.happened[i], c.event.struck[i] = 0.0, 0.0
        if c.past_edge[i] != 0.0 and i < links.points and open_margin(c, i) <= TOUCHING:
            c.past_edge[i] = 0.0
        if i >= links.points or c.inside[i] >= 0.0 or not touches(links, c, i):
            continue
        c.past_edge[i], c.friction.pulls[i] = 1.0, 0.0
        if c.mode[i] != FREE:
            c.mode[i], c.event.happened[i], c.gaps.cleared[i], told = FREE, EDGE, 0.0, True
            c.event.energy_lost += stored_in(links, c, i) if c.soft[i] != 0.0 else 0.0
    if told:
        ask_contacts(state, PLACE)
        log_contacts(w, links, c, state, events)
        w.supply.energy += c.event.energy_lost
    state.mode, state.past_edge = int(c.mode[0]), int(c.past_edge[0])


@kernel
def apply_contact_impulses(w: Work, state: State, events: Array) -> int:
    """Apply the impulses of contacts that strike, one alone by the law of restitution, or several together."""
    links, c = contacts_at(state.contacts.at)
    state.status = ask_contacts(state, IMPULSE)
    if state.status != OK:
        return FAIL
    return follow_impulses(w, links, c, state, events)


@kernel
def follow_impulses(w: Work, links: ContactLinks, c: Contacts, state: State, events: Array) -> int:
    """Write what an impact was, tell the law of it, and ask for the terms with which the modes after it are found."""
    log_contacts(w, links, c, state, events)
    for i in range(links.k):
        if c.event.struck[i] != 0.0:
            call_law(state, RESTART)
            break
    links.undecided = 1
    request_terms(state, AFTER_EVENT)
    return NEED_TERMS


@kernel
def resume_with_contacts(w: Work, constants: Constants, state: State, events: Array) -> int:
    """Find the modes after an event; once they are found, continue to the end of the step."""
    links, c = contacts_at(state.contacts.at)
    if links.undecided != 0:
        state.status = ask_contacts(state, DECIDE)
        if state.status != OK:
            return FAIL
        if c.step.at_once != 0.0:
            c.step.at_once, state.striking = 0.0, -1
            return follow_impulses(w, links, c, state, events)
        log_contacts(w, links, c, state, events)
        if modes_come_again(links, c, state):
            state.event.rapid += ITERATIONS
        started, links.undecided, links.fresh = links.fresh == 0, 0, 0
        state.mode = int(c.mode[0])
        w.friction.direction[0], w.friction.direction[1] = c.direction[0, 0], c.direction[0, 1]
        if state.event.stepping == 0 and open_but_tip(links, c):
            leave_tip(w, links, c, state)
        elif state.event.stepping == 0 and started and off_surfaces(links, c):
            state.projection.moves, state.projection.next_phase = 0, AFTER_EVENT
            request_terms(state, PROJECTION)
            return NEED_TERMS
        request_terms(state, AFTER_EVENT)
        return NEED_TERMS
    if state.event.stepping == 0 and (w.contacts.margin < 0.0 or stopped_by_others(links, c)):
        return APPLY_EVENT
    return resume_step(w, constants, state)


# Modes of all contacts are one number below this prime, 2³¹ − 1.
MOST_MODES = 2147483647


@kernel
def modes_come_again(links: ContactLinks, c: Contacts, state: State) -> bool:
    """Whether modes that do not last have been found at this instant before, one or two searches ago; note them."""
    modes = 1
    for i in range(links.joints):
        modes = (31 * modes + int(c.mode[i])) % MOST_MODES
        if c.event.struck[i] != 0.0:
            modes, state.event.modes = 0, 0
            break
    again = state.event.rapid > 0 and modes != 0 and modes in (state.event.modes, state.event.modes_before)
    state.event.modes_before, state.event.modes = state.event.modes, modes
    return bool(again)


@kernel
def off_surfaces(links: ContactLinks, c: Contacts) -> bool:
    """Whether a rigid contact is off its surface, or has parted from below it, by more than rounding: it is put there.

    A time step presses it in, and what parts and comes back within a nanometre comes back below. Where shapes
    other than points touch nothing is moved: the point that touches would be another.
    """
    least = 0.0
    for i in range(links.points + links.stops if links.shapes == 0 else 0):
        off, open_now = c.located[3 * i], c.mode[i] == FREE
        if open_now and c.past_edge[i] != 0.0:
            continue  # beside its surface, and below its level
        if c.soft[i] == 0.0 and (c.gaps.floor[i] < -OFF_SURFACE if open_now else abs(off) > OFF_SURFACE):
            least = -1.0
    return bool(least < 0.0)


@kernel
def stopped_by_others(links: ContactLinks, c: Contacts) -> bool:
    """Whether a contact that slid at the event is at rest after it, by what stopped others: its mode ends."""
    for i in range(links.k):
        ends = stops_slipping(c, i) and c.friction.shared[i] == 0.0
        slid = c.mode[i] == PRESSED and ends and c.friction.start_slip[i] > STICK_SPEED
        if slid and math.hypot(c.u[3 * i + 1], c.u[3 * i + 2]) <= STILL:
            return True
    return False


@kernel
def open_but_tip(links: ContactLinks, c: Contacts) -> bool:
    """Whether the contacts of links are all open, and no joint is at a stop: the tip is then solved by itself."""
    closed = 0
    for i in range(1, links.points + links.stops):
        closed += 1 if c.mode[i] != FREE else 0
    return closed == 0


@kernel
def join_tip(w: Work, c: Contacts, state: State) -> None:
    """Let the tip, as it is, take part where all contacts are solved together."""
    state.coupled = 1
    c.mode[0], c.gaps.cleared[0], c.friction.start_slip[0] = state.mode, state.cleared, w.start.slip_speed
    c.gaps.floor[0], c.event.turned[0] = min(w.tip.gap, 0.0), 0.0
    c.direction[0, 0], c.direction[0, 1] = w.friction.direction[0], w.friction.direction[1]


@kernel
def leave_tip(w: Work, links: ContactLinks, c: Contacts, state: State) -> None:
    """Let the tip, as it is, be solved by itself: all other contacts are open."""
    state.coupled, state.event.kind, state.cleared, links.stepped = 0, 0, int(c.gaps.cleared[0]), 0
    w.contacts.power, w.contacts.power_rate = 0.0, 0.0
    w.friction.direction[0], w.friction.direction[1] = c.direction[0, 0], c.direction[0, 1]
    for j in range(links.n):
        w.contacts.torque[j] = 0.0
    for i in range(3 * links.k):
        c.F[i] = 0.0


@kernel
def log_contacts(w: Work, links: ContactLinks, c: Contacts, state: State, events: Array) -> None:
    """Write a row for each contact to which something happened; the first of them has the energy lost by all."""
    lost, rested, first_stop = c.event.energy_lost, c.event.energy_rested, links.points
    w.supply.energy -= lost
    for i in range(3):  # a surface that moves does work on the arm
        w.supply.energy += c.F[i] * w.tip.carried[i]
    for i in range(3, 3 * links.k):
        w.supply.energy += c.F[i] * c.carried[i]
    if state.loops.frames != 0:
        for i in range(3):
            c.carried[i] = w.tip.carried[i]
        w.supply.energy += impulse_of_frames(w, c.X, c.F, c.problem.after, c.carried)
    for i in range(links.k):
        if c.event.happened[i] == 0.0:
            continue
        event, at = EventRow(events[state.event.rows]), 3 * i
        for j in range(events.shape[1]):
            events[state.event.rows, j] = 0.0
        event.time, event.kind, event.contact = w.time, c.event.happened[i], i
        if i >= first_stop:
            event.kind = RELEASE if c.event.happened[i] == LIFTOFF else STOP
        event.rate_before, event.rate_after, event.compression = c.before[at], c.problem.after[at], c.F[at]
        event.energy_lost, event.energy_rested = lost, rested
        lost = rested = 0.0
        if i == state.striking and c.event.struck[i] != 0.0:
            event.compression, event.decompression = w.impact.compression[0], w.impact.decompression[0]
            event.rate_cut = w.impact.discarded_rebound
        event.slip_before = math.hypot(c.before[at + 1], c.before[at + 2])
        event.slip_after = math.hypot(c.problem.after[at + 1], c.problem.after[at + 2])
        if i == state.striking and c.event.struck[i] != 0.0:
            event.restitution = w.impact.restitution_given
        elif c.before[at] < 0.0 < c.problem.after[at] and c.event.struck[i] != 0.0:
            event.restitution = -c.problem.after[at] / c.before[at]
        for j in range(3):
            event.tangential[j] = c.event.axes[at + 1, j] * c.F[at + 1] + c.event.axes[at + 2, j] * c.F[at + 2]
            event.position[j] = c.event.point[i, j]
        state.event.rows += 1
