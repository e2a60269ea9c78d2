"""What the loops of a mechanism determine before the first step: the first reading of encoders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.memory import Work
from closedloop.mechanics.loops.close import close_state, factor_rows
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.rows import locate_rows

Array = NDArray[np.float64]


def close_reading(w: Work, memory: LoopMemory) -> None:
    """Move the first reading of encoders, in place of q and q̇, to the nearest state that the loops allow.

    Their rank is that at the true state, before it is found in the course of a run.
    """
    links, rows = memory
    rows.q[:], rows.v[:] = w.encoders.true_q, w.encoders.true_v
    interpreted(locate_rows)(links, rows)
    interpreted(factor_rows)(links, rows, rows.error, links.m)
    links.known = links.rank
    interpreted(close_state)(links, rows, w.q, w.v)
