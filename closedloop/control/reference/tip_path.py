"""The path of the tip: segments of smooth motion, their timing, the curves along them; and a path on a surface.

Motion is at constant speed, or from rest to rest with minimum jerk. A timing maps the time t after the start of a
motion of T seconds to the path parameter s and its derivatives ṡ and s̈; s, in seconds, is the time at which a motion
at constant speed would be at the same point. So s runs from 0 to T, and ṡ is the speed as a multiple of the mean speed.

At the seams of a surface third derivatives of φ jump. A tool that is held against the surface has an acceleration that
jumps there, and no polynomial goes over the jump. So the joint path has a knot at each instant at which it crosses one.

A path is projected onto a surface that is curved or moves, or laid as a geodesic. Projected, it is drawn in the tangent
plane at the origin of the surface, and each point is moved along the normal there onto the surface as it is at that
instant; the velocity and the acceleration follow in closed form (`closedloop.mechanics.surface`). So a line on a sphere
is an arc of a great circle, along which the tip gets faster as the surface turns away. A tip that starts off the
surface keeps to the level of φ that it starts on.

Paths that leave a surface over its edge, or come to where it has no normal, are refused before anything is simulated.
There the gradient of φ vanishes, or jumps: at the tip of a cone, where a surface meets itself or has an edge, or where
a formula has a factor that is zero. That may be a point, and a path is known at instants. So ∇φ is followed along it:
from the instants at which it is small the least of it is found, and where it turns much from one to the next it is
seen whether it does so at once.

A geodesic is laid without stretching it: as it is drawn when the plane of the path rolls along the surface. A plane
that rolls without slip and without spin about the normal keeps lengths and angles, so the tip runs along the surface
exactly as fast as the path says, a straight line becomes a geodesic, corners keep their angle, and a curve its
curvature within the surface. With (x, y) the path in the plane, s its parameter, and e₁, e₂ two tangents,

    r' = x' e₁ + y' e₂,      eᵢ' = −(eᵢ·n') n,      n' = (1 − n nᵀ) ∇∇φ r'/|∇φ|

which for a straight line is the equation of a geodesic, and eᵢ are carried along parallel to themselves (M. do Carmo,
Differential Geometry of Curves and Surfaces, 4-4). It is integrated by DOP853 from knot to knot; at each knot the point
is put back onto the surface and the tangents into its plane. Between knots the path is the polynomial of degree 5 with
their r, r' and r'', which is checked midway: where it is off, the point midway becomes a knot.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.mechanics.surface.along import carry, gradients, shape_at
from closedloop.mechanics.surface.contact import edge_distance
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import Surface

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


# Tolerances of a step of DOP853, and of the polynomials midway between knots: m, and as a share of the speed.
RELATIVE, ABSOLUTE = 1e-11, 1e-14
MIDWAY, SPEED_MIDWAY = 1e-12, 1e-10
# Knots to begin with, one each so many m; and when to give up: where so many, evenly spread, would not do.
SPACING, FEWEST, MOST = 0.01, 8, 4096
# Longest curve, m: the inverse kinematics follows none that is longer.
LONGEST = 10.0
# Newton steps that put a point back, from no farther than an integration step is off.
NEWTON_STEPS = 3


@dataclass(frozen=True)
class Rolled:
    """A curve on a surface, as `closedloop.control.reference.tip_path.Curve`."""

    polynomials: tuple[Any, Any, Any]  # r, m, r' and r'' as functions of the parameter
    first: Array  # (3,): r at the start

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        r, slope, bend = (each(s) for each in self.polynomials)
        return r - self.first, slope, bend


class Rolling:
    """The plane of a path that rolls along a surface.

    `origin` (3,): where the path begins, m, base frame; it keeps to the level of φ there.
    Raises ScenarioError if the surface has no normal there.
    """

    def __init__(self, surface: PlacedSurface, origin: Array) -> None:
        start = surface.touching(origin)
        self._shape, self._level = shape_at(surface), start.level
        self._plane: Array = surface.frame[1:]
        self.r, self.tangents = np.array(origin), start.frame[1:].copy()

    def roll(self, curve: Curve, duration: float, length: float) -> Rolled:
        """Roll along a curve in the plane from where the last one ended.

        `curve`: in the tangent plane at the surface's origin; what leads out of it is left out.
        `duration`: up to which its parameter goes.
        `length`: its length, m, about.
        Raises ScenarioError if it leaves the surface, or is too long, or bent too sharply to be resolved.
        """
        from scipy.interpolate import BPoly

        if not length <= LONGEST:
            raise ScenarioError(
                f"reference: a motion of {length:.4g} m is too long to be laid onto the surface as a geodesic, of "
                f"{LONGEST:g} m at most; make it shorter"
            )
        count, pace = max(FEWEST, math.ceil(min(length / SPACING, MOST))), length / duration
        finest = 0.75 * duration / (count * 2 ** int(math.log2(MOST / count)))
        before, s = (self.r, self.tangents), np.linspace(0.0, duration, 2 * count + 1)
        while True:
            self.r, self.tangents = before
            points = self._through(curve, s, pace)
            r: Any = BPoly.from_derivatives(s[::2], points[::2])
            pieces = (r, r.derivative(), r.derivative(2))
            off, wrong = (np.max(np.abs(pieces[i](s[1::2]) - points[1::2, i]), axis=1) for i in range(2))
            reach, fastest = (float(np.max(np.abs(points[:, i]))) for i in range(2))
            far = np.flatnonzero((off > MIDWAY * (1.0 + reach)) | (wrong > SPEED_MIDWAY * fastest))
            if far.size == 0:
                return Rolled(pieces, points[0, 0].copy())
            half = s[2 * far + 1] - s[2 * far]
            if np.min(half) < finest:
                at = 2 * far[np.argmin(half)] + 1
                raise ScenarioError(
                    f"reference: after {pace * s[at]:.4g} m the path cannot be laid onto the surface as a geodesic: "
                    f"it, or the surface, is bent too sharply, at {np.round(points[at, 0], 4).tolist()} m"
                )
            s = np.sort(np.concatenate([s, s[2 * far] + 0.5 * half, s[2 * far + 1] + 0.5 * half]))

    def _through(self, curve: Curve, s: Array, pace: float) -> Array:
        """Return r, r' and r'' at each parameter of s (K,), (K, 3, 3); `pace` is the path's length by s, m."""
        points = np.empty((s.size, 3, 3))
        for k in range(s.size):
            if k:
                self._step(self._rate(curve, pace * s[k - 1]), s[k - 1], s[k])
            self._put_back(pace * s[k])
            y = np.concatenate([self.r, self.tangents.ravel()])
            velocity = self._rate(curve, pace * s[k])(s[k], y)[:3]
            _, _, bend = (self._plane @ each[0] for each in curve(s[k : k + 1]))
            n, turning, _, _ = self._shape(self.r, velocity)
            points[k] = self.r, velocity, bend @ self.tangents - n * (turning @ velocity)
        return points

    def _rate(self, curve: Curve, done: float) -> Callable[[float, Array], Array]:
        """Return the right-hand side for DOP853; `done`, m, of the path are behind."""

        def rate(s: float, y: Array) -> Array:
            tangents = y[3:].reshape(2, 3)
            velocity = (self._plane @ curve(np.array([s]))[1][0]) @ tangents
            n, turning, _, _ = self._shape(y[:3], velocity)
            if not np.all(np.isfinite(n)):
                raise _left(y[:3], done)
            return np.concatenate([velocity, np.outer(-(tangents @ turning), n).ravel()])

        return rate

    def _step(self, rate: Callable[[float, Array], Array], begin: float, end: float) -> None:
        from scipy.integrate import DOP853

        y = np.concatenate([self.r, self.tangents.ravel()])
        solver: Any = DOP853(rate, begin, y, end, rtol=RELATIVE, atol=ABSOLUTE, first_step=end - begin)
        while solver.status == "running":
            solver.step()
        self.r, self.tangents = solver.y[:3].copy(), solver.y[3:].reshape(2, 3).copy()

    def _put_back(self, done: float) -> None:
        """Put the point onto its level of φ, and the tangents into the plane there, at right angles."""
        for _ in range(NEWTON_STEPS):
            n, _, level, size = self._shape(self.r, np.zeros(3))
            if not np.all(np.isfinite(n)):
                raise _left(self.r, done)
            self.r = self.r - (level - self._level) / size * n
        first = self.tangents[0] - (self.tangents[0] @ n) * n
        first /= np.linalg.norm(first)
        self.tangents = np.array([first, np.cross(n, first)])


def _left(r: Array, done: float) -> ScenarioError:
    return ScenarioError(
        f"reference: after {done:.4g} m the path leaves the surface, at {np.round(r, 4).tolist()} m; make it shorter, "
        "or the surface larger"
    )


# Instants of a segment between which crossings are looked for.
INSTANTS = 257
# Newton steps to a crossing: a secant over 1/256 of a segment begins them.
STEPS = 4
# The path goes so far at least from one of the instants to the next, m: along a seam it is on either side by rounding.
ACROSS = 1e-9
# Nearer to the last, as a share of a segment, is no other crossing: a path through a corner of four patches has two.
APART = 1e-9


def seams(surface: PlacedSurface | None, segment: Segment) -> list[float]:
    """Return the instants within a segment, s, in order; none of a surface that moves."""
    if surface is None or surface.moves or not any(map(np.size, surface.section.seams())):
        return []
    begin, end = segment.start, segment.stop
    times = np.linspace(begin, end, INSTANTS)
    places = (segment.sample(times)[0] - surface.origin) @ surface.frame[1:].T
    found: list[float] = []
    for tangent, place, lines in zip(surface.frame[1:], places.T, surface.section.seams(), strict=True):
        apart = place[:, None] - lines
        k, line = np.nonzero((apart[:-1] * apart[1:] <= 0.0) & (np.abs(np.diff(place))[:, None] > ACROSS))
        t = times[k] + np.diff(times)[k] * apart[k, line] / (apart[k, line] - apart[k + 1, line])
        for _ in range(STEPS if t.size else 0):
            r, velocity, _ = segment.sample(t)
            with np.errstate(divide="ignore", invalid="ignore"):  # at rest where it begins on a line
                step = ((r - surface.origin) @ tangent - lines[line]) / (velocity @ tangent)
            t = np.clip(t - np.nan_to_num(step), times[k], times[k + 1])
        found += t.tolist()
    kept = [begin]
    for instant in sorted(found):
        if kept[-1] + APART * (end - begin) < instant < end - APART * (end - begin):
            kept.append(instant)
    return kept[1:]


# Instants, beside the ends of its segments, at which a path is looked for beyond the edge of a surface; how far beyond
# is rounding, m.
PATH_CHECKS, ON_EDGE = 500, 1e-9


def edge_distances(surface: PlacedSurface, times: Array, r: Array) -> Array:
    """Return how far inside the edge points r (N, 3), m, base frame, are at times (N,), s: (N,), m, inf without one."""
    if not surface.ends:
        return np.full(times.size, math.inf)
    bounds, axes, found = np.array(surface.section.bounds()), surface.frame[[1, 2, 0]], np.empty(times.size)
    for k, t in enumerate(times):
        turn, shift = surface.displacement(float(t))
        found[k] = edge_distance(axes @ (turn.T @ (r[k] - shift) - surface.origin), bounds, np.zeros(5))
    return found


def refuse_beyond_edge(surface: PlacedSurface, tip: TipPath) -> None:
    """Refuse a path along a surface that leaves it over its edge; a tip that is to stay may be left by the surface."""
    if not surface.ends or not tip.length > 0.0:
        return
    times = tip.instants(PATH_CHECKS)
    inside = edge_distances(surface, times, tip.sample(times)[0])
    beyond = np.flatnonzero(inside < -ON_EDGE)
    if beyond.size:
        keys = " and ".join(tip.keys) or "reference"
        raise ScenarioError(
            f"{keys}: at t = {times[beyond[0]]:.4g} s the path leaves the surface over its edge, "
            f"by {-inside.min():.4g} m at most: make it shorter, or surface.{edge_key(surface.section)} larger"
        )


def edge_key(section: Surface) -> str:
    """Return the key that says where the edge of a surface is."""
    if section.edge_radius is not None:
        return "edge_radius"
    return "extent" if section.extent is not None or not hasattr(section, "spacing") else "spacing"


@dataclass(frozen=True)
class SegmentOnSurface(Segment):
    """A segment whose motion is laid onto a surface, or drawn on one that moves as it lies at t = 0."""

    surface: PlacedSurface
    level: float | None = None  # the φ that the path keeps to; None: it is drawn on the surface, and carried along

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return r, ṙ and r̈ as `Segment.sample` does."""
        times, motion = np.asarray(t, dtype=np.float64), super().sample(np.asarray(t, dtype=np.float64))
        if self.level is None:
            return carry(self.surface, times, motion)
        return self.surface.follow(self.level, times, motion)


