"""One part of what is found of a contact: linear in its parameters, with intervals, and what it misses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.studies.identify.fit import Fit, fit, whiteness
from closedloop.studies.identify.identify import WHITENESS_LEVEL, Estimate

# Windows that a fit needs.
FEWEST = 20
# A term that the model has not is missed if it is so many deviations from 0 and takes this share of the residual's RMS.
SURE, GAINED = 5.0, 0.01
# A residual that is not white counts if it is above the noise of the log by this factor, and this share of the signal.
ABOVE, MATTERS = 1.3, 2e-3


@dataclass
class Part:
    """Parameters of one law, of a log."""

    what: str  # of the axis of a figure
    estimates: list[Estimate] = field(default_factory=list)
    misses: list[str] = field(default_factory=list)  # effects that the law does not have, in words
    # time, measured, predicted (R,): of the windows that were used; empty if there are none
    time: Array = field(default_factory=lambda: np.zeros(0))
    measured: Array = field(default_factory=lambda: np.zeros(0))
    predicted: Array = field(default_factory=lambda: np.zeros(0))


def unknown(name: str, unit: str, why: str, low: float = -np.inf) -> Estimate:
    """Return a parameter that the log does not tell."""
    return Estimate(name, np.nan, low, np.inf, unit, name, why)


def known(name: str, value: float, deviation: float, unit: str, z: float, grouping: str = "") -> Estimate:
    """Return a parameter with its interval."""
    return Estimate(name, value, value - z * deviation, value + z * deviation, unit, grouping or name, "")


def one(W: Array, y: Array, used: Mask, Z: Array | None = None) -> Fit:
    """Fit y (R,) by columns W (R, b), with instruments Z (R, b)."""
    return fit(W[:, None, :], y[:, None], used[:, None], None if Z is None else Z[:, None, :])


def missed(
    W: Array, y: Array, used: Mask, Z: Array | None, extra: Mapping[str, Array], found: Fit, noise: float
) -> list[str]:
    """Return the column of `extra` (R,) that a law lacks; or that its residual is not white, if none of them helps.

    `noise` is the standard deviation that the residual has from the noise of the log.
    """
    names = []
    for name, column in extra.items():
        wider = np.column_stack([W, column])
        more = one(wider, y, used, None if Z is None else np.column_stack([Z, column]))
        sure = more.told[-1] and abs(more.value[-1]) > SURE * more.deviation[-1]
        if sure and more.sigma[0] < (1.0 - GAINED) * found.sigma[0]:
            names.append((float(more.sigma[0]), name))
    if names:
        return [min(names)[1]]
    size = float(np.sqrt(np.mean(y[used] ** 2)))
    matters = found.sigma[0] > max(ABOVE * noise, MATTERS * size)
    if matters and whiteness(found.residual, used[:, None])[0] < WHITENESS_LEVEL:
        return ["something: the residual is not white"]
    return []


def spread(values: Callable[[Array], Array], at: Array, covariance: Array) -> Array:
    """Return the covariance that values of nuisance parameters `at` (m,) with a covariance (m, m) have because of it.

    The values are differentiated by central differences of one deviation.
    """
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    slopes = [
        (values(at + s * e) - values(at - s * e)) / (2.0 * s) if s > 0.0 else np.zeros_like(values(at))
        for s, e in zip(size, np.eye(len(at)), strict=True)
    ]
    J = np.stack(slopes, axis=1)
    return np.asarray(J @ covariance @ J.T)
