"""Phases and actions of `closedloop.loop.events.proceed`, and the instant of an event.

It is the root, which is bracketed, of the event function: negative once a mode has ended.
"""

from typing import Any

import numpy as np

from closedloop.jit.calls import call_at
from closedloop.jit.dual8 import along, has_derivatives, settled, slope_of, sought
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import select
from closedloop.loop.step.memory import RIGID_STICK, SPRING_STICK, Constants, State, Work
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.friction.answers import LIMIT
from closedloop.mechanics.friction.law import STILL
from closedloop.mechanics.limits import CLOSED, EXACT, INSTANT, SLIGHT, SMALL

# What `proceed` returns.
DONE, TERMS, TABLE_FULL, IMPACT_LAW_WANTED, FAILED = range(5)

# Phases: what the terms requested last are for, see `closedloop.loop.events.proceed`.
STEP_END, STAGE, TRIAL_END, AT_EVENT, IMPULSES_KNOWN, AFTER_EVENT, PROJECTION, MEASURED, PART_END, QUERY = range(10)

# What a trial step is for. With STAGE_CHECKED a trial step has shown that a negative f at a stage was no event.
NO_TRIAL, STAGE_CHECKED, CHECK_STAGE, LOCATE_EVENT, LOCATE_MINIMUM, REACH_EVENT = range(6)

# Actions inside `proceed`. NEED_TERMS: return for the terms at w.q, w.v.
(
    NEED_TERMS,
    ADVANCE,
    BEGIN_SUBSTEP,
    RETRY_SUBSTEP,
    APPLY_EVENT,
    APPLY_IMPACT,
    PROJECT,
    FAIL,
    ENLARGE_TABLE,
    SOLVE_IMPACT,
) = range(10)

# Directions at which the onset of slip is evaluated before its roots are bracketed.
DIRECTIONS = 36


@kernel_inlined
def request_terms(state: State, phase: int) -> None:
    """Set what the next terms are for, and whether the law is evaluated with them."""
    state.phase = phase
    if phase == PROJECTION:
        state.sampled = 0
    elif state.settings.hold > 0:
        state.sampled = 1 if phase == STEP_END and state.row % state.settings.hold == 0 else 0
    else:
        state.sampled = 1


# Rows of the table of events at first; it grows as needed.
INITIAL_EVENTS = 64


# An event function that at a stage is no more than a slip that has no direction has jumped: in mm/s at the tip, in m/s
# at contacts of links.
AT_REST = 1.001e3 * STILL


@kernel
def event_function(w: Work, constants: Constants, state: State) -> float:
    """Return the event function, positive as long as nothing changes: a gap, m, a force, N, or a speed, mm/s.

    The gaps of open contacts of links, and of stops, count too where one of them closes in the substep
    (`Trial.watched`): elsewhere they must not choose the instants that are tried. That of a tip which has just left
    the surface does not count then: it is rounding.
    """
    if state.coupled != 0:
        return float(w.contacts.margin)
    others = float(w.contacts.margin) if state.trial.watched != 0 else np.inf
    if state.mode == FREE:
        counts = state.past_edge == 0 and (state.trial.watched == 0 or state.cleared != 0)
        return min(float(w.tip.gap) if counts else 1.0, others)
    least: float = min(w.tip.rigid_force if state.settings.unilateral != 0 else 1.0, others)
    if w.tip.inside < least:
        least = w.tip.inside
    if state.friction.sticking in (RIGID_STICK, SPRING_STICK):
        least = min(least, cone_margin(w, state) if state.mode == STUCK else 1e3 * slip_margin(w, constants))
    return least


@kernel
def cone_margin(w: Work, state: State) -> float:
    """Return what is left of the friction cone to a tip that sticks, μ_s f − |F_t|, N."""
    call_at(state.friction.entry, state.address, LIMIT)
    limit = w.friction.stick_limit * abs(w.tip.F[0])
    if state.friction.sticking == SPRING_STICK:
        limit += EXACT * limit
    return float(limit - np.hypot(w.tip.F[1], w.tip.F[2]))


@kernel
def slip_margin(w: Work, constants: Any) -> float:
    """Return the speed along the direction in which slip began, m/s, above the speed at which sticking is tried."""
    band, before = constants.capture_speed, w.start.slip_speed
    speed = w.tip.u[1] * w.friction.direction[0] + w.tip.u[2] * w.friction.direction[1]
    # At the onset of slip its velocity is of the size of rounding.
    onset = before <= constants.stick_speed
    margin: float = select(onset, speed + constants.stick_speed, speed - select(before > band, band, 0.0))
    return margin