def on_surface(path: TipPath, surface: PlacedSurface, duration: float, geodesic: bool = False) -> TipPath:
    """Return the path laid onto a surface; one that moves carries the tip along until `duration`, s, and before.

    `path`: in the tangent plane at the surface's origin.
    `geodesic`: whether it is rolled onto the surface, with its lengths, or projected. On a surface that moves a
        geodesic is drawn on the body; a projection follows it along the normal alone.
    Raises ScenarioError if the surface does not lie under the path.
    """
    level, laid = surface.touching(path.origin).level, list[Segment]()
    rolling = Rolling(surface, path.origin) if geodesic else None
    for each in _without_gaps(path, duration) if surface.moves else path.segments:
        if rolling is None:
            common = each.start, each.stop, each.origin, each.curve, each.timing, each.length
            laid.append(SegmentOnSurface(*common, surface, level))
        else:
            begins = rolling.r  # where the one before ends
            curve = rolling.roll(each.curve, each.stop - each.start, each.length)
            common = each.start, each.stop, begins, curve, each.timing, each.length
            laid.append(SegmentOnSurface(*common, surface) if surface.moves else Segment(*common))
    return replace(path, segments=tuple(laid), begins=path.start)


def _without_gaps(path: TipPath, duration: float) -> list[Segment]:
    """Return the segments of a path with one of rest before the first and after the last, up to `duration`, s."""
    still = Straight(np.zeros(3))
    if not path.segments:
        return [Segment(0.0, duration, path.origin, still, constant, 0.0)]
    first, last = path.segments[0], path.segments[-1]
    found = list(path.segments)
    if first.start > 0.0:
        found.insert(0, Segment(0.0, first.start, path.origin, still, constant, 0.0))
    if duration > last.stop:
        end = last.sample(np.array([last.stop]))[0][0]
        found.append(Segment(last.stop, duration, end, still, constant, 0.0))
    return found


