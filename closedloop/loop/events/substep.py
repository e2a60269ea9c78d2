"""The beginning and the end of a substep."""

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.loop.events.locate import (
    ADVANCE,
    AFTER_EVENT,
    APPLY_EVENT,
    AT_EVENT,
    BEGIN_SUBSTEP,
    CHECK_STAGE,
    LOCATE_EVENT,
    LOCATE_MINIMUM,
    NEED_TERMS,
    NO_TRIAL,
    PART_END,
    PROJECTION,
    REACH_EVENT,
    RETRY_SUBSTEP,
    STAGE,
    STAGE_CHECKED,
    STEP_END,
    TRIAL_END,
    choose_trial,
    event_function,
    refine_bracket,
    request_terms,
)
from closedloop.loop.events.table import REVERSAL, SLIP_AGAIN, STICK
from closedloop.loop.step.contacts import ADVANCE_FRICTION, SAVE, force_over_load
from closedloop.loop.step.energy_supplied import save_power
from closedloop.loop.step.evaluate import SPEED_LIMIT
from closedloop.loop.step.joint_friction import advance_joint_friction
from closedloop.loop.step.memory import SMOOTH, Constants, State, Work, ask_contacts, takes_one_stage
from closedloop.loop.step.solve_contact import near_singular, remember_approach
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.closure.solve import CHATTER, CROWDED, DIVERGED, OK, RUBS
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.contacts.rolling import shapes_at, some_stand
from closedloop.mechanics.friction.answers import ADVANCE_STATES
from closedloop.mechanics.limits import (
    CLOSED,
    FAST,
    HIGH,
    HOVERING,
    INSTANT,
    LARGEST_TURN,
    MAX_IN_STEP,
    MOST_GROWTH,
    QUARTER,
    RESTING,
    TOUCHING,
)
from closedloop.mechanics.loops.memory import loops_at, tree_at
from closedloop.mechanics.robot.tree.layout import REVOLUTE, SLIDES


@kernel_inlined
def save_state(w: Work, constants: Constants, state: State) -> int:
    """Save the state and its derivative at the beginning of a substep of length w.length; return OK or DIVERGED."""
    n, extra = w.q.shape[0], w.z.shape[0]
    divides = state.contacts.entry != 0 and state.event.stepping == 0
    if divides and not divide_step(w, constants, state):
        return DIVERGED
    for j in range(n):
        w.start.state[j] = w.q[j]
        w.start.state[n + j] = w.v[j]
        w.start.slope[j] = w.qdd[j]
        w.drives.held[j] = w.torque[j]
    for j in range(extra):
        w.start.state[2 * n + j] = w.z[j]
        w.start.slope[n + j] = w.dz[j]
        w.decays.begin[j] = w.decays.rate[j]
    w.start.time, w.search.tau, w.search.least = w.time, w.length, np.inf
    w.start.gap, w.start.rate, w.start.contact_margin = w.tip.gap, w.tip.rate, w.contacts.margin
    state.trial.purpose, state.stage, state.trial.off, state.trial.watched = NO_TRIAL, 0, 0, 0
    if state.friction.sticking != SMOOTH:
        save_slip(w, constants, state)
    if state.mode == PRESSED and near_singular(w.tip.S):
        remember_approach(w, state)
    else:
        state.approached = 0
    if state.contacts.entry != 0:
        ask_contacts(state, SAVE)
    w.start.value = event_function(w, constants, state)
    save_power(w, state)
    return OK


@kernel_inlined
def save_slip(w: Work, constants: Constants, state: State) -> None:
    """Save the slip at the beginning of a substep, and its direction."""
    speed = np.hypot(w.tip.u[1], w.tip.u[2])
    w.start.slip_speed = speed
    w.start.slip[0], w.start.slip[1] = w.tip.u[1], w.tip.u[2]
    if state.mode == PRESSED and speed > max(constants.stick_speed, w.friction.straight_speed):
        w.friction.direction[0], w.friction.direction[1] = w.tip.u[1] / speed, w.tip.u[2] / speed


