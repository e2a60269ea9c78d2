"""The measured touchdowns: a file of arrays TEST/SIGNAL, each (2, N), time in s and value.

TEST is PLACE_F*_g*_v*: where it comes down, the commanded force in N, the gain scaling of the force mode, and the speed
that the program has, m/s. Time is 0 at the first contact.

Figures of a force that comes down, swings and settles, of measured and of simulated ones alike.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.base.files import reason_of

# How long the tool rests after the first contact, s, before it slides or leaves; how fast it may come down, m/s, where
# that is not the speed of the name.
REST = {"direct": 5.0, "straight": 3.2, "ramp": 3.2}
DOWN = {"straight": 0.25}
NAME = re.compile(r"(?P<place>[a-z]+)_F(?P<force>[\d.]+)_g(?P<gain>[\d.]+)_v(?P<speed>[\d.]+)")
# The speed before the contact is the mean over this time, s.
BEFORE = (-0.03, -0.004)


@dataclass(frozen=True, eq=False)
class Touchdown:
    """A test: what was commanded, and what was measured.

    force: commanded, N
    gain, limit: gain scaling and speed limit, m/s, of the force mode
    speed: with which it comes to the surface, measured, m/s
    rest: time from the first contact to the end of what is compared, s
    time, measured: (N,), s, and the force at the sensor under the surface, N
    desired: (2, M), s, and the size of the speed that the force mode asks for, m/s, as its controller logs it
    """

    name: str
    place: str
    force: float
    gain: float
    limit: float
    speed: float
    rest: float
    time: Array
    measured: Array
    desired: Array | None = None


def read(path: Path) -> list[Touchdown]:
    """Return the tests of a file, by name.

    Raises `ModelError` if it cannot be read, or an array is missing or has another shape.
    """
    try:
        with np.load(path) as found:
            arrays = {key: np.asarray(found[key], dtype=np.float64) for key in found}
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ValueError, EOFError, BadZipFile, AttributeError):
        raise ModelError(f"{path}: is no .npz file of numbers, as numpy.savez writes it") from None
    names = sorted({key.rpartition("/")[0] for key in arrays})
    if not names:
        raise ModelError(f"{path}: has no test; arrays are called TEST/force_measured and TEST/speed_measured")
    return [_touchdown(path, name, arrays) for name in names]


def _touchdown(path: Path, name: str, arrays: dict[str, Array]) -> Touchdown:
    said = NAME.fullmatch(name)
    if said is None or said["place"] not in REST:
        raise ModelError(
            f"{path}: test {name!r}: must be PLACE_F*_g*_v*, such as direct_F100_g0.5_v0.10, with PLACE one of "
            f"{', '.join(REST)}"
        )
    series = []
    for signal in ("force_measured", "speed_measured", "speed_desired"):
        one = arrays.get(f"{name}/{signal}")
        if one is None and signal == "speed_desired":
            continue
        if one is None or one.ndim != 2 or len(one) != 2 or not np.all(np.isfinite(one)):
            raise ModelError(f"{path}: {name}/{signal}: must be (2, N), time in s and finite values")
        series.append(one)
    (time, force), (at, speed), *desired = series
    place, rest = said["place"], REST[said["place"]]
    if not (np.all(np.diff(time) > 0.0) and time[0] <= 0.0 and time[-1] >= rest):
        raise ModelError(f"{path}: {name}/force_measured: its time must rise, from 0 or before to {rest:g} s or later")
    before = speed[(at >= BEFORE[0]) & (at <= BEFORE[1])]
    if not (len(before) and before.mean() > 0.0):
        raise ModelError(f"{path}: {name}/speed_measured: has no speed above 0 in the {-BEFORE[0]:g} s before contact")
    limit = DOWN.get(place, float(said["speed"]))
    return Touchdown(
        name, place, float(said["force"]), float(said["gain"]), limit, float(before.mean()), rest, time, force, *desired
    )


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
