"""Motion and torque from a log: zero-phase low-pass, central differences, parallel decimation.

The positions go through a Butterworth filter of order 4, forwards and backwards, and are differentiated twice by
central differences: no phase, so that the acceleration belongs to the torque of the same instant. Regressor and torque
are then averaged over the same windows ("parallel decimation": what the one loses the other loses too), one after the
other, so that white noise of the torque stays white. Sources: M. Gautier, Dynamic identification of robots with power
model, ICRA 1997; A. Janot, P.-O. Vandanjon, M. Gautier, A generic instrumental variable approach for industrial robot
identification, IEEE Trans. Control Systems Technology 22 (2014) 132-145.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal, stats
from scipy.interpolate import Akima1DInterpolator, CubicSpline

from closedloop.base.arrays import Array
from closedloop.studies.identify.log import Log, LogError

# Rows at which the regressor is evaluated, at most; a longer log is evaluated at every third, fifth ... row.
EVALUATIONS = 240_000
# Averages that are kept, at most.
WINDOWS = 24_000
# The cutoff over the frequency below which the motion has 99 % of its velocity.
ABOVE_MOTION = 10.0
# Joints slower than this share of the fastest (RMS) do not count for the cutoff.
MOVES = 0.02
# The probability with which noise alone has so much power at a frequency that it counts as motion.
NOISE_ONLY = 1e-6
# A change of a position below this share of it is rounding, and no count of an encoder.
ROUNDING = 1e-9
# Of changes by less than so many counts more than this share are whole multiples of one, to this share of it.
FEW, MOSTLY, NEARLY = 5.5, 0.9, 0.1
# Changes of a count that tell the position between them.
FEWEST_CHANGES = 4


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the regressor is evaluated, and the torque of each window."""

    # q, v, a (R D, n): positions, velocities and accelerations, D rows a window
    q: Array
    v: Array
    a: Array
    time: Array  # (R,): middle of each window, s
    torque: Array  # (R, n): mean over the window, N m
    size: int  # D
    noise: Array  # (n,): standard deviation of the noise of `v`, rad/s, from that of the positions, or their counts
    torque_noise: Array  # (n,): standard deviation of the noise of `torque`, N m, if it is white
    cutoff: float  # of the low-pass, Hz


def joined(motions: Sequence[Motion]) -> Motion:
    """Return several motions as one, one after the other in time."""
    if len(motions) == 1:
        return motions[0]
    if len({x.size for x in motions}) > 1:
        raise LogError("the logs have different rates: resample them to the same one")
    shift, times = 0.0, []
    for x in motions:
        times.append(x.time - x.time[0] + shift)
        shift = times[-1][-1] + (x.time[1] - x.time[0])
    q, v, a, torque = (np.concatenate([getattr(x, name) for x in motions]) for name in ("q", "v", "a", "torque"))
    noise, torque_noise = (np.max([getattr(x, name) for x in motions], axis=0) for name in ("noise", "torque_noise"))
    return Motion(q, v, a, np.concatenate(times), torque, motions[0].size, noise, torque_noise, motions[0].cutoff)


def white_noise(x: Array) -> Array:
    """Return the standard deviation of the white noise in each column, (n,), from its fourth differences."""
    # The coefficients 1 -4 6 -4 1 have the sum of squares 70.
    return np.median(np.abs(np.diff(x, 4, axis=0)), axis=0) / (0.6745 * np.sqrt(70.0))


def count_of(x: Array) -> Array:
    """Return each column's size of a count, (n,): its least change if rows repeat and all are multiples; else 0."""
    steps = np.abs(np.diff(x, axis=0))
    repeated = (steps == 0.0).any(axis=0)
    steps[steps <= ROUNDING * np.abs(x).max(axis=0)] = np.inf
    least = steps.min(axis=0)
    counts = repeated & np.isfinite(least)
    for j in np.flatnonzero(counts):
        few = steps[steps[:, j] < FEW * least[j], j] / least[j]
        counts[j] = np.mean(np.abs(few - np.round(few)) < NEARLY) > MOSTLY
    return np.where(counts, least, 0.0)


def between_counts(q: Array) -> Array:
    """Return positions (N, n) that encoders count, with those between two counts where there are counts.

    Two rows between which the count changes tell the position to the way of one row; between such instants Akima's
    cubics do, within half a count: where a joint is slow the error of a count is no white noise.
    """
    found = np.array(q)
    for j, count in enumerate(count_of(q)):
        before = np.flatnonzero(np.diff(q[:, j]))
        if count == 0.0 or len(before) < FEWEST_CHANGES:
            continue
        changes = Akima1DInterpolator(before + 0.5, 0.5 * (q[before, j] + q[before + 1, j]))
        rows = np.arange(before[0] + 1, before[-1] + 1)
        half = 0.5 * count
        found[rows, j] = np.clip(changes(rows), q[rows, j] - half, q[rows, j] + half)
    return found


