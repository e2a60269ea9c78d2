"""SIMD lanes: the type float64x8, eight float64 in one register, one for each of eight runs.

The arithmetic of a step does not vectorise by itself: its matrices are small and each operation depends on the one
before. But eight runs do the same operations at every step. A kernel called with float64x8 in place of floats is
compiled for that type and does its operations, in the same order, for eight runs; each result is the same to the last
bit as that of one run.

Kernels for float64x8 must not branch: a comparison has eight results, and numba refuses to branch on it. They use
`select` for a number that depends on a comparison, and `every` for a check.

Operations on all lanes of an array are compiled as a loop, and interpreted as one operation of numpy:

    @kernel_inlined
    @lanewise
    def multiply(x, y, lanes, to):
        for r in range(lanes):
            to[r] = x[r] * y[r]

Interpreted, `range` is one slice of all lanes, so that the line is done once; the numbers are the same to the last bit.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from closedloop.base.arrays import Array

F = TypeVar("F", bound=Callable[..., Any])


def lanewise(function: F) -> F:
    """Mark a function whose loops over lanes do the same for each, without a branch."""
    function.__dict__["lanewise"] = True
    return function


def _larger(x: Any, y: Any) -> Any:
    return np.where(y > x, y, x)  # what Python's `max` and compiled code's return, of what is no number too


# What stands in an interpreted lanewise function in place of these names.
LANEWISE: dict[str, Any] = {"range": lambda lanes: (slice(0, lanes),), "max": _larger}


WIDE = 8


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition holds, else `no`; both are evaluated, so neither may fail.

    Outside compiled code the condition may be an array, of all rows of a column.
    """
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes, no)
    return yes if condition else no


def every(condition: Any) -> bool:
    """Whether a condition holds, for float64x8 in all eight, for an array in all rows."""
    return bool(np.all(condition)) if isinstance(condition, np.ndarray) else bool(condition)


def nearest(x: Any) -> Any:
    """Return an angle unchanged, or, where it is many turns, reduced to half a turn about zero."""
    if isinstance(x, np.ndarray):
        return np.array([nearest(each) for each in x.tolist()])
    return x if abs(x) <= MANY_TURNS else math.atan2(math.sin(x), math.cos(x))


# Beyond this an angle's multiple of π/2 is not subtracted exactly, see `closedloop.mechanics.robot.tree.kinematics`.
MANY_TURNS = 1e6


def aligned(*shape: int) -> Array:
    """Return zeros (*shape, WIDE) whose memory begins where a float64x8 may, for `float64x8_at`."""
    count = math.prod(shape) * WIDE
    room = np.zeros(count + WIDE)
    first = -(room.ctypes.data // room.itemsize) % WIDE
    return room[first : first + count].reshape(*shape, WIDE)
