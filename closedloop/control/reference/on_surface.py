"""A path laid onto a surface that is curved or moves: projected, or as a geodesic
(`closedloop.control.reference.geodesic`).

Projected, the path is drawn in the tangent plane at the origin of the surface, and each point is moved along the normal
there onto the surface as it is at that instant; the velocity and the acceleration follow in closed form
(`closedloop.mechanics.surface`). So a line on a sphere is an arc of a great circle, along which the tip gets faster as
the surface turns away. A tip that starts off the surface keeps to the level of φ that it starts on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.curves import Straight
from closedloop.control.reference.geodesic import CarriedSegment, Rolling
from closedloop.control.reference.timing import constant
from closedloop.control.reference.tip_path import Segment, TipPath
from closedloop.mechanics.surface.placed import PlacedSurface


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
