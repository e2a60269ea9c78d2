"""[surface_motion] kind = "conveyor": at constant velocity, with its shape and its edges; `belt` leaves them."""

from typing import Any

from pydantic import Field

from closedloop.mechanics.surface.motion import SurfaceMotion, Velocity


class Conveyor(SurfaceMotion):
    """A table that is driven at constant velocity, with its shape and its edges."""

    velocity: Velocity = Field(description="velocity of the surface, base frame, m/s")

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the shift at t, s."""
        for i in range(3):
            m.shift[i], m.shift_rate[i] = par.velocity[i] * t, par.velocity[i]
