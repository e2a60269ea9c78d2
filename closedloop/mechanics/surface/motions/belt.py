"""[surface_motion] kind = "belt": material that runs along a surface, which stays where it is."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from closedloop.base.sections import SPEED, Number
from closedloop.mechanics.surface.motion import SurfaceMotion, moving

Speed = Annotated[Number, SPEED]


class Belt(SurfaceMotion):
    """A belt that runs over the surface: its shape, edges and normal stay where they are."""

    velocity: Annotated[tuple[Speed, Speed, Speed], AfterValidator(moving)] = Field(
        description="velocity of the material, base frame, m/s; what of it is along the normal does not act"
    )

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the flow."""
        for i in range(3):
            m.flow[i] = par.velocity[i]
