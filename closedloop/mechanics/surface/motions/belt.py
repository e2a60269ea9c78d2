"""[surface_motion] kind = "belt": material that runs along a surface, which stays where it is."""

from typing import Any

from pydantic import Field

from closedloop.mechanics.surface.motion import SurfaceMotion, Velocity


class Belt(SurfaceMotion):
    """A belt that runs over the surface: its shape, edges and normal stay where they are."""

    velocity: Velocity = Field(
        description="velocity of the material, base frame, m/s; what of it is along the normal does not act"
    )

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the flow."""
        for i in range(3):
            m.flow[i] = par.velocity[i]