@kernel
def divide_step(w: Work, constants: Constants, state: State) -> bool:
    """Shorten a substep in which joints would turn, or change how fast they turn, by too much, or slips end; note it.

    Joints that slide do not count: nothing turns with them. Returns false where the motion diverges: a joint would be
    beyond SPEED_LIMIT before the step ends, and its substep is shorter than that of a joint at this limit.
    """
    fastest, change, left = 0.0, 0.0, w.length
    share = 1.0 if state.coupled == 0 or state.settings.stages == 1 else QUARTER
    fast, most = share * FAST, share * LARGEST_TURN
    links, c = contacts_at(state.contacts.at)
    tree = tree_at(loops_at(links.rows)[0])
    wheels = links.shapes != 0 and not some_stand(links, c)  # nothing turns with a wheel, unless its feet stand
    for j in range(w.q.shape[0]):
        turns = tree.links[REVOLUTE * tree.n + j] != SLIDES
        if turns and not (wheels and shapes_at(links.shapes).spins[j] != 0.0):
            fastest, change = max(fastest, abs(w.v[j])), max(change, abs(w.qdd[j]))
    state.divided = 1 if left < state.row * constants.h - w.time - INSTANT else 0
    if state.settings.adaptive != 0:
        return True
    parts = fastest * left / most if fastest > fast else 1.0
    reached = fastest + change * left
    if reached > FAST:
        parts = max(parts, change * left / (2.0 * LARGEST_TURN * max(fastest, FAST)))
    if parts > 1.0:
        w.length, state.divided = left / np.ceil(parts), 1
    if state.coupled != 0 and c.step.span < w.length:
        w.length, state.divided = c.step.span, 1
    if not (reached > SPEED_LIMIT and left * SPEED_LIMIT < parts * most):
        return True
    for j in range(w.q.shape[0]):
        w.v[j] += left * w.qdd[j]  # the error names the fastest
    return False


@kernel_inlined
def nothing_earlier(state: State) -> bool:
    """Whether there is no instant before this one to search, or to end a step at."""
    return bool(state.row == 0 or state.trial.off != 0 or state.event.stepping != 0)


@kernel
def begin_anew(w: Work, state: State, todo: int) -> int:
    """Return NEED_TERMS, to begin a time step instead of this substep, if forces multiply in it; else `todo`.

    Friction drives them without bound on the way to Painlevé's paradox: impulses have one.
    """
    if state.coupled == 0 or nothing_earlier(state) or takes_one_stage(state) or state.settings.adaptive != 0:
        return todo
    links, c = contacts_at(state.contacts.at)
    if links.shapes != 0 or links.stepped != 0:  # rows of shapes change along a step, and their forces with them
        return todo
    if not force_over_load(links, c) > max(HIGH, MOST_GROWTH * w.start.force_over_load):
        return todo
    state.trial.purpose = NO_TRIAL
    restore_state(w, state)
    w.time = w.start.time
    links.undecided, links.chattering, state.striking = 1, 2, -1
    request_terms(state, AFTER_EVENT)
    return NEED_TERMS


@kernel_inlined
def restore_state(w: Work, state: State) -> None:
    """Restore the saved state, for a step of another length, w.search.tau, from it."""
    n, extra = w.q.shape[0], w.z.shape[0]
    if state.coupled != 0:
        links, c = contacts_at(state.contacts.at)
        links.stepped = int(c.step.begun)
    for j in range(n):
        w.q[j] = w.start.state[j]
        w.v[j] = w.start.state[n + j]
        w.qdd[j] = w.start.slope[j]
    for j in range(extra):
        w.z[j] = w.start.state[2 * n + j]
        w.dz[j] = w.start.slope[n + j]
        w.decays.rate[j] = w.decays.begin[j]
    state.stage, w.search.least = 0, np.inf


@kernel
def advance_friction(w: Work, state: State, h: float) -> None:
    """Advance the states of friction by h at the velocity of the substep's beginning, exactly."""
    if state.mode != FREE and state.friction.states > 0 and state.coupled == 0:
        w.friction.slip[0], w.friction.slip[1], w.friction.span = w.start.slip[0], w.start.slip[1], h
        call_at(state.friction.entry, state.address, ADVANCE_STATES)
    if state.coupled != 0:
        w.friction.span = h
        ask_contacts(state, ADVANCE_FRICTION)
    advance_joint_friction(w, state, h)


@kernel_inlined
def finish_stage(w: Work, h: float, state: State, tableau: Array) -> None:
    """Request the terms after a stage: those of the next stage, or of the substep's end."""
    stage, tau = state.stage, w.search.tau
    if not takes_one_stage(state) and stage + 1 < state.settings.stages:
        state.stage = stage + 1
        node = 0.0
        for i in range(stage + 1):
            node += tableau[stage + 1, i]
        w.time = w.start.time + node * tau
        request_terms(state, STAGE)
    elif state.trial.purpose > STAGE_CHECKED:
        w.time = w.start.time + tau
        request_terms(state, AT_EVENT if state.trial.purpose == REACH_EVENT else TRIAL_END)
    else:
        w.time = state.row * h if state.divided == 0 else w.start.time + tau
        end = STEP_END if state.divided == 0 else PART_END
        if state.settings.project != 0 and state.event.stepping == 0 and (state.mode != FREE or state.coupled != 0):
            state.projection.moves, state.projection.next_phase = 0, end
            request_terms(state, PROJECTION)
        else:
            request_terms(state, end)


