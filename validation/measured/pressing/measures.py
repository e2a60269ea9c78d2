"""Figures of a force that comes down, swings and settles, of measured and of simulated ones alike."""

from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array

STEP = 8e-4  # s, between two samples of the force
FIRST = 0.06  # s: the first peak is the largest force until then
SMOOTH, SHORT = 0.02, 0.004  # s: means for swing and settling, and for losses of contact
LOST, LEAST = 3.0, 0.01  # N: below it there is no contact; s: shorter losses do not count
SWING = (0.1, 1.3)  # s, in which the swing is looked at
BAND = (0.8, 40.0)  # Hz, in which its frequency is sought
# Settled within the larger of 5 N and 10 % of the commanded force. The published definition is the same, the time after
# which the force stays within a band about the commanded one; the width of the band is ours.
WITHIN, SHARE = 5.0, 0.1
LAST = 1.5  # s at the end, of mean and deviation: where the force hunts, it does so more slowly than 1 Hz


class Figures(NamedTuple):
    """What a force does: N, s and Hz; `settling` is the whole time where it does not settle."""

    peak: float
    losses: int
    lost: float  # s without contact, of all losses
    frequency: float  # of the largest line in the spectrum of the swing
    decay: float  # 1/s, of the amplitude of the swing
    settling: float
    mean: float
    deviation: float


def smoothed(force: Array, span: float) -> Array:
    """Return the moving mean over a span, s."""
    count = max(1, round(span / STEP))
    return np.convolve(force, np.full(count, 1.0 / count), "same")


def figures(time: Array, force: Array, commanded: float, rest: float) -> Figures:
    """Return the figures of a force (N,), N, at times (N,), s, 0 at first contact, until `rest`, s."""
    t = np.arange(0.0, rest, STEP)
    f = np.interp(t, time, force)
    mean, short = smoothed(f, SMOOTH), smoothed(f, SHORT)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], ((short < LOST) & (t > LEAST)).astype(int), [0]])))
    losses = [STEP * (b - a) for a, b in zip(ends[::2], ends[1::2], strict=True) if STEP * (b - a) > LEAST]
    inner = (t > SMOOTH) & (t < rest - SMOOTH)
    outside = np.flatnonzero((np.abs(mean - commanded) > max(WITHIN, SHARE * commanded)) & inner)
    swing = (mean - commanded)[(t > SWING[0]) & (t < SWING[1])]
    # The mean under the window is taken away: of any other mean the window makes a line at 0 Hz, which is wider than
    # the band is far from it.
    window = np.hanning(len(swing))
    swing -= np.average(swing, weights=window)
    lines = np.abs(np.fft.rfft(swing * window, 2**15))
    at = np.fft.rfftfreq(2**15, STEP)
    seen = (at > BAND[0]) & (at < BAND[1])
    half = len(swing) // 2
    sizes = [float(np.sqrt(np.mean(part * part))) for part in (swing[:half], swing[half:])]
    last = f[t > rest - LAST]
    return Figures(
        float(f[t < FIRST].max()), len(losses), float(sum(losses)), float(at[seen][np.argmax(lines[seen])]),
        float(np.log(max(sizes[0], 1e-9) / max(sizes[1], 1e-9)) / (half * STEP)),
        float(t[outside[-1]]) if len(outside) else 0.0, float(last.mean()), float(last.std()),
    )  # fmt: skip
