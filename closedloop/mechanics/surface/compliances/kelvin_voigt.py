"""[compliance] kind = "kelvin_voigt": a linear spring and a linear damper side by side, f = k δ + d δ̇."""

from typing import Annotated, Any

from pydantic import Field

from closedloop.base.sections import NotNegative, Positive, stiffness_in, viscous_in
from closedloop.mechanics.surface.surface import Compliance


class KelvinVoigt(Compliance):
    """A spring and a damper. At touchdown f jumps to d times the speed of approach."""

    stiffness: Annotated[Positive, stiffness_in("N/m")] = Field(1e4, description="stiffness k, N/m")
    damping: Annotated[NotNegative, viscous_in("N s/m")] = Field(50.0, description="damping d, N s/m")

    def static_depth(self, force: float) -> float:
        """Return f/k."""
        return force / self.stiffness

    def tangent(self, depth: float) -> tuple[float, float]:
        """Return k and d."""
        return self.stiffness, self.damping

    @staticmethod
    def force(depth: float, speed: float, par: Any) -> float:
        """Return k δ + d δ̇."""
        return float(par.stiffness * depth + par.damping * speed)
