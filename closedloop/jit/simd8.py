"""Eight numbers that take part in arithmetic as one: a number of each of eight runs.

A processor adds eight pairs of numbers in about the time of one. The arithmetic of a step has few loops in which it
could: its matrices are small and each line waits for the one before. But eight runs do the same at every step. So
compiled code knows a number `float64x8`, eight float64 in one register, and arrays of it; a kernel that is given
float64x8 where it would be given floats is compiled for them, and its lines, in the same order, are done for eight
runs. Nothing in it is different: each of the eight comes out to the last bit as it would alone.

What a kernel cannot do is decide: a comparison of float64x8 has eight answers, and numba refuses to branch on it.
Kernels that are meant for both say `select` for a number that depends on a comparison, and `every` for a check.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDE = 8


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition holds, else `no`; both are worked out, so neither may fail."""
    return yes if condition else no


def every(condition: Any) -> bool:
    """Whether a condition holds, for float64x8 in all eight."""
    return bool(condition)


def nearest(x: float) -> float:
    """Return an angle as it is, or, where it is many turns, within half a turn of zero."""
    return x if abs(x) <= MANY_TURNS else math.atan2(math.sin(x), math.cos(x))


# Beyond this an angle's multiple of π/2 is no longer subtracted exactly, see `closedloop.robot.tree.angles`.
MANY_TURNS = 1e6


def aligned(*shape: int) -> Array:
    """Return zeros (*shape, WIDE) whose memory begins where a float64x8 may, for `float64x8_at`."""
    count = math.prod(shape) * WIDE
    room = np.zeros(count + WIDE)
    first = -(room.ctypes.data // room.itemsize) % WIDE
    return room[first : first + count].reshape(*shape, WIDE)
