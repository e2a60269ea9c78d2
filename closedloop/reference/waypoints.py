"""[reference] kind = "waypoints"."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ScenarioError
from closedloop.reference.curves import Straight
from closedloop.reference.sections import WaypointsSection
from closedloop.reference.timing import Timing, constant, minimum_jerk
from closedloop.reference.tip_path import Piece, TipPath

Array = NDArray[np.float64]


def waypoints(section: WaypointsSection, origin: Array) -> TipPath:
    """Return the straight pieces between displacements from `origin` (3,), m, base frame.

    The points need not be in the surface: the path may approach it, press beyond it, retract from it.

    Raises
    ------
    ScenarioError
        If there are not as many instants as points, or the first point is not where the tip starts.
    """
    times, points = np.array(section.times), np.array(section.points)
    if len(times) != len(points):
        raise ScenarioError(
            f"reference.points has {len(points)} entries: must have one for each of the {len(times)} reference.times"
        )
    if np.any(points[0] != 0.0):
        raise ScenarioError(
            f"reference.points[0] = {points[0].tolist()}: must be [0, 0, 0]; points are displacements from the tip's "
            "start, and it leaves from there at the first of reference.times"
        )
    timing = constant if section.timing == "linear" else minimum_jerk
    return TipPath(origin, through(times, points, origin, timing), ("reference.points",))


def through(times: Array, points: Array, origin: Array, timing: Timing) -> tuple[Piece, ...]:
    """Return straight pieces from point to point, displacements (K, 3), m, from `origin`, at the instants (K,), s."""
    pieces = []
    for t0, t1, from_, to in zip(times[:-1], times[1:], points[:-1], points[1:], strict=True):
        velocity = (to - from_) / (t1 - t0)
        length = float(np.linalg.norm(to - from_))
        pieces.append(Piece(float(t0), float(t1), origin + from_, Straight(velocity), timing, length))
    return tuple(pieces)
