"""[reference] kind = "waypoints": r(times[k]) = r(0) + points[k], straight in between."""

from typing import Literal

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.path import MotionInstants, Path, Points
from closedloop.control.reference.tip_path import TipPath, constant, minimum_jerk, through


class Waypoints(Path):
    """Straight from point to point: in space, to approach the surface, press beyond it, retract; or on the surface."""

    in_plane = False

    on_surface: Literal["projected", "geodesic", "no"] = Field(
        "no",
        description="whether and how they are mapped onto the surface: projected along the normal at the start; "
        "geodesic: with their lengths and angles; no: they are points in space",
    )
    times: MotionInstants = Field(description="instants at which the tip is at the points, s, increasing")
    points: Points = Field(
        description="displacements of the tip from its start, m, base frame, one for each instant; "
        "the first is [0, 0, 0]"
    )
    timing: Literal["minimum_jerk", "linear"] = Field(
        "minimum_jerk", description="minimum_jerk: at rest at every point; linear: constant velocity between points"
    )

    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the straight segments between the points; see `Path.tip_path`."""
        times, points = np.array(self.times), np.array(self.points)
        if len(times) != len(points):
            raise ScenarioError(
                f"reference.points has {len(points)} entries: must have one for each of the {len(times)} "
                "reference.times"
            )
        if np.any(points[0] != 0.0):
            raise ScenarioError(
                f"reference.points[0] = {points[0].tolist()}: must be [0, 0, 0]; points are displacements from the "
                "tip's start, and it leaves from there at the first of reference.times"
            )
        timing = constant if self.timing == "linear" else minimum_jerk
        return TipPath(origin, through(times, points, origin, timing), ("reference.points",))
