"""Phases and actions of `closedloop.loop.events.proceed`, and the tolerances of events."""

from closedloop.jit.kernel import kernel_inlined
from closedloop.loop.step.memory import State

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