def low_passed(q: Array, cutoff: float, step: float) -> Array:
    """Return columns (N, n) without what is above the cutoff, Hz, and without lag."""
    return np.asarray(signal.sosfiltfilt(signal.butter(4, 2.0 * cutoff * step, output="sos"), q, axis=0))


def counted_from_elsewhere(q: Array, size: Array, draw: np.random.Generator) -> Array:
    """Return positions (N, n) as encoders of this size of a count (n,) have them, 0 for none, with counts that begin
    anywhere."""
    begin, unit = draw.uniform(size=len(size)) * size, np.where(size > 0.0, size, 1.0)
    return np.where(size > 0.0, np.round((q + begin) / unit) * unit - begin, q)


def half_of(q: Array, k: int) -> Array:
    """Return positions (N, n) of every other row, from row k on, with those of the rows between from a cubic."""
    known = np.arange(k, len(q), 2)
    return np.asarray(CubicSpline(known, between_counts(q[known]), axis=0)(np.arange(len(q))))


def usual_cutoff(log: Log) -> float:
    """Return a cutoff, Hz: ten times the frequency below which 99 % of the joints' squared velocity lies."""
    step = log.step
    rate = np.gradient(log.q, step, axis=0)
    segment = min(len(rate), max(256, round(4.0 / step)))
    f, power = signal.welch(rate, 1.0 / step, nperseg=segment, axis=0)
    # Of noise of the positions the power of the velocity grows with f²: it is taken off, and what noise may be is not
    # counted, as little of it at high frequencies would be more than the motion.
    counted = np.maximum(white_noise(log.q), count_of(log.q) / np.sqrt(12.0))
    noise = 2.0 * step * counted**2 * (2.0 * np.pi * f[:, None]) ** 2
    degrees = 2.0 * max(1.0, 2.0 * len(rate) / segment - 1.0)
    power = np.where(power > stats.chi2.isf(NOISE_ONLY, degrees) / degrees * noise, power - noise, 0.0)
    whole = power.sum(axis=0)
    share = np.cumsum(power, axis=0) / np.maximum(whole, 1e-300)
    moves = whole > MOVES**2 * whole.max()
    at = [min(int(np.searchsorted(share[:, j], 0.99)), len(f) - 1) for j in np.flatnonzero(moves)]
    highest = float(f[max(at, default=0)])
    return float(min(ABOVE_MOTION * max(highest, f[1]), 0.2 / step))


def speed_noise(log: Log, cutoff: float) -> Array:
    """Return the standard deviation (n,) of a log's filtered speeds, rad/s (m/s), by noise and counts of q."""
    white = 2.0 * np.pi * white_noise(log.q) * np.sqrt(2.0 * log.step * cutoff**3 / 3.0)
    return np.asarray(np.maximum(white, count_of(log.q) * cutoff))


def motion(log: Log, cutoff: float, half: int | None = None) -> Motion:
    """Return the motion and the torques of a log, low-passed at `cutoff`, Hz, in windows of half its period.

    `half`: every other row of positions from this one on is used, so that two motions have noise that is independent.
    """
    step, N = log.step, len(log.time)
    if not 0.0 < cutoff < 0.5 / step:
        raise LogError(
            f"{log.source}: cutoff is {cutoff:.6g} Hz: it must be above 0 and below half the rate, {0.5 / step:.6g} Hz"
        )
    window = max(1, round(0.5 / (cutoff * step)))
    window = max(window, -(-N // WINDOWS))
    stride = max(1, -(-N // EVALUATIONS))
    stride += 1 - stride % 2  # odd: the evaluation is in the middle of the rows that it stands for
    size = max(1, round(window / stride))
    edge = min(round(2.0 / (cutoff * step)), N // 10)
    count = (N - 2 * edge) // (stride * size)
    if count < 50:
        raise LogError(
            f"{log.source}: {N} rows are {max(count, 0)} windows of {size * stride} at a cutoff of {cutoff:.4g} Hz: "
            "50 are needed; take a longer log, or a higher cutoff"
        )
    q = between_counts(log.q) if half is None else half_of(log.q, half)
    filtered = low_passed(q, cutoff, step)
    v = np.gradient(filtered, step, axis=0)
    a = np.gradient(v, step, axis=0)
    at = edge + (stride - 1) // 2 + stride * np.arange(count * size)
    used = slice(edge, edge + count * size * stride)
    averaged = (count, size * stride)
    return Motion(
        filtered[at], v[at], a[at],
        log.time[used].reshape(averaged).mean(axis=1),
        log.torque[used].reshape(*averaged, -1).mean(axis=1),
        size, speed_noise(log, cutoff), white_noise(log.torque) / np.sqrt(size * stride), cutoff,
    )  # fmt: skip
