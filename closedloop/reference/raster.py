"""[reference] kind = "raster"."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.reference.checks import direction_along, interval, not_zero
from closedloop.reference.sections import RasterSection
from closedloop.reference.timing import minimum_jerk
from closedloop.reference.tip_path import TipPath
from closedloop.reference.waypoints import through

Array = NDArray[np.float64]


def raster(section: RasterSection, origin: Array, normal: Array) -> TipPath:
    """Return the passes to and fro from `origin` (3,), m, in the surface with this unit normal (3,), base frame.

    The tip comes to rest at each corner, so corners are sharp and the path is C2 in time. The duration is shared out
    in proportion to the square root of the pieces' lengths, which gives passes and the short steps between them the
    same peak acceleration.

    Raises
    ------
    ScenarioError
        If the direction is not along the surface, `stop` is not after `start`, or the pitch is zero.
    """
    direction = direction_along(section.direction, normal)
    start, stop = interval(section)
    across = not_zero(section.pitch, "reference.pitch") * np.cross(normal, direction)
    corners = [np.zeros(3)]
    for k in range(section.passes):
        if k:
            corners.append(corners[-1] + across)
        corners.append(corners[-1] + (section.length if k % 2 == 0 else -section.length) * direction)
    points = np.array(corners)
    share = np.sqrt([section.length if k % 2 == 0 else abs(section.pitch) for k in range(len(points) - 1)])
    times = start + (stop - start) * np.concatenate([[0.0], np.cumsum(share) / np.sum(share)])
    times[-1] = stop
    keys = ("reference.length", "reference.pitch", "reference.passes")
    return TipPath(origin, through(times, points, origin, minimum_jerk), keys)
