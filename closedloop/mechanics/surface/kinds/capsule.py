"""[surface] kind = "capsule": a round bar with round ends, touched from outside."""

import math
from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import LENGTH, Direction, Positive
from closedloop.mechanics.surface.kinds.cylinder import across_normal
from closedloop.mechanics.surface.surface import RADIUS, Placed


class Capsule(Placed):
    """All points within a radius of a segment, whose middle is below the surface's origin."""

    is_distance: ClassVar[bool] = True

    radius: Annotated[Positive, RADIUS] = Field(0.05, description="radius, m")
    length: Annotated[Positive, LENGTH] = Field(0.2, description="of the segment, without the round ends, m")
    axis: Direction = Field((1.0, 0.0, 0.0), description="along the segment, base frame; at right angles to the normal")

    def resolved(self) -> dict[str, Array]:
        """Return the axis in the surface's axes."""
        return {"axis": across_normal(self.axis, self.normal)}

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return the distance from the segment, less the radius."""
        a0, a1, half = par.axis[0], par.axis[1], 0.5 * par.length
        along = a0 * p[0] + a1 * p[1]
        round_end = abs(along) > half
        place = min(max(along, -half), half)
        x, y, z = p[0] - place * a0, p[1] - place * a1, p[2] + par.radius
        size = math.sqrt(x * x + y * y + z * z)
        bend = 1.0 / size
        g0, g1, g2 = bend * x, bend * y, bend * z
        if round_end:
            a0, a1 = 0.0, 0.0
        gradient[0], gradient[1], gradient[2] = g0, g1, g2
        hessian[0, 0], hessian[1, 1] = bend * (1.0 - g0 * g0 - a0 * a0), bend * (1.0 - g1 * g1 - a1 * a1)
        hessian[2, 2] = bend * (1.0 - g2 * g2)
        hessian[0, 1] = hessian[1, 0] = -bend * (g0 * g1 + a0 * a1)
        hessian[0, 2] = hessian[2, 0] = -bend * g0 * g2
        hessian[1, 2] = hessian[2, 1] = -bend * g1 * g2
        over = x * x + y * y + p[2] * (p[2] + 2.0 * par.radius)  # less R², without cancellation
        return float(over / (size + par.radius))
