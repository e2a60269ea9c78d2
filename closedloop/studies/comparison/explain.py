"""What explains a residual: each hypothesis is a column or several, fitted by least squares, alone and one by one.

The share that a hypothesis explains is that of the residual's sum of squares. The interval of its coefficient takes
into account that neighbouring rows of a residual are alike: N is divided by the number of rows that are alike, from the
sum of its autocorrelations (Bartlett).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array

# A hypothesis is added while it explains this share of what is left, and so much of the whole.
ENOUGH, OF_ALL = 0.2, 0.02
MOST = 4
# A residual below this share of its signal is rounding, and of the integrator.
NOTHING = 1e-7
# A hypothesis that explains all but this share of what the best one does is as good.
AS_WELL = 0.01
# A hypothesis that says the same as those before it, up to this share of its size, adds nothing.
DEPENDENT = 1e-6
# Lags of the autocorrelation that are summed, over the number of rows.
LAGS = 0.1


@dataclass(frozen=True)
class Hypothesis:
    """A reason why two signals might differ.

    Attributes
    ----------
    name, unit : str
        Of its coefficients.
    columns : (N, k) array
        What the residual would be for coefficients of 1.
    labels : sequence of str
        Of its columns, such as joints; empty for one.
    """

    name: str
    unit: str
    columns: Array
    labels: Sequence[str] = ()


@dataclass(frozen=True)
class Reason:
    """A hypothesis that explains a residual.

    Attributes
    ----------
    name, unit : str
    labels : tuple of str
    value, half : (k,) array
        Coefficients, fitted with those of all reasons, and half of their 95 % intervals.
    alone : float
        Share of the residual that it explains alone.
    left : float
        Share that is left with it and the reasons before it.
    as_well : tuple of str
        Hypotheses that explain it equally well: the log does not distinguish them.
    """

    name: str
    unit: str
    labels: tuple[str, ...]
    value: Array
    half: Array
    alone: float
    left: float
    as_well: tuple[str, ...] = ()


def explain(residual: Array, hypotheses: Sequence[Hypothesis], size: float = 0.0) -> list[Reason]:
    """Return the hypotheses that explain a residual (N,), the one that explains most of what is left first.

    `size` is the RMS of the signal: a residual that is rounding beside it needs no reason.
    """
    whole = float(residual @ residual)
    if whole <= len(residual) * (NOTHING * size) ** 2:
        return []
    alone = {h.name: 1.0 - _left(residual, [h]) / whole for h in hypotheses}
    chosen: list[Hypothesis] = []
    lefts: list[float] = []
    others: list[tuple[str, ...]] = []
    left = whole
    while len(chosen) < MOST:
        rest = {h.name: _left(residual, [*chosen, h]) for h in hypotheses if h not in chosen}
        if not rest:
            break
        best = min(rest, key=rest.__getitem__)
        if left - rest[best] < max(ENOUGH * left, OF_ALL * whole):
            break
        gained, left = left - rest[best], rest[best]
        others.append(tuple(name for name in rest if name != best and rest[name] - left < AS_WELL * gained))
        chosen.append(next(h for h in hypotheses if h.name == best))
        lefts.append(left / whole)
    if not chosen:
        return []
    value, half = _fitted(residual, chosen)
    reasons, at = [], 0
    for h, still, equal in zip(chosen, lefts, others, strict=True):
        k = h.columns.shape[1]
        reasons.append(
            Reason(
                h.name, h.unit, tuple(h.labels), value[at : at + k], half[at : at + k], alone[h.name], still, equal
            )
        )  # fmt: skip
        at += k
    return reasons


def _fitted(residual: Array, hypotheses: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """Return all coefficients, and half of their 95 % intervals."""
    A = np.concatenate([h.columns for h in hypotheses], axis=1)
    sizes = np.linalg.norm(A, axis=0)
    sizes[sizes == 0.0] = 1.0
    value, *_ = np.linalg.lstsq(A / sizes, residual, rcond=DEPENDENT)
    left = residual - (A / sizes) @ value
    variance = float(left @ left) / max(len(left) - A.shape[1], 1) * alike_rows(left)
    covariance = np.linalg.pinv((A / sizes).T @ (A / sizes), rcond=DEPENDENT)
    return value / sizes, 1.96 * np.sqrt(variance * np.diag(covariance)) / sizes


def _left(residual: Array, hypotheses: Sequence[Hypothesis]) -> float:
    """Return the sum of squares that hypotheses leave."""
    A = np.concatenate([h.columns for h in hypotheses], axis=1)
    sizes = np.linalg.norm(A, axis=0)
    A = A[:, sizes > 0.0] / sizes[sizes > 0.0]
    if not A.shape[1]:
        return float(residual @ residual)
    value, *_ = np.linalg.lstsq(A, residual, rcond=DEPENDENT)
    left = residual - A @ value
    return float(left @ left)


def alike_rows(x: Array) -> float:
    """Return how many neighbouring rows of a signal count as one: 1 if it is white."""
    centred = x - x.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return 1.0
    lags = max(1, min(int(LAGS * len(x)), len(x) - 1))
    spectrum = np.fft.rfft(centred, 2 * len(x))
    correlation = np.fft.irfft(spectrum * spectrum.conj())[: lags + 1] / power
    ends = np.flatnonzero(correlation <= 0.0)
    upto = int(ends[0]) if len(ends) else lags + 1
    return float(max(1.0, 1.0 + 2.0 * correlation[1:upto].sum()))
