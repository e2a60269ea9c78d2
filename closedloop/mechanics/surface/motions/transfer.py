"""[surface_motion] kind = "transfer": from one pose to another, at rest before and after, by a cycloid."""

import math
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from closedloop.base.sections import ANGLE, PLACE, Direction, Instant, Number
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.placed import unit

Place = Annotated[Number, PLACE]


class Transfer(SurfaceMotion):
    """A plate, a lift or anything else that is turned and shifted once.

    At τ = (t − start)/(stop − start) it has the part τ − sin(2πτ)/2π of its way behind it, so that speed and
    acceleration are zero at both ends.
    """

    shift: tuple[Place, Place, Place] = Field((0.0, 0.0, 0.0), description="displacement in the end, base frame, m")
    angle: Annotated[Number, ANGLE] = Field(0.0, description="rotation in the end, rad")
    axis: Direction = Field((0.0, 0.0, 1.0), description="axis of rotation, base frame; any length but zero")
    centre: tuple[Place, Place, Place] = Field((0.0, 0.0, 0.0), description="a point of the axis, base frame, m")
    start: Instant = Field(0.0, description="instant at which it starts to move, s")
    stop: Instant = Field(description="instant at which it stops, s")

    @model_validator(mode="after")
    def _moves(self) -> Self:
        """Refuse a motion without duration."""
        if not self.stop > self.start:
            raise ValueError(f"stop must be later than start = {self.start:g}")
        return self

    def resolved(self) -> dict[str, Any]:
        """Return the unit vector of the axis."""
        return {"axis": np.asarray(unit(self.axis, "surface_motion.axis"))}

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write shift and angle at t, s."""
        duration, w = par.stop - par.start, 2.0 * math.pi
        x = min(max((t - par.start) / duration, 0.0), 1.0)
        part, rate, change = x - math.sin(w * x) / w, (1.0 - math.cos(w * x)) / duration, w * math.sin(w * x)
        change /= duration * duration
        m.angle, m.rate, m.acceleration = par.angle * part, par.angle * rate, par.angle * change
        for i in range(3):
            m.axis[i], m.centre[i] = par.axis[i], par.centre[i]
            m.shift[i], m.shift_rate[i] = par.shift[i] * part, par.shift[i] * rate
            m.shift_acceleration[i] = par.shift[i] * change
