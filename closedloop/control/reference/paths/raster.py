"""[reference] kind = "raster": passes of ± length along `direction`, steps of pitch along n × direction between them.

The total time is divided so that passes and steps have the same peak acceleration, which with minimum jerk is
proportional to length/T²: the time of each segment is proportional to √length.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.sections import LENGTH, Direction, Instant, Number, Positive, Unit
from closedloop.control.reference.path import Path, direction_along, interval, not_zero
from closedloop.control.reference.tip_path import TipPath, minimum_jerk, through

# More passes than this are refused as a typing error.
MOST_PASSES = 1000


def _passes(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("must be a whole number")
    if not 1 <= value <= MOST_PASSES:
        raise ValueError(f"must be between 1 and {MOST_PASSES}")
    return value


class Raster(Path):
    """The tip moves back and forth in parallel passes along the surface, as in polishing or scanning.

    Each pass and each step to the next is a minimum-jerk motion from rest to rest, so the corners are sharp and the
    path is C2 in time.
    """

    direction: Direction = Field(description="direction of the first pass, along the surface, base frame")
    length: Annotated[Positive, LENGTH] = Field(description="length of a pass, m")
    pitch: Annotated[Number, LENGTH] = Field(
        description="distance from a pass to the next, m; positive: to the left of direction seen from off the surface"
    )
    passes: Annotated[int, BeforeValidator(_passes), Unit("")] = Field(
        description=f"how many passes, 1 to {MOST_PASSES}"
    )
    start: Instant = Field(0.5, description="instant at which the tip starts to move, s")
    stop: Instant = Field(description="instant at which it stops, s")

    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the passes to and fro; see `Path.tip_path`."""
        direction = direction_along(self.direction, normal)
        start, stop = interval(self)
        across = not_zero(self.pitch, "reference.pitch") * np.cross(normal, direction)
        corners = [np.zeros(3)]
        for k in range(self.passes):
            if k:
                corners.append(corners[-1] + across)
            corners.append(corners[-1] + (self.length if k % 2 == 0 else -self.length) * direction)
        points = np.array(corners)
        share = np.sqrt([self.length if k % 2 == 0 else abs(self.pitch) for k in range(len(points) - 1)])
        times = start + (stop - start) * np.concatenate([[0.0], np.cumsum(share) / np.sum(share)])
        times[-1] = stop
        keys = ("reference.length", "reference.pitch", "reference.passes")
        return TipPath(origin, through(times, points, origin, minimum_jerk), keys)