@kernel
def choose_trial(w: Work, state: State) -> None:
    """Choose the next trial instant in the search's bracket, by Chandrupatla's method.

    That is inverse quadratic interpolation, or bisection where the three latest values do not allow it (T. R.
    Chandrupatla, Adv. Eng. Softw. 28, 1997). The first trial is that of the secant.
    """
    low, high, a, b = w.search.low, w.search.high, w.search.at_low, w.search.at_high
    share, of_low = 0.5, w.search.tau == low  # of the bracket, from its newer end
    if state.trial.steps == 0:
        if a > 0.0 > b and a > SLIGHT * -b:
            share = a / (a - b) if of_low else b / (b - a)
    else:
        x, y = (low, a) if of_low else (high, b)
        far, at_far = (high, b) if of_low else (low, a)
        old, at_old = w.search.replaced, w.search.at_replaced
        within, fall = (x - far) / (old - far), (y - at_far) / (at_old - at_far)
        if fall * fall < within and (1.0 - fall) * (1.0 - fall) < 1.0 - within:
            share = y / (at_far - y) * at_old / (at_far - at_old)
            share += (old - x) / (far - x) * y / (at_old - y) * at_far / (at_old - at_far)
    tau = low + share * (high - low) if of_low else high - share * (high - low)
    state.trial.steps += 1
    w.search.tau = min(max(tau, low + 0.4 * INSTANT), high - 0.4 * INSTANT)


@kernel
def refine_bracket(w: Work, state: State) -> int:
    """Shrink the bracket by the event function at the end of a trial step, until the instant is known."""
    tau, value = w.search.tau, w.search.value
    if state.trial.settling != 0:
        settle_instant(w, state)
        return RETRY_SUBSTEP
    if state.trial.purpose == CHECK_STAGE:
        state.trial.purpose = LOCATE_EVENT if value < 0.0 else STAGE_CHECKED
        if state.trial.purpose == STAGE_CHECKED:
            w.search.tau = w.length
            return RETRY_SUBSTEP
    if state.trial.purpose == LOCATE_MINIMUM:
        if w.tip.gap < -CLOSED:  # the tip penetrates: locate the crossing before
            state.trial.purpose = LOCATE_EVENT
            w.search.low, w.search.at_low = 0.0, max(w.start.gap, 0.0)
        else:
            value = -w.tip.rate
    if value >= 0.0:  # at zero its mode has not ended: an event applied there would change nothing, and come again
        w.search.replaced, w.search.at_replaced = w.search.low, w.search.at_low
        w.search.low, w.search.at_low = tau, value
    else:
        w.search.replaced, w.search.at_replaced = w.search.high, w.search.at_high
        w.search.high, w.search.at_high, w.search.least_to_high = tau, value, w.search.least
    if w.search.high - w.search.low > max(INSTANT, 4e-16 * w.time):
        choose_trial(w, state)
    elif state.trial.purpose == LOCATE_MINIMUM or w.search.high == w.length:
        # There is no event in the step, or it is at the row itself: the step is valid.
        state.trial.purpose, state.trial.off = NO_TRIAL, 1
        w.search.tau = w.length
    elif w.search.least_to_high < -SMALL and w.search.low > INSTANT and not has_derivatives(tau):
        # What the event begins with acts at stages before it: a part of the step ends just before, a short one there.
        state.trial.purpose, state.divided = NO_TRIAL, 1
        w.search.tau = w.length = w.search.low
    else:
        # An impact is applied just before penetration, every other event just after its mode has ended.
        state.trial.purpose = REACH_EVENT
        w.search.tau = (
            w.search.low if state.mode == FREE and state.coupled == 0 and state.trial.watched == 0 else w.search.high
        )
        if has_derivatives(tau):
            state.trial.purpose, state.trial.settling = LOCATE_EVENT, 1
            w.search.tau = along(w.search.tau)
    return RETRY_SUBSTEP


@kernel
def note_stage(w: Work, constants: Constants, state: State) -> None:
    """Write the least of the event function at the stages of a step to an instant whose derivatives are sought."""
    value = event_function(w, constants, state)
    if state.stage == 1 or abs(value) < abs(w.search.at_stage):
        w.search.at_stage = value


@kernel
def settle_instant(w: Work, state: State) -> None:
    """Give the instant that was found its derivatives, by two more trial steps to it.

    In the first the instant is the unknown, so the event function has its rate there; in the second it is constant.
    Where friction that stops turning at a stage lets the event function jump past zero, it is zero at that stage, or as
    small as where slip has no direction.
    """
    value = w.search.value
    if state.settings.stages > 1 and abs(w.search.at_stage) < max(SMALL * abs(value), AT_REST) < abs(value):
        value = w.search.at_stage
    if state.trial.settling == 1:
        w.search.at_low, w.search.tau = slope_of(value), sought(w.search.tau)
        state.trial.settling = 2
    else:
        w.search.tau = settled(w.search.tau, value, w.search.at_low)
        state.trial.settling, state.trial.purpose = 0, REACH_EVENT
