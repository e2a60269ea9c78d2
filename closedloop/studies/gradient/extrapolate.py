"""Derivatives from differences, by Richardson's extrapolation, each with an estimate of its error.

Three steps h, h/2, h/4 on either side. Central differences have errors in h², h⁴ ..., one-sided ones in h, h², h³ ...;
the extrapolation removes all but the last. The estimate is by how much the last extrapolation changed the result. It is
that of the result before, so it is on the safe side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array

# Steps of one table, each half of the one before.
LEVELS = 3
# Two one-sided derivatives that differ by more than this share of the larger are of a kink, if it is also more than
# `SURE` times what their errors explain.
KINK, SURE = 1e-3, 20.0
# What a difference cannot see of a run's values, as a share of them: rounding, and with events that their instants are
# located to some 1e-12 s.
ROUNDING, LOCATED = 16.0 * np.finfo(float).eps, 1e3 * np.finfo(float).eps


@dataclass(frozen=True)
class Estimate:
    """Derivatives of M quantities along one direction.

    Attributes
    ----------
    value, error : (M,) array
        The derivative, and the estimate of its error.
    below, above : (M,) array
        One-sided ones; NaN on a side that there is not.
    kink : (M,) array of bool
        Whether they differ.
    """

    value: Array
    error: Array
    below: Array
    above: Array
    kink: NDArray[np.bool_]


def two_sided(h: float, at: Array, minus: Array, plus: Array, scatter: Array | None = None) -> Estimate:
    """Return the derivatives from values at 0, (M,), and at −h, −h/2, −h/4 and h, h/2, h/4, (3, M).

    The values scatter by `scatter`, (M,), and by `ROUNDING` of themselves if it is left out.
    """
    steps = h * 0.5 ** np.arange(LEVELS)[:, None]
    value, error = _extrapolated((plus - minus) / (2.0 * steps), 2)
    scatter = ROUNDING * np.abs(at) if scatter is None else scatter
    below, off_below = one_sided(-h, at, minus, scatter)
    above, off_above = one_sided(h, at, plus, scatter)
    apart = np.abs(above - below)
    kink = (apart > SURE * (off_below + off_above)) & (apart > KINK * np.maximum(np.abs(above), np.abs(below)))
    return Estimate(value, error + floor(h, scatter), below, above, kink)


def one_sided(h: float, at: Array, beside: Array, scatter: Array) -> tuple[Array, Array]:
    """Return the derivatives on the side of h, which may be negative, and the estimates of their errors, (M,)."""
    steps = h * 0.5 ** np.arange(LEVELS)[:, None]
    value, error = _extrapolated((beside - at) / steps, 1)
    return value, error + 2.0 * floor(h, scatter)


def floor(h: float, scatter: Array) -> Array:
    """Return what the scatter of the values alone makes of the smallest difference."""
    return scatter / (abs(h) * 0.5 ** (LEVELS - 1))


def _extrapolated(differences: Array, order: int) -> tuple[Array, Array]:
    """Return the limit of (3, M) differences whose errors have the powers order, 2 order ... of the step."""
    table = differences
    for k in range(1, LEVELS):
        before = table[-1]
        factor = 2.0 ** (order * k)
        table = (factor * table[1:] - table[:-1]) / (factor - 1.0)
    return table[0], np.abs(table[0] - before)
