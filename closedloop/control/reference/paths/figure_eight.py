"""[reference] kind = "figure_eight": x = (width/2) sin φ along `direction`, (height/2) sin 2φ along n × direction."""

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import LENGTH, Direction, Instant, Positive
from closedloop.control.reference.path import TURNS, Path, direction_along, interval
from closedloop.control.reference.tip_path import Eight, Segment, TipPath, minimum_jerk


class FigureEight(Path):
    """The tip moves along a figure eight in the surface, a Lissajous figure, from rest to rest with minimum jerk.

    The tip starts at the crossing.
    """

    direction: Direction = Field(description="along the eight, in the surface, base frame; any length but zero")
    width: Annotated[Positive, LENGTH] = Field(description="extent of the eight along direction, m")
    height: Annotated[Positive, LENGTH] = Field(description="extent of the eight across it, m")
    turns: Annotated[Positive, TURNS] = Field(1.0, description="how many times round the eight")
    start: Instant = Field(0.5, description="instant at which the tip starts to move, s")
    stop: Instant = Field(description="instant at which it stops, s")

    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the eight; see `Path.tip_path`."""
        direction = direction_along(self.direction, normal)
        start, stop = interval(self)
        across = np.cross(normal, direction)
        rate = 2 * math.pi * self.turns / (stop - start)
        curve = Eight(0.5 * self.width * direction, 0.5 * self.height * across, rate)
        length = self.turns * _length(self.width, self.height)
        segment = Segment(start, stop, origin, curve, minimum_jerk, length)
        return TipPath(origin, (segment,), ("reference.width", "reference.height", "reference.turns"))


def _length(width: float, height: float) -> float:
    """Return the length of one turn, m: the trapezium rule, which a periodic smooth integrand makes exact quickly."""
    angles = 2 * math.pi / 256 * np.arange(256)
    return 2 * math.pi * float(np.mean(np.hypot(0.5 * width * np.cos(angles), height * np.cos(2 * angles))))
