"""The first instant at which an event function falls below zero within a step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq, minimize_scalar

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

    Parameters
    ----------
    event_function : callable
        Not negative at 0 but for rounding.
    length : float
        Of the step.
    floor : float
        A value no further than this below zero is rounding.
    rate : callable, optional
        Derivative of the event function. With it a minimum between two samples is found, and a rise from zero that
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
