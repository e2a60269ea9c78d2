"""[compliance] kind = "hunt_crossley": f = k δⁿ (1 + λ δ̇), whose damping grows with depth.

The force begins and ends at zero, as that of real bodies does. A body that hits it at the speed v leaves with the
restitution 1 − (2/3) λ v for small λ v.

Source: K. H. Hunt, F. R. E. Crossley, Coefficient of restitution interpreted as damping in vibroimpact, J. Applied
Mechanics 42(2), 1975.
"""

from typing import Annotated, Any

from pydantic import Field

from closedloop.base.sections import NotNegative, Positive, Size
from closedloop.mechanics.surface.surface import Compliance

HERTZ = Size(10.0, "", "no bodies touch so", 0.1, "no bodies touch so")
STIFFNESS = Size(1e18, "N/mⁿ", "nothing is so stiff", 1e-9)
DISSIPATION = Size(1e6, "s/m", "nothing dissipates so")


class HuntCrossley(Compliance):
    """Hertz's contact with damping; exponent 1.5 is that of a sphere."""

    stiffness: Annotated[Positive, STIFFNESS] = Field(1e6, description="stiffness k, N/mⁿ")
    exponent: Annotated[Positive, HERTZ] = Field(1.5, description="exponent n: 1.5 of a sphere on a plane, 1 of a flat")
    dissipation: Annotated[NotNegative, DISSIPATION] = Field(1.0, description="dissipation λ, s/m")

    def static_depth(self, force: float) -> float:
        """Return (f/k)^(1/n)."""
        return float((force / self.stiffness) ** (1.0 / self.exponent))

    def tangent(self, depth: float) -> tuple[float, float]:
        """Return k n δⁿ⁻¹ and k δⁿ λ."""
        hertz = self.stiffness * depth**self.exponent
        return hertz * self.exponent / depth if depth > 0.0 else 0.0, hertz * self.dissipation

    @staticmethod
    def force(depth: float, speed: float, par: Any) -> float:
        """Return k δⁿ (1 + λ δ̇); of a depth below zero, as in a bilateral contact, the mirrored spring."""
        size = par.stiffness * abs(depth) ** par.exponent
        return float((size if depth > 0.0 else -size) + size * par.dissipation * speed)