# Instants, beside the ends of its segments, at which ∇φ is looked at.
NORMAL_CHECKS = 300
# Shares of the largest |∇φ| below which the least near an instant is searched for, and below which it vanishes.
SMALL, VANISHED = 0.25, 1e-8
# Cosine of the angle by which ∇φ turns between two instants at which a jump is searched for, and of one that is none.
TURNS, JUMPS = 0.95, 0.98
# An instant is searched for until it is known to this share of the time between two of them.
NEAREST = 1e-12


def refuse_without_normal(surface: PlacedSurface, tip: TipPath) -> None:
    """Refuse a path along a surface to where the gradient of its φ vanishes or jumps."""
    if surface.fixed_plane or not tip.segments:
        return
    times = tip.instants(NORMAL_CHECKS)
    found = _below(surface, tip, times)[0]
    sizes = np.linalg.norm(found, axis=1)
    largest = float(np.max(sizes))
    for k in map(int, np.flatnonzero(sizes <= SMALL * largest)):
        before, after = max(k - 1, 0), min(k + 1, times.size - 1)
        if sizes[k] <= min(sizes[before], sizes[after]):
            t = _least(surface, tip, times[before], times[k], times[after]) if sizes[k] > 0.0 else float(times[k])
            if not np.linalg.norm(_below(surface, tip, np.array([t]))[0]) > VANISHED * largest:
                raise _refused(surface, tip, t, "vanishes")
    for k in map(int, np.flatnonzero(_cosines(found) < TURNS)):
        jump = _jump(surface, tip, times[k], times[k + 1])
        if jump is not None:
            raise _refused(surface, tip, jump, "jumps")


