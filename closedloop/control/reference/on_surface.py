"""A path on a surface: laid onto it, over its seams and its edge.

At the seams of a surface third derivatives of φ jump. A tool that is held against the surface has an acceleration that
jumps there, and no polynomial goes over the jump. So the joint path has a knot at each instant at which it crosses one.

A path is projected onto a surface that is curved or moves, or laid as a geodesic
(`closedloop.control.reference.geodesic`). Projected, it is drawn in the tangent plane at the origin of the surface, and
each point is moved along the normal there onto the surface as it is at that instant; the velocity and the acceleration
follow in closed form (`closedloop.mechanics.surface`). So a line on a sphere is an arc of a great circle, along which
the tip gets faster as the surface turns away. A tip that starts off the surface keeps to the level of φ that it starts
on.

Paths that leave a surface over its edge, or come to where it has no normal, are refused before anything is simulated.
There the gradient of φ vanishes, or jumps: at the tip of a cone, where a surface meets itself or has an edge, or where
a formula has a factor that is zero. That may be a point, and a path is known at instants. So ∇φ is followed along it:
from the instants at which it is small the least of it is found, and where it turns much from one to the next it is
seen whether it does so at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.geodesic import CarriedSegment, Rolling
from closedloop.control.reference.tip_path import Segment, Straight, TipPath, constant
from closedloop.mechanics.surface.contact import edge_distance
from closedloop.mechanics.surface.gradient import gradients
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import Surface

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
    """A segment whose motion is laid onto a surface."""

    surface: PlacedSurface
    level: float  # the φ that the path keeps to

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return r, ṙ and r̈ as `Segment.sample` does."""
        return self.surface.follow(self.level, np.asarray(t, dtype=np.float64), super().sample(t))


def on_surface(path: TipPath, surface: PlacedSurface, duration: float, geodesic: bool = False) -> TipPath:
    """Return the path laid onto a surface; one that moves carries the tip along until `duration`, s, and before.

    Parameters
    ----------
    path : TipPath
        In the tangent plane at the surface's origin.
    geodesic : bool
        Whether it is rolled onto the surface, with its lengths, or projected. On a surface that moves a geodesic is
        drawn on the body; a projection follows it along the normal alone.

    Raises
    ------
    ScenarioError
        If the surface does not lie under the path.
    """
    level = surface.touching(path.origin).level
    segments = list(path.segments)
    if surface.moves:
        segments = _without_gaps(path, duration)
    if geodesic:
        return replace(path, segments=tuple(_rolled(segments, path.origin, surface)), begins=path.start)
    laid = tuple(
        SegmentOnSurface(each.start, each.stop, each.origin, each.curve, each.timing, each.length, surface, level)
        for each in segments
    )
    return replace(path, segments=laid, begins=path.start)


def _rolled(segments: list[Segment], origin: Array, surface: PlacedSurface) -> Iterator[Segment]:
    """Return the segments with their curves on the surface, each from where the one before ends."""
    rolling = Rolling(surface, origin)
    for each in segments:
        begins, duration = rolling.r, each.stop - each.start
        curve = rolling.roll(each.curve, duration, each.length)
        common = each.start, each.stop, begins, curve, each.timing, each.length
        yield CarriedSegment(*common, surface) if surface.moves else Segment(*common)


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
