"""What multiplies the error of a step: exponential growth, bounces that go on, joints that rest and move again.

The error of such a run is no sum of what its steps add, see `closedloop.record.report.step_error`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from closedloop.base.arrays import Array

# A path that starts smoothly leaves an error as t⁵ at most. Its changes grow by (k + 1)⁴ from the first to the part
# k after it; of growth it is so many times that, in so many successive parts, in each of which it rises by so much.
PARTS, GROWING, GROWTH, RISE = 20, (8, 11, 15), 1.5, 1.25
# What is no more than rounding at first, N from row to row, and a growth from it, of which each quarter of the run has
# a share within these.
FROM_ROUNDING, GROWN, EVEN = 1e-11, 300.0, (0.1, 0.45)
# A stabiliser makes up to so many N of rounding from row to row, and a growth hides in them at first. What comes out of
# them, rising over each two parts (a swing may be longer than a part) and with no part that has more than this
# share of it, grows if the later half of the parts has so much of the earlier half's. Of a path, wherever it starts, it
# is 0.75 at most, but for what rounding hides.
STABILISED, OF_ALL, STEADY = 1e-8, 1.0 / 3.0, 0.85
# Joints slower than this, rad/s (m/s), rest: in motion friction has its direction.
AT_REST = 1e-6
# Bounces go on where of so many successive strikes the faster of the last two has this share of the first two's. Those
# of a touchdown decay: with a restitution of 0.9 to 0.66. How far a flight is then, every step before says.
STRIKES, LASTING = 6, 0.7


def grows(off: Array) -> bool:
    """Whether an error (N,) grows exponentially: in each of some successive parts of the run, more than a path does.

    The sum of the errors that the steps add is none of such a motion, which multiplies them, and rounding too. It is
    told by the changes from row to row, which a force that is off by as much in all rows does not hide. Without the
    largest of its parts' shares in it the growth must be as steep: a jump is none. From rounding on less is enough, if
    it is even over the run, or steady from where it comes out.
    """
    most, steps = _parts(off)
    if most[0] <= FROM_ROUNDING and bool(np.all(most > 0.0)):
        # Evenly over the whole run: of a path that starts smoothly most of it is in the first quarter.
        quarters = np.sum(steps[: 4 * (len(steps) // 4)].reshape(4, -1), axis=1)
        total = float(np.sum(quarters))
        if total >= math.log(GROWN) and np.all((quarters > EVEN[0] * total) & (quarters < EVEN[1] * total)):
            return True
    for count in GROWING if np.count_nonzero(steps >= math.log(RISE)) >= GROWING[0] else ():
        parts, least = sliding_window_view(steps, count), math.log(GROWTH * (count + 1) ** 4) / count
        total, largest = np.sum(parts, axis=1), np.max(parts, axis=1)
        steep = (total >= count * least) & (total - largest >= (count - 1) * least)
        if np.any((np.min(parts, axis=1) >= math.log(RISE)) & steep):
            return True
    return _comes_out(most, steps) >= GROWN


def comes_out(off: Array) -> float:
    """Return how many times an error (N,) grows steadily from what a stabiliser makes of rounding; 1 if it does not."""
    return _comes_out(*_parts(off))


def _comes_out(most: Array, steps: Array) -> float:
    """Do `comes_out` for the parts of an error, see `_parts`."""
    found = 0.0
    rises = steps[1:] + steps[:-1] >= 2.0 * math.log(RISE)
    may = np.count_nonzero(rises) >= GROWING[0] - 1 and np.any((most > 0.0) & (most <= STABILISED))
    for count in GROWING if may else ():
        parts, half = sliding_window_view(steps, count), count // 2
        total, begin = np.sum(parts, axis=1), most[: len(steps) - count + 1]
        first, last = np.sum(parts[:, :half], axis=1), np.sum(parts[:, -half:], axis=1)
        steady = (last >= STEADY * first) & (np.max(parts, axis=1) <= OF_ALL * total)
        rise = np.all(sliding_window_view(rises, count - 1), axis=1)
        found = max(found, float(np.max(total * (steady & rise & (begin > 0.0) & (begin <= STABILISED)))))
    return math.exp(found)


def _parts(off: Array) -> tuple[Array, Array]:
    """Return the largest change from row to row in each part of a run, (PARTS,), and by how much its logarithm grows.

    They are 0 if it has fewer rows.
    """
    changes = np.diff(off)
    size = len(changes) // PARTS
    if size == 0:
        return np.zeros(PARTS), np.zeros(PARTS - 1)
    most = np.max(np.abs(changes[: PARTS * size].reshape(PARTS, size)), axis=1)
    return most, np.diff(np.log(np.maximum(most, np.finfo(float).tiny))) * (most[:-1] > 0.0)


def bounces_on(speeds: Array) -> bool:
    """Whether bounces with these speeds of their strikes (k,), m/s, go on anywhere: they do not decay."""
    pairs = np.maximum(speeds[1:], speeds[:-1])
    return bool(np.any(pairs[STRIKES - 2 :] >= LASTING * pairs[: 2 - STRIKES]))


def starts_again(v: Array) -> int:
    """Return how often the joint of these velocities (N, n) that did so most came to rest, and moved again."""
    moves = np.abs(v) > AT_REST
    begun = np.sum(moves[1:] & ~moves[:-1], axis=0) + moves[0]
    return max(int(np.max(begun, initial=0)) - 1, 0)
