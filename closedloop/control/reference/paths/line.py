"""[reference] kind = "line": r(t) = r(0) + speed · s(t) · direction, s of `closedloop.control.reference.tip_path`."""

from typing import Annotated, Literal

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import SPEED, Direction, Instant, Number
from closedloop.control.reference.path import Path, direction_along, interval
from closedloop.control.reference.tip_path import Segment, Straight, TipPath, constant, minimum_jerk


class Line(Path):
    """The tip moves straight along the surface.

    Its length is speed · (stop − start) for either timing; with minimum jerk the highest speed is 1.875 times `speed`.
    """

    direction: Direction = Field(description="direction of the tip's motion, base frame; any length but zero")
    speed: Annotated[Number, SPEED] = Field(
        description="tip speed, m/s, the mean one with minimum_jerk; negative runs backwards"
    )
    start: Instant = Field(0.5, description="instant at which the tip starts to move, s")
    stop: Instant = Field(description="instant at which it stops, s")
    timing: Literal["constant", "minimum_jerk"] = Field(
        "constant",
        description="constant: at constant speed, with a velocity step at either end; minimum_jerk: from rest to rest",
    )

    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the straight path; see `Path.tip_path`."""
        direction = direction_along(self.direction, normal)
        start, stop = interval(self)
        curve = Straight(self.speed * direction)
        timing = constant if self.timing == "constant" else minimum_jerk
        segment = Segment(start, stop, origin, curve, timing, abs(self.speed) * (stop - start))
        return TipPath(origin, (segment,), ("reference.stop", "reference.speed"))
