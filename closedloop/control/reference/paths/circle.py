"""[reference] kind = "circle": x = radius (1 − cos φ) along `direction`, −radius sin φ along n × direction."""

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import LENGTH, Direction, Instant, Number, Positive
from closedloop.control.reference.path import TURNS, Path, direction_along, interval, not_zero
from closedloop.control.reference.tip_path import Ellipse, Segment, TipPath, minimum_jerk


class Circle(Path):
    """The tip moves on a circle in the surface, from rest to rest with minimum jerk.

    Positive turns go counter-clockwise seen from off the surface: by the right-hand rule about the normal.
    """

    direction: Direction = Field(
        description="direction from the tip's start to the centre, along the surface, base frame; any length but zero"
    )
    radius: Annotated[Positive, LENGTH] = Field(description="radius of the circle, m")
    turns: Annotated[Number, TURNS] = Field(
        1.0, description="how many times round; positive: counter-clockwise seen from off the surface; not zero"
    )
    start: Instant = Field(0.5, description="instant at which the tip starts to move, s")
    stop: Instant = Field(description="instant at which it stops, s")

    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the circle; see `Path.tip_path`."""
        direction = direction_along(self.direction, normal)
        start, stop = interval(self)
        angle = 2 * math.pi * not_zero(self.turns, "reference.turns")
        across = np.cross(normal, direction)
        curve = Ellipse(self.radius * direction, -self.radius * across, angle / (stop - start))
        segment = Segment(start, stop, origin, curve, minimum_jerk, self.radius * abs(angle))
        return TipPath(origin, (segment,), ("reference.radius", "reference.turns"))
