"""[surface_motion] kind = "turntable": turning at constant speed about a fixed axis."""

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from closedloop.base.sections import PLACE, Direction, Number, Size
from closedloop.mechanics.surface.motion import SurfaceMotion, moving
from closedloop.mechanics.surface.placed import unit

TURNING = Size(1e4, "rad/s", "nothing turns so fast")
Place = Annotated[Number, PLACE]


class Turntable(SurfaceMotion):
    """A disc, or anything else that turns at constant speed about a fixed axis."""

    axis: Direction = Field((0.0, 0.0, 1.0), description="axis of rotation, base frame; any length but zero")
    centre: tuple[Place, Place, Place] = Field((0.0, 0.0, 0.0), description="a point of the axis, base frame, m")
    speed: Annotated[Number, TURNING, AfterValidator(moving)] = Field(description="angular speed, rad/s")

    def resolved(self) -> dict[str, Any]:
        """Return the unit vector of the axis."""
        return {"axis": np.asarray(unit(self.axis, "surface_motion.axis"))}

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the angle at t, s."""
        m.angle, m.rate = par.speed * t, par.speed
        for i in range(3):
            m.axis[i], m.centre[i] = par.axis[i], par.centre[i]
