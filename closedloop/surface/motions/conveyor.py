"""[surface_motion] kind = "conveyor": at constant velocity."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, field_validator

from closedloop.sections import SPEED, Number
from closedloop.surface.motion import SurfaceMotion

Speed = Annotated[Number, SPEED]


class Conveyor(SurfaceMotion):
    """A belt, or a table that is driven at constant velocity."""

    velocity: tuple[Speed, Speed, Speed] = Field(
        (0.0, 0.05, 0.0), description="velocity of the surface, base frame, m/s"
    )

    @field_validator("velocity")
    @classmethod
    def _moves(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not any(value):
            raise ValueError('must not be zero; a surface at rest is kind = "none"')
        return value

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the shift at t, s."""
        for i in range(3):
            m.shift[i], m.shift_rate[i] = par.velocity[i] * t, par.velocity[i]
