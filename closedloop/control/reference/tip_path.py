"""The path of the tip: consecutive segments of smooth motion, their timing, the curves along them.

Motion is at constant speed, or from rest to rest with minimum jerk. A timing maps the time t after the start of a
motion of T seconds to the path parameter s and its derivatives ṡ and s̈; s, in seconds, is the time at which a motion
at constant speed would be at the same point. So s runs from 0 to T, and ṡ is the speed as a multiple of the mean speed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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


# s (N,), s, to the displacement, m, and its derivatives by s, m/s and m/s², each (N, 3), base frame.
Curve = Callable[[Array], Sequence[Array]]


@dataclass(frozen=True)
class Straight:
    """A straight line: x = ṙ s."""

    velocity: Array  # (3,): ṙ, the velocity at constant speed, m/s, base frame

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        x = s[:, None] * self.velocity
        return x, np.broadcast_to(self.velocity, x.shape), np.zeros_like(x)


@dataclass(frozen=True)
class Ellipse:
    """An ellipse, a circle if a and b are as long: x = a (1 − cos ωs) + b sin ωs."""

    # a, b (3,): from the start to the centre, and the half axis across it, in which the motion begins, m, base frame
    a: Array
    b: Array
    rate: float  # ω, rad/s

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        w = self.rate
        cos, sin = np.cos(w * s)[:, None], np.sin(w * s)[:, None]
        return (
            self.a * (1.0 - cos) + self.b * sin,
            w * (self.a * sin + self.b * cos),
            w * w * (self.a * cos - self.b * sin),
        )


@dataclass(frozen=True)
class Eight:
    """A figure of eight that begins at its crossing: x = a sin ωs + b sin 2ωs."""

    # a, b (3,): half the width along the eight and half the height across it, m, base frame
    a: Array
    b: Array
    rate: float  # ω, rad/s

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        w = self.rate
        one, two = (w * s)[:, None], (2.0 * w * s)[:, None]
        return (
            self.a * np.sin(one) + self.b * np.sin(two),
            w * (self.a * np.cos(one) + 2.0 * self.b * np.cos(two)),
            -w * w * (self.a * np.sin(one) + 4.0 * self.b * np.sin(two)),
        )


# i·h and the instant of a jump may differ by rounding: this share of a path's duration later is the instant itself.
INSTANT = 1e-9


@dataclass(frozen=True)
class Segment:
    """A smooth motion of the tip between two instants."""

    # start, stop: instants, s
    start: float
    stop: float
    origin: Array  # (3,): position of the tip at `start`, m, base frame
    # curve, timing: the curve from there, and its time scaling
    curve: Curve
    timing: Timing
    length: float  # arc length, m, about: it sets the first spacing of knots of the inverse kinematics

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
        r, velocity, acceleration = np.zeros((3, t.size, 3))
        r[:] = self.origin
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


def through(times: Array, points: Array, origin: Array, timing: Timing) -> tuple[Segment, ...]:
    """Return straight segments from point to point, displacements (K, 3), m, from `origin`, at the instants (K,), s."""
    segments = []
    for t0, t1, from_, to in zip(times[:-1], times[1:], points[:-1], points[1:], strict=True):
        velocity = (to - from_) / (t1 - t0)
        length = float(np.linalg.norm(to - from_))
        segments.append(Segment(float(t0), float(t1), origin + from_, Straight(velocity), timing, length))
    return tuple(segments)
