"""Derivatives at the state of an instant, by central differences of the kernels of its run."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from closedloop.base.arrays import Array
from closedloop.studies.analysis.here import EventHere, Here

# Two steps whose differences are further apart than this share, at the best, show a function that has no derivative: of
# those that have one they are nearer than a millionth. A first step whose differences are so near is short enough.
KINK, NEAR = 1e-2, 1e-6
# The most steps that are tried.
MOST = 7


def columns(here: Here, name: str, steps: Array, held: bool) -> dict[str, Array]:
    """Return the derivatives of all that `Here` evaluates by the numbers of a change, matrices (rows, k).

    Central differences at a step and at half of it cancel the error of second order (Richardson's extrapolation). Where
    the two are far apart, as over a change of the contact's mode, the step of that number is a tenth of it; the best of
    `MOST` steps is taken.

    Parameters
    ----------
    here, name, held
        Where, the change, and whether the torque is held; see `Here.flat`.
    steps : (k,) array
        The first step of each number.

    Raises
    ------
    EventHere
        If no step stays clear of a change of mode, or there is no derivative.
    """
    value, k = here.flat(held), steps.size
    best, least = np.empty((k, value.size)), np.full(k, np.inf)
    change, step, left = np.zeros(k), steps.astype(float), np.arange(k)

    def at(j: int, amount: float) -> Array:
        change[j] = amount
        try:
            return here.flat(held, **{name: change})
        finally:
            change[j] = 0.0

    for _ in range(MOST):
        ends, tried = [], []
        for j in left.tolist():
            with suppress(EventHere):
                ends.append([at(j, share * step[j]) for share in (1.0, -1.0, 0.5, -0.5)])
                tried.append(j)
        if tried:
            four, size = np.array(ends), step[tried][:, None]
            wide, near = (four[:, 0] - four[:, 1]) / (2.0 * size), (four[:, 2] - four[:, 3]) / size
            apart = _apart(here, value, wide, near, size)
            for i in np.flatnonzero(apart < least[tried]):
                best[tried[i]], least[tried[i]] = (4.0 * near[i] - wide[i]) / 3.0, apart[i]
        left = left[least[left] >= NEAR]
        if not left.size:
            break
        step[left] *= 0.1
    if np.any(least > KINK):
        raise EventHere
    return {key: best[:, where].T for key, where in here.places.items()}


def _apart(here: Here, value: Array, wide: Array, near: Array, step: Array) -> Array:
    """Return how far two differences (k, ...) are apart, (k,): the most of all that is evaluated, each by its size.

    Parameters
    ----------
    value : array
        What is evaluated without a change: its size decides what is rounding.
    wide, near : (k, ...) arrays
        The differences.
    step : (k, 1) array
        The step of the wide ones.
    """
    firsts = [where.start for where in here.places.values() if where.stop > where.start]

    def largest(x: Array) -> Array:
        return np.asarray(np.maximum.reduceat(np.abs(x), firsts, axis=-1))

    rounding = 1e-12 * (largest(value) + 1e-3) / step
    return np.max(largest(near - wide) / (largest(near) + rounding / 1e-7 + 1e-300), axis=1)
