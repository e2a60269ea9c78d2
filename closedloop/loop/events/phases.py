"""Phases and actions of `closedloop.loop.events.proceed`, and the tolerances of events."""

from __future__ import annotations

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

# An event is located to this, s; nearer than that to a row it happens at the row.
INSTANT = 1e-14
# Within this gap the tip is on the surface, m: the rounding of n·r − d is a few 1e-16, of a located touch 1e-14.
TOUCHING = 1e-12
# A negative gap down to −SHALLOW is rounding, m. After liftoff the gap grows with the cube of time at first, no faster
# than the error of an integrator: until it has exceeded LEAVING, m, more than a stabiliser leaves of e, plus the error
# of a step of first order, h² nᵀJ̇ᵣq̇, that sum is the tolerance.
SHALLOW, LEAVING = 1e-13, 1e-9
# A closure rate this small is the rounding of a velocity that was set to zero, m/s.
RESTING = 1e-11
# After so many events in a row within `RAPID`, s, of each other a bounce ends in contact, whatever its speed. Events of
# any kind are counted, and each row takes `OUTPACED` off the count: more than MAX_IN_STEP end the run. A bounce that
# comes to rest within a step has some hundreds (900 at a restitution of 0.99), once; what has more than OUTPACED in
# every step changes its mode faster than the step resolves, and no row shows it.
RAPID, MAX_RAPID = 1e-12, 20
MAX_IN_STEP = 2000
OUTPACED = 100
# In runs with contacts of links a joint that turns faster than the first, rad/s, turns by no more than the second in a
# part of a step, rad: bodies tumble, and near a pose in which two axes are parallel joints turn without bound.
FAST, LARGEST_TURN = 25.0, 0.025
# A step of several stages in which the forces of contacts multiply by more than the first and come to more than the
# second, as a multiple of the load, is taken again in halves down to the third, s: near Painlevé's paradox they have no
# bound. Where they jump, from one solution to another, no halving helps: there are at most so many in a step.
MOST_GROWTH, HIGH, SHORTEST_GROWTH, MOST_HALVINGS = 2.0, 30.0, 1e-8, 200
# Directions at which the onset of slip is evaluated before its roots are bracketed.
DIRECTIONS = 36
# Moves of a projection: Newton's method converges quadratically, from the nanometres or micrometres after a step in one
# move; five are for a start a millimetre off.
MAX_MOVES = 5


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
