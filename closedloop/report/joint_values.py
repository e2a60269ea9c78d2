"""What each joint of a run came to, row by row: limits left, and torque that alternates."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import select
from closedloop.report.measures import JOINT_MEASURES, LEAST_TORQUE
from robot_models import RobotModel

Array = NDArray[np.float64]

# A joint's values, `JOINT_MEASURES`.
JOINT_VALUES = len(JOINT_MEASURES)
EXCESS, LEFT_AT, MOST_SPEED, TOO_FAST_AT, MOST_TORQUE, TOO_STRONG_AT, CHATTER = range(JOINT_VALUES)
# Of a signal that may chatter: its last value, difference and second difference, what alternates of it, and its size.
BEFORE, SLOPE_BEFORE, TURN_BEFORE, ALTERNATING, SIZE = range(5)
SIGNAL_TALLY = 5
# Of a joint: its values but the last, and its torque as a signal.
TORQUE = CHATTER
JOINT_TALLY = TORQUE + SIGNAL_TALLY
# Rows of the limits of the joints.
LOWER, UPPER, FASTEST, STRONGEST = range(4)


def joint_limits(model: RobotModel) -> Array:
    """Return the limits of the joints as the kernels read them: (4, n), rad, rad/s and N m, infinite where none is."""
    return np.stack([model.position_lower, model.position_upper, model.velocity_limit, model.effort_limit])


@kernel
def begin_joints(tally: Array, n: int) -> None:
    """Write the tally (>= JOINT_TALLY n,) of no row."""
    for j in range(n):
        at = JOINT_TALLY * j
        for i in range(JOINT_TALLY):
            tally[at + i] = 0.0
        tally[at + LEFT_AT], tally[at + TOO_FAST_AT], tally[at + TOO_STRONG_AT] = math.nan, math.nan, math.nan


@kernel_inlined
def count_signal(x: float, i: int, t: Array) -> None:
    """Count the value that a signal has in row i into its tally t (5,).

    What alternates is the part x_i = ... + (−1)^i a: its second differences are 4 a and change their sign from row to
    row, so a quarter of the smaller of two neighbours is taken wherever they differ in sign.
    """
    slope = x - t[BEFORE]
    turn = slope - t[SLOPE_BEFORE]
    if i >= 3:  # the first has no difference, the second no second one, the third none before it
        smaller = min(abs(turn), abs(t[TURN_BEFORE]))
        t[ALTERNATING] += select(turn * t[TURN_BEFORE] < 0.0, 0.25 * smaller, 0.0)
    t[BEFORE], t[SLOPE_BEFORE], t[TURN_BEFORE] = x, slope, turn
    t[SIZE] += abs(x)


@kernel_inlined
def count_joint(q: float, v: float, torque: float, j: int, i: int, h: float, limits: Array, t: Array) -> None:
    """Count joint j's position, velocity and torque in row i into its tally t (JOINT_TALLY,)."""
    excess = max(q - limits[UPPER, j], limits[LOWER, j] - q)
    speed, size = abs(v), abs(torque)
    t[EXCESS], t[MOST_SPEED] = max(t[EXCESS], excess), max(t[MOST_SPEED], speed)
    t[MOST_TORQUE] = max(t[MOST_TORQUE], size)
    t[LEFT_AT] = select((excess > 0.0) & (t[LEFT_AT] != t[LEFT_AT]), h * i, t[LEFT_AT])
    fast, strong = speed > limits[FASTEST, j], size > limits[STRONGEST, j]
    t[TOO_FAST_AT] = select(fast & (t[TOO_FAST_AT] != t[TOO_FAST_AT]), h * i, t[TOO_FAST_AT])
    t[TOO_STRONG_AT] = select(strong & (t[TOO_STRONG_AT] != t[TOO_STRONG_AT]), h * i, t[TOO_STRONG_AT])
    count_signal(torque, i, t[TORQUE:JOINT_TALLY])


@kernel
def write_joints(tally: Array, n: int, out: Array) -> None:
    """Write the values (JOINT_VALUES n,) of the joints, each for all of them, from their tally."""
    mean = 0.0
    for j in range(n):
        mean += tally[JOINT_TALLY * j + TORQUE + SIZE] / n
    for j in range(n):
        at = JOINT_TALLY * j
        for m in range(CHATTER):
            out[n * m + j] = tally[at + m]
        size = max(tally[at + TORQUE + SIZE], LEAST_TORQUE * mean)
        out[n * CHATTER + j] = share_of(tally[at + TORQUE + ALTERNATING], size)


@kernel_inlined
def share_of(part: float, whole: float) -> float:
    """Return part/whole, 0 of nothing."""
    share: float = select(whole > 0.0, part / select(whole > 0.0, whole, 1.0), 0.0)
    return share
