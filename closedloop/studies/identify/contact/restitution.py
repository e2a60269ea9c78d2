"""Restitution from the heights of a tip that bounces: e = −(rate after)/(rate before) of each impact.

An impact is a kink of n·r. A cubic through the rows on either side gives both rates at the instant where they meet,
with their noise. The coefficient is that of all impacts by least squares, v⁺ = −e v⁻, less what the noise of v⁻ takes
from it; its interval comes from how much the impacts scatter, or from the noise if that is more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from closedloop.base.arrays import Array
from closedloop.studies.identify.contact.found import Part, unknown
from closedloop.studies.identify.identify import Estimate
from closedloop.studies.identify.motion import white_noise

# Coefficients (4,) of cubics through more and more rows, with their covariances.
Cubics = list[tuple[Array, Array]]

# Rows of a cubic. More of them may change the rates by so many deviations: the median over the impacts, and one.
LENGTHS, AGREE, AT_MOST = (8, 11, 15, 20, 27, 36, 48, 64), 0.5, 3.0
# Rows beside the impact that belong to neither side.
FEWEST, GUARD = LENGTHS[0], 2
# A kink is a change of the rate of so many deviations; half the rows have to find this share of it.
SURE, SHARP = 12.0, 0.8
# Impacts that a dependence on the speed needs, how sure it has to be, and how much of e at least.
IMPACTS, LIKELY, MATTERS = 5, 4.0, 0.02


@dataclass(frozen=True)
class Impact:
    """One impact.

    Attributes
    ----------
    time : float
        s.
    before, after : float
        Rate of n·r, m/s; negative before.
    noise : float
        Standard deviation of each, m/s.
    """

    time: float
    before: float
    after: float
    noise: float


def impacts_of(time: Array, height: Array) -> list[Impact]:
    """Return the impacts of a tip whose heights, m, are known at evenly spaced times."""
    step = float((time[-1] - time[0]) / (len(time) - 1))
    sigma = max(float(white_noise(height[:, None])[0]), 1e-12 * max(1.0, float(np.abs(height).max())))
    m = FEWEST
    slopes, half = _kinks(height, m, step), _kinks(height, m // 2, step)
    rate_noise = sigma * np.sqrt(12.0 / m**3) / step
    found = []
    jump = slopes[1] - slopes[0]
    sharp = (half[1] - half[0]) > SHARP * jump
    candidates = np.flatnonzero((jump > SURE * rate_noise) & sharp & (slopes[0] < 0.0) & (slopes[1] > 0.0))
    places: list[int] = []
    for k in candidates[np.argsort(-jump[candidates])]:
        if all(abs(int(k) - other) > 2 * m for other in places):
            places.append(int(k))
    places.sort()
    ends = [-1, *places, len(height)]
    sides: tuple[list[Cubics], list[Cubics]] = ([], [])
    used = []
    for first, k, last in zip(ends, places, ends[2:], strict=False):
        left = np.arange(k - GUARD, max(first + GUARD, k - GUARD - LENGTHS[-1]), -1)
        right = np.arange(k + GUARD, min(last - GUARD, k + GUARD + LENGTHS[-1]))
        if min(len(left), len(right)) >= FEWEST:
            used.append(k)
            for side, rows in zip(sides, (left, right), strict=True):
                side.append(_cubics(time[rows] - time[k], height[rows], sigma))
    most = [_longest(side) for side in sides]
    for at, k in enumerate(used):
        one = _impact(
            float(time[k]),
            step,
            [side[at][min(count, _own(side[at])) - 1] for side, count in zip(sides, most, strict=True)],
        )
        if one is not None:
            found.append(one)
    return found


def _kinks(height: Array, m: int, step: float) -> Array:
    """Return slopes (2, N) of lines through the m rows up to, and from, each row."""
    weights = 12.0 * (np.arange(m) - 0.5 * (m - 1)) / (m * (m * m - 1.0) * step)
    slope = np.correlate(height, weights, mode="valid")  # of rows k ... k + m - 1
    before, after = np.zeros((2, len(height)))
    before[m - 1 :] = slope
    after[: len(slope)] = slope
    return np.stack([before, after])


def _cubics(t: Array, height: Array, sigma: float) -> Cubics:
    """Return the coefficients of cubics through the first 8, 11 ... rows, and their covariances."""
    found: Cubics = []
    for count in [m for m in LENGTHS if m <= len(t)]:
        A = np.stack([t[:count] ** p for p in range(4)], axis=1)
        value = np.asarray(np.linalg.lstsq(A, height[:count], rcond=None)[0], dtype=np.float64)
        found.append((value, np.asarray(sigma**2 * np.linalg.inv(A.T @ A), dtype=np.float64)))
    return found


def _longest(side: list[Cubics]) -> int:
    """Return how many of `LENGTHS` are good on one side of all impacts.

    More rows are taken while the rates that they give are those of fewer, but for their noise: what a cubic lacks must
    stay below noise (O. Lepski, Theory of Probability and its Applications 35 (1990) 454-466).
    """
    for longer in range(1, len(LENGTHS)):
        for shorter in range(longer):
            z = np.array([_change(x, shorter, longer) for x in side if len(x) > longer])
            if len(z) and abs(np.median(z)) > AGREE:
                return longer
    return len(LENGTHS)


def _own(cubics: Cubics) -> int:
    """Return how many of `LENGTHS` are good on one side of one impact: before the next thing happens."""
    for longer in range(1, len(cubics)):
        if any(abs(_change(cubics, shorter, longer)) > AT_MOST for shorter in range(longer)):
            return longer
    return len(cubics)


def _change(cubics: Cubics, shorter: int, longer: int) -> float:
    """Return by how many deviations more rows change the rate."""
    (x, covariance), (y, _) = cubics[shorter], cubics[longer]
    return float((y[1] - x[1]) / np.sqrt(covariance[1, 1]))


def _impact(time: float, step: float, fits: list[tuple[Array, Array]]) -> Impact | None:
    """Return the impact where both cubics, of time since a row at `time`, meet, next to the row."""
    roots = np.roots((fits[1][0] - fits[0][0])[::-1])
    real = roots[np.abs(roots.imag) < 1e-9].real
    if not len(real):
        return None
    at = float(real[np.abs(real).argmin()])
    if abs(at) > 2.0 * step * (GUARD + 1):
        return None
    row = np.array([0.0, 1.0, 2.0 * at, 3.0 * at * at])
    before, after = (float(row @ value) for value, _ in fits)
    noise = float(np.sqrt(max(row @ covariance @ row for _, covariance in fits)))
    if before >= -SURE * noise:
        return None
    return Impact(time + at, before, after, noise)


def restitution_of(time: Array, height: Array, confidence: float) -> Part:
    """Return the coefficient of restitution of the impacts in a log."""
    part = Part("rate after an impact, m/s")
    impacts = impacts_of(time, height)
    if not impacts:
        why = "no impact is seen: let the tip fall on the surface, and bounce, several times"
        part.estimates = [unknown("restitution", "1", why)]
        return part
    v, w, noise = (np.array([getattr(x, name) for x in impacts]) for name in ("before", "after", "noise"))
    weight = 1.0 / noise**2 if noise.min() > 0.0 else np.ones(len(v))
    square = float((weight * v * v).sum())
    e = -float((weight * v * w).sum()) / (square - len(v))
    left = w + e * v
    by_noise = np.sqrt((1.0 + e * e) / square)
    scatter = np.sqrt(float((weight**2 * v**2 * left**2).sum()) * len(v) / max(len(v) - 1, 1)) / square
    half = float(stats.norm.ppf(0.5 + 0.5 * confidence)) * by_noise
    if len(v) > 1:
        half = max(half, float(stats.t.ppf(0.5 + 0.5 * confidence, len(v) - 1)) * scatter)
    part.estimates = [Estimate("restitution", e, e - half, e + half, "1", f"restitution, {len(v)} impacts", "")]
    part.time, part.measured, part.predicted = np.array([x.time for x in impacts]), w, -e * v
    if len(v) >= IMPACTS:
        A = np.column_stack([v, v * v]) / noise[:, None]
        value, *_ = np.linalg.lstsq(A, w / noise, rcond=None)
        rest = w / noise - A @ value
        variance = max(1.0, float(rest @ rest) / (len(v) - 2)) * np.linalg.inv(A.T @ A)[1, 1]
        if abs(value[1]) > LIKELY * np.sqrt(variance) and abs(value[1]) * np.ptp(v) > MATTERS * e:
            part.misses = ["restitution: it depends on the speed of the impact"]
    return part