@kernel
def resume_step(w: Work, constants: Constants, state: State) -> int:
    """Continue after an event to the end of the step, or let the step end here."""
    left = state.row * constants.h - w.time
    if left <= INSTANT:
        state.trial.off = 1
        w.time = state.row * constants.h
        request_terms(state, STEP_END)
        return NEED_TERMS
    state.after_event = 1
    w.length = left
    return BEGIN_SUBSTEP


@kernel
def count_event(w: Work, state: State) -> None:
    """Count an event of this step, and those in a row within `INSTANT` of each other."""
    state.event.in_step += 1
    if w.time - w.last_event > INSTANT:
        state.event.rapid = 0
        state.event.instants += 1
    else:
        state.event.rapid += 1
    w.last_event = w.time


@kernel
def too_many_events(state: State, most_rapid: int) -> bool:
    """Return whether there are too many events at one instant, or in the latest steps, and write the status then."""
    if state.event.in_step > MAX_IN_STEP:
        state.status = CROWDED
        return True
    if state.event.rapid > most_rapid:
        state.status = RUBS if state.event.kind in (STICK, SLIP_AGAIN, REVERSAL) else CHATTER
        return True
    return False


@kernel_inlined
def check_stage(w: Work, state: State) -> int:
    """Return ADVANCE, or if f is negative at a stage RETRY_SUBSTEP, with a trial step to the stage's instant.

    So a negative f that begins and ends within the step is found if a stage samples it. A stage is of lower order than
    the step: the event is searched for only if f is negative at the end of the trial step too.
    """
    tau = w.time - w.start.time
    if (
        state.coupled != 0
        or state.trial.purpose != NO_TRIAL
        or state.mode == FREE
        or not w.tip.rigid_force < 0.0
        or tau > w.length - INSTANT
    ):
        return ADVANCE
    state.trial.purpose, state.trial.steps = CHECK_STAGE, 0
    w.search.low, w.search.high, w.search.tau = 0.0, tau, tau
    w.search.at_low = max(w.start.value, 0.0)
    return RETRY_SUBSTEP


@kernel
def end_before_stage(w: Work, state: State) -> int:
    """Search for the event before a stage at which no forces go with the modes of the contacts."""
    if state.trial.purpose == REACH_EVENT:
        if w.search.tau == w.search.low:
            return ADVANCE  # there are none at the substep's beginning either: the event is there
        w.search.tau = w.search.low
        return RETRY_SUBSTEP
    if state.trial.purpose > STAGE_CHECKED:
        w.search.value = -1.0
        return int(refine_bracket(w, state))
    state.trial.purpose, state.trial.steps = LOCATE_EVENT, 0
    w.search.low, w.search.high, w.search.least_to_high = 0.0, w.search.tau - INSTANT, np.inf
    w.search.at_low, w.search.at_high = max(w.start.value, 0.0), -1.0
    choose_trial(w, state)
    return RETRY_SUBSTEP


@kernel_inlined
def check_step(w: Work, drift: float, state: State) -> int:
    """Return the action at the end of a step: BEGIN_SUBSTEP, APPLY_EVENT here, or RETRY_SUBSTEP to locate an event."""
    here = nothing_earlier(state)
    trial = NO_TRIAL
    if state.mode != FREE or state.coupled != 0:
        if w.search.value < 0.0:
            trial = REACH_EVENT if here else LOCATE_EVENT
    elif state.settings.unilateral != 0:
        leaving = HOVERING + (w.length * w.length * abs(drift) if state.settings.stages == 1 else 0.0)
        if state.past_edge != 0:
            if w.tip.gap > leaving:
                state.past_edge = 0
        elif here:
            if w.tip.gap <= TOUCHING and w.tip.rate < -RESTING:
                trial = REACH_EVENT
        elif w.tip.gap < -(CLOSED if state.cleared != 0 else leaving):
            trial = LOCATE_EVENT
        elif state.cleared != 0 and w.start.rate < -RESTING and w.tip.rate > 0.0:
            trial = LOCATE_MINIMUM  # down and up again: locate the lowest point
        if w.tip.gap > leaving:
            state.cleared = 1
    if state.coupled == 0 and w.contacts.margin < 0.0:
        trial, state.trial.watched = REACH_EVENT if here else LOCATE_EVENT, 1
        w.start.value = min(w.start.value, w.start.contact_margin)
        w.search.value = min(w.search.value, w.contacts.margin)
    state.trial.purpose = trial
    if trial == NO_TRIAL:
        return BEGIN_SUBSTEP
    if trial == REACH_EVENT:
        return APPLY_EVENT
    state.trial.steps = 0
    w.search.low, w.search.high, w.search.least_to_high = 0.0, w.length, w.search.least
    if trial == LOCATE_MINIMUM:
        w.search.at_low, w.search.at_high = -w.start.rate, -w.tip.rate
    else:
        w.search.at_low, w.search.at_high = max(w.start.value, 0.0), w.search.value
    choose_trial(w, state)
    return RETRY_SUBSTEP
