"""A path of the tip: consecutive segments of smooth motion, at rest before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.curves import Curve
from closedloop.control.reference.timing import Timing

# i·h and the instant of a jump may differ by rounding: this share of a path's duration later is the instant itself.
INSTANT = 1e-9


@dataclass(frozen=True)
class Segment:
    """A smooth motion of the tip between two instants.

    Attributes
    ----------
    start, stop : float
        Instants, s.
    origin : (3,) array
        Position of the tip at `start`, m, base frame.
    curve, timing : Curve, Timing
        The curve from there, and its time scaling.
    length : float
        Arc length, m, about: it sets the first spacing of knots of the inverse kinematics.
    """

    start: float
    stop: float
    origin: Array
    curve: Curve
    timing: Timing
    length: float

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return r, ṙ and r̈ as `TipPath.sample` does, at times t (N,) within the segment, both ends included."""
        s, ds, dds = (x[:, None] for x in self.timing(t - self.start, self.stop - self.start))
        x, slope, bend = self.curve(s[:, 0])
        return self.origin + x, slope * ds, bend * ds**2 + slope * dds


@dataclass(frozen=True)
class TipPath:
    """The desired tip position as a function of time.

    Attributes
    ----------
    origin : (3,) array
        Position of the tip before the first segment, m, base frame.
    segments : tuple of Segment
        Each begins when and where the one before ends; none: the tip stays.
    keys : tuple of str
        Keys of the scenario that set how far the path goes, for messages.
    begins : float, optional
        Instant at which it begins to move along the surface, s, if that is not when its first segment begins.
    """

    origin: Array
    segments: tuple[Segment, ...] = ()
    keys: tuple[str, ...] = ()
    begins: float | None = None

    @property
    def start(self) -> float:
        """Instant at which the tip begins to move, s; 0 if it never does."""
        if self.begins is not None:
            return self.begins
        return self.segments[0].start if self.segments else 0.0

    @property
    def length(self) -> float:
        """Arc length, m."""
        return sum(segment.length for segment in self.segments)

    def instants(self, count: int) -> Array:
        """Return instants, s, in order: the ends of its segments and `count` from the first of them to the last."""
        ends = [instant for segment in self.segments for instant in (segment.start, segment.stop)]
        return np.unique([*ends, *np.linspace(min(ends), max(ends), count)])

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return r, m, ṙ, m/s, and r̈, m/s², each (N, 3), base frame, at times t (N,), s.

        At a discontinuity velocity and acceleration have their right limits; a jump of the velocity does not enter r̈.
        """
        t = np.asarray(t, dtype=np.float64)
        r = np.tile(self.origin, (t.size, 1))
        velocity, acceleration = np.zeros_like(r), np.zeros_like(r)
        if not self.segments:
            return r, velocity, acceleration
        last = self.segments[-1]
        ends = np.array([self.segments[0].start, *(segment.stop for segment in self.segments)])
        at = np.searchsorted(ends, t + INSTANT * (ends[-1] - ends[0]), side="right") - 1
        for k, segment in enumerate(self.segments):
            now = np.flatnonzero(at == k)
            if now.size:
                # Instants in order come one after the other: a slice is then three times as quick.
                where = slice(now[0], now[-1] + 1) if now[-1] - now[0] + 1 == now.size else now
                r[where], velocity[where], acceleration[where] = segment.sample(t[where])
        r[at == len(self.segments)] = last.sample(ends[-1:])[0]
        return r, velocity, acceleration