def _refused(surface: PlacedSurface, tip: TipPath, t: float, does: str) -> ScenarioError:
    place = _below(surface, tip, np.array([t]))[1][0].round(4) + 0.0
    return ScenarioError(
        f"reference: at t = {t:.4g} s the path comes to {place.tolist()} m, where the surface has no normal, "
        f"as the gradient of its φ {does} there; make the path shorter, or lead it past that place"
    )


def _below(surface: PlacedSurface, tip: TipPath, times: Array) -> tuple[Array, Array]:
    """Return ∇φ on the surface below a path at times (N,), s, and where that is, m; each (N, 3)."""
    motion = tip.sample(times)
    try:
        r = surface.follow(0.0, times, motion)[0]
    except ScenarioError:  # nothing lies below: then along the path itself
        r = motion[0]
    return gradients(surface, times, r), r


def _cosines(found: Array) -> Array:
    """Return the cosines between neighbours of gradients (N, 3): (N − 1,), 1 where one of them is zero."""
    sizes = np.linalg.norm(found, axis=1)
    both = sizes[1:] * sizes[:-1]
    return np.divide(np.sum(found[1:] * found[:-1], axis=1), both, out=np.ones(both.size), where=both > 0.0)


def _least(surface: PlacedSurface, tip: TipPath, before: float, at: float, after: float) -> float:
    """Return the instant between two others, s, at which |∇φ| is least; `at` is one in between, from where it counts.

    Counted from there, an instant close to it is told apart to its own rounding, not to that of the whole run.
    """
    from scipy.optimize import minimize_scalar

    def size(shift: float) -> float:
        return float(np.linalg.norm(_below(surface, tip, np.array([at + shift]))[0]))

    exact = {"xatol": NEAREST * (after - before)}
    return at + float(minimize_scalar(size, bounds=(before - at, after - at), method="bounded", options=exact).x)


def _jump(surface: PlacedSurface, tip: TipPath, low: float, high: float) -> float | None:
    """Return the instant between two others, s, at which the direction of ∇φ jumps, or None if it turns smoothly."""
    span = high - low
    while high - low > max(NEAREST * span, 4e-16 * high):
        middle = 0.5 * (low + high)
        turned = _cosines(_below(surface, tip, np.array([low, middle, high]))[0])
        if np.min(turned) > JUMPS:
            return None
        low, high = (low, middle) if turned[0] < turned[1] else (middle, high)
    return high
