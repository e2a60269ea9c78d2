"""[surface] kind = "plane": n·p = d in the base frame, the paper's surface (Eq. 11)."""

from typing import Annotated, Any, Literal

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import PLACE, Number
from closedloop.mechanics.surface.surface import Surface


class PlaneSurface(Surface):
    """[surface] kind = "plane": n·p = d in the base frame."""

    offset: Annotated[Number, PLACE] | Literal["start"] = Field(
        "start", description='d for the unit normal, m, or "start": through the tip at the start'
    )

    def place(self, normal: Array) -> Array | None:
        """Return d n; None with offset = "start"."""
        return None if self.offset == "start" else self.offset * normal

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return the distance z."""
        gradient[2] = 1.0
        return float(p[2])
