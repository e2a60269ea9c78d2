"""Time scaling of a motion: at constant speed, or from rest to rest with minimum jerk.

A timing maps the time t after the start of a motion of T seconds to the path parameter s and its derivatives ṡ and s̈;
s, in seconds, is the time at which a motion at constant speed would be at the same point. So s runs from 0 to T, and ṡ
is the speed as a multiple of the mean speed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from closedloop.base.arrays import Array

Timing = Callable[[Array, float], tuple[Array, Array, Array]]


def constant(t: Array, duration: float) -> tuple[Array, Array, Array]:
    """Return s, s, ṡ and s̈, 1/s, each (N,), of constant speed at times t (N,), s, after the start: s = t."""
    return t, np.ones_like(t), np.zeros_like(t)


def minimum_jerk(t: Array, duration: float) -> tuple[Array, Array, Array]:
    """Return s, s, ṡ and s̈, 1/s, each (N,), of least jerk at times t (N,), s, after the start.

    With τ = t/T: s = T (10 τ³ − 15 τ⁴ + 6 τ⁵). Speed and acceleration are zero at both ends, and among all motions
    that begin and end so, the integral of the squared jerk is the smallest (Flash and Hogan, J. Neuroscience 5, 1985).
    Outside the motion it is at rest.
    """
    x = np.clip(t / duration, 0.0, 1.0)
    rest = 1.0 - x
    place = x**3 * (10.0 + x * (6.0 * x - 15.0))
    return duration * place, 30.0 * (x * rest) ** 2, 60.0 * x * rest * (rest - x) / duration
