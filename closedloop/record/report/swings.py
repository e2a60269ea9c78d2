"""Regular swings of a signal: growing, or a limit cycle; noise, drifts and decaying oscillations are not."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array

# A regular swing has so many periods, each so many rows long, and periods that vary by this share of their mean at
# most. The times between crossings of noise vary by as much as their mean.
PERIODS, ROWS_IN_PERIOD, IRREGULAR = 4, 4, 0.4
# A swing that grows is no transient, wherever it began: in a slow one three periods over all the time tell. Two show
# that there may be one.
GROWING_PERIODS, LEAST_PERIODS = 3, 2
# So many means of neighbouring rows show a swing that is too slow for the later half alone: of eight periods at most.
SLOW_ROWS = 512
# Swings of the last third over those of the first: beyond this they grow, below its inverse they die away.
GROWTH = 1.5


class Swing(NamedTuple):
    """A regular swing: median amplitude of its last third, period, s, first instant, s, growth, number of periods."""

    amplitude: float
    period: float
    at: float
    growth: float
    periods: int

    @property
    def known(self) -> bool:
        """Whether there are enough periods to tell it from a transient."""
        return self.periods >= (GROWING_PERIODS if self.growth > GROWTH else PERIODS)


def lasting_swing(x: Array, bound: float, h: float, begin: float) -> Swing | None:
    """Return the regular swing in the later half of a signal (N,), or one over all of it, which may be too short."""
    half = len(x) // 2
    found = regular_swing(x[half:], bound, h, begin + half * h)
    if found is None:
        k = max(1, len(x) // SLOW_ROWS)
        slow = x[: len(x) // k * k].reshape(-1, k) @ np.full(k, 1.0 / k) if k > 1 else x
        found = regular_swing(slow, bound, k * h, begin, LEAST_PERIODS)
    return found


def regular_swing(x: Array, bound: float, h: float, begin: float, periods: int = PERIODS) -> Swing | None:
    """Return the swing of a signal (N,), `h` s apart, of `periods` and more beyond ±`bound`; None without one.

    What counts is a period from one rise through the middle to the next, each with an excursion to both sides between
    of more than half the bound and half the RMS; the last third of them must reach the bound, and all must last
    about equally long.
    """
    if len(x) < periods * ROWS_IN_PERIOD:
        return None
    k, middle = _centred(len(x)), float(np.add.reduce(x)) / len(x)
    slope = float(np.dot(k, x)) / (len(x) * (len(x) ** 2 - 1.0) / 12.0)  # a drift is no swing
    # Without the work below: in each period the signal less its drift is beyond half the bound on both sides.
    level = 0.5 * bound - abs(middle) - 0.5 * len(x) * abs(slope)
    if level > 0.0 and min(np.count_nonzero(x > level), np.count_nonzero(x < -level)) < periods:
        return None
    y = x - middle - k * slope
    level = 0.5 * max(bound, rms(y))  # noise on a large swing does not pass the middle twice
    if not np.max(y) - np.min(y) > 2.0 * bound:
        return None  # nor where it is not finite
    there = np.flatnonzero(np.abs(y) > level)
    above = y[there] > 0.0
    rises = there[1:][above[1:] & ~above[:-1]]
    if rises.size < periods + 1:
        return None
    lengths = np.diff(rises)
    period = float(np.mean(lengths))
    if period < ROWS_IN_PERIOD or np.std(lengths) > IRREGULAR * period:
        return None
    swings = 0.5 * (np.maximum.reduceat(y[: rises[-1]], rises[:-1]) - np.minimum.reduceat(y[: rises[-1]], rises[:-1]))
    third = max(1, swings.size // 3)
    first, last = float(np.median(swings[:third])), float(np.median(swings[-third:]))
    ended = (len(x) - rises[-1]) > max(2.0 * period, 0.25 * len(x))
    growth = last / first
    if last <= bound or growth < 1.0 / GROWTH or ended:
        return None
    return Swing(last, period * h, begin + rises[0] * h, growth, lengths.size)


@lru_cache(maxsize=8)
def _centred(count: int) -> Array:
    """Return whole numbers about 0; read only."""
    return np.arange(count, dtype=float) - 0.5 * (count - 1)


def rms(x: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(x * x)))
