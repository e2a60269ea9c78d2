"""[surface] kind = "none": the tip touches nothing."""

from typing import Any, ClassVar, Literal

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import Nothing
from closedloop.mechanics.surface.surface import Surface


class NoSurface(Surface):
    """[surface] kind = "none": the tip touches nothing; `normal` says which way law.force presses, against it."""

    distance: ClassVar[float] = 1e9  # in place of a gap in the loop, m: no body comes so far, and no sum overflows

    gap: Nothing = Field(0.0, description="left out: there is nothing below the tip")
    extent: None = Field(None, description="left out: there is no edge")
    edge_radius: None = Field(None, description="left out: there is no edge")
    contact: Literal["unilateral"] = Field("unilateral", description="unilateral: nothing holds the tip")

    def place(self, normal: Array) -> Array:
        """Return a point from which every place has the gap `distance`, to rounding."""
        return -self.distance * normal

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return the distance z."""
        gradient[2] = 1.0
        return float(p[2])
