"""What the loops of a mechanism determine before the first step: the first reading of encoders, and the springs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.interpreted import interpreted
from closedloop.loops.bind import loop_memory
from closedloop.loops.close import close_state, factor_rows
from closedloop.loops.factor import factor
from closedloop.loops.memory import LoopMemory
from closedloop.loops.rows import locate_rows
from closedloop.robot.pinocchio import Robot
from closedloop.step.closed_loops import through_drives
from closedloop.step.memory import Work

Array = NDArray[np.float64]


def close_reading(w: Work, memory: LoopMemory) -> None:
    """Move the first reading of encoders, in place of q and q̇, to the nearest state that the loops allow.

    Their rank is that at the true state, before it is found in the course of a run.
    """
    links, rows = memory
    rows.q[:], rows.v[:] = w.true_q, w.true_v
    interpreted(locate_rows)(links, rows)
    interpreted(factor_rows)(links, rows, rows.error, links.m)
    links.known = links.rank
    interpreted(close_state)(links, rows, w.q, w.v)


def torque_of_drives(robot: Robot, q: Array, torque: Array) -> Array:
    """Return the torque (n,) of the drives alone, N m (N), that moves a mechanism as a given one does at q."""
    links, rows = loop_memory(robot)
    rows.q[:], found = q, np.array(torque)
    interpreted(locate_rows)(links, rows)
    interpreted(factor)(links, rows, rows.error, links.m)
    interpreted(through_drives)(links, rows, found)
    return found
