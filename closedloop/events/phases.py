"""What the machine may ask for, what the terms it asked for are used for, and how exact it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel_inlined
from closedloop.step.memory import State

Array = NDArray[np.float64]

# What `proceed` returns.
DONE, TERMS, ROOM, IMPACT_LAW_WANTED, FAILED = range(5)

# Phases.
ARRIVING, STAGING, PROBING, AT_EVENT, IMPACTING, BEGINNING, PROJECTING = range(7)

# What a trial step is for. LOOKED is none: the step as it was, after a look at what one of its stages had shown.
NO_TRIAL, LOOKED, LOOK, SEARCH_EVENT, SEARCH_LOWEST, TAKE_EVENT = range(6)

# What is to be done next inside `proceed`: ask (the terms of w.q, w.v are wanted), or one of these.
ASK, LEAVE, SET_OUT, SET_OUT_AGAIN, APPLY_EVENT, APPLY_IMPACT, PROJECT, FAIL, ENLARGE, COLLIDE = range(10)

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


@kernel_inlined
def ask(state: State, phase: int) -> None:
    """Say what the next terms are for, and whether the law is to be evaluated with them."""
    state.phase = phase
    if phase == PROJECTING:
        state.sampled = 0
    elif state.hold > 0:
        state.sampled = 1 if phase == ARRIVING and state.row % state.hold == 0 else 0
    else:
        state.sampled = 1


# Events for which there is room at first; the table grows as needed.
ROOM_FOR_EVENTS = 64
