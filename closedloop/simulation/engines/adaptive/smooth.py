"""The instants of an adaptive run: where an event is, and the reference between its discontinuities.

An integrator of high order must not step over a discontinuity, and needs the reference at any instant. So the run is
divided where the reference, its derivatives or the law are discontinuous. On each interval the desired motion and force
are interpolated at Chebyshev nodes inside it: at the end of an interval they have the left limit, at its beginning the
right limit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebfit, chebpts1, chebval
from scipy.optimize import brentq, minimize_scalar

from closedloop.base.arrays import Array
from closedloop.control.reference.desired import Desired
from closedloop.control.reference.force import SineForceSection, StepForceSection, WaypointForceSection

# Intervals of a step at whose ends the event function is evaluated: enough for its extrema within a step of an
# integrator of order eight with a small tolerance.
SAMPLES = 8
# A minimum is searched for if the parabola through three samples falls below this share of the lowest.
DEEP = 0.3

EventFunction = Callable[[float], float]


def root(event_function: EventFunction, low: float, high: float) -> float:
    """Return where a continuous event function changes its sign between low and high, to rounding (Brent)."""
    return float(brentq(event_function, low, high, xtol=1e-17, rtol=9e-16, maxiter=200))


def first_crossing(
    event_function: EventFunction, length: float, floor: float = 0.0, rate: EventFunction | None = None
) -> float | None:
    """Return the first instant in 0 .. length at which the event function falls through zero, None if it does not.

    `event_function`: not negative at 0 but for rounding.
    `length`: of the step.
    `floor`: a value no further than this below zero is rounding.
    `rate`: derivative of the event function. With it a minimum between two samples is found, and a rise from zero that
        ends before the first sample.
    """
    times: list[float] = np.linspace(0.0, length, SAMPLES + 1).tolist()
    values = [event_function(t) for t in times]
    for t in _extremes(event_function, rate, times, values):
        times.append(t)
        values.append(event_function(t))
    order = np.argsort(times, kind="stable").tolist()
    before, above = 0.0, values[0]
    for i in order[1:]:
        if values[i] < -floor:
            return root(event_function, before, times[i]) if above > 0.0 else before
        before, above = times[i], values[i]
    return None


def _extremes(
    event_function: EventFunction, rate: EventFunction | None, times: list[float], values: list[float]
) -> list[float]:
    """Return instants between the samples at which the event function has extrema."""
    if rate is not None:
        slopes = [rate(t) for t in times]
        return [root(rate, times[i], times[i + 1]) for i in range(SAMPLES) if slopes[i] * slopes[i + 1] < 0.0]
    found = []
    for i in range(1, SAMPLES):
        left, here, right = values[i - 1 : i + 2]
        bend = left - 2.0 * here + right
        dips = here <= min(left, right) and bend > 0.0 and here > 0.0
        if dips and here - (right - left) ** 2 / (8.0 * bend) < DEEP * here:
            around = (times[i - 1], times[i + 1])
            lowest = minimize_scalar(event_function, bounds=around, method="bounded", options={"xatol": 1e-12})
            found.append(float(lowest.x))
    return found


NODES = 16
_NODES = chebpts1(NODES)
_DEGREES = np.arange(NODES, dtype=np.float64)
# Points of −1 .. 1 at which the interpolation error is checked, and its bounds, relative to 1 or to the value. Halving
# an interval divides the error by 2¹⁶; an error below ROUNDING that does not fall is rounding. Two instants nearer than
# that, relative to 1 s or to themselves, are one: i·h and a decimal number differ by rounding.
_CHECKS = np.array([-0.995, -0.3, 0.55, 0.999])
MISFIT, ROUNDING = 1e-13, 1e-10
MOST_HALVINGS = 50


@dataclass(frozen=True)
class Interval:
    """The reference from `start` to `end`, s: coefficients (NODES, 2 n + 10) of Chebyshev polynomials."""

    start: float
    end: float
    coefficients: Array

    def at(self, t: float) -> Array:
        """Return the row of `Desired.table` (2 n + 10,) at an instant of the interval, s."""
        x = (2.0 * (t - self.start)) / (self.end - self.start) - 1.0
        # T_k(x) = cos(k arccos x); `chebval` takes ten times as long, at every evaluation.
        return np.cos(_DEGREES * math.acos(min(1.0, max(-1.0, x)))) @ self.coefficients


def interval_from(wanted: Desired, start: float, end: float) -> Interval:
    """Return the interval from `start` to `end`, s, or a shorter one on which the polynomial is accurate."""
    worst = math.inf
    for _ in range(MOST_HALVINGS):
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        values = wanted.table(middle + half * np.concatenate([_NODES, _CHECKS]))
        coefficients: Any = chebfit(_NODES, values[:NODES], NODES - 1)
        interval = Interval(start, end, coefficients)
        fitted = chebval(_CHECKS, coefficients).T
        off = float(np.max(np.abs(fitted - values[NODES:]) / (1.0 + np.abs(values[NODES:]))))
        if off <= MISFIT or (off <= ROUNDING and off > 0.5 * worst):
            break
        worst, end = off, middle
    return interval


def jumps(wanted: Desired, others: Array, rows: Array) -> Array:
    """Return the instants between which the right-hand side is smooth, s, increasing.

    `wanted`: its knots, the ends of the segments of the tip's path, and the corners of the force profile.
    `others`: further instants, s.
    `rows` (N,): instants of the recorded rows, s, the first and the last of which bound the run; a discontinuity that
        differs from one of them by rounding is set to it.
    """
    segments = [x for segment in wanted.tip.segments for x in (segment.start, segment.stop)]
    instants = np.concatenate([rows[[0, -1]], wanted.joints.times, segments, _force_jumps(wanted), others])
    instants = instants[(instants >= rows[0]) & (instants <= rows[-1])]
    nearest = rows[np.clip(np.round(instants / (rows[1] - rows[0])), 0, rows.size - 1).astype(np.int64)]
    same = np.abs(instants - nearest) <= ROUNDING * np.maximum(1.0, instants)
    instants = np.unique(np.where(same, nearest, instants))
    apart = np.diff(instants, prepend=-1.0) > ROUNDING * np.maximum(1.0, instants)
    return instants[apart]


def _force_jumps(wanted: Desired) -> list[float]:
    profile = wanted.profile
    if isinstance(profile, StepForceSection):
        return [profile.at]
    if isinstance(profile, SineForceSection):
        return [profile.start]
    if isinstance(profile, WaypointForceSection):
        return list(profile.times)
    return []
