"""[surface] kind = "cylinder": a round bar, or the inside of a pipe."""

import math
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Direction, Flag, Positive
from closedloop.mechanics.surface.placed import contact_frame, unit
from closedloop.mechanics.surface.surface import RADIUS, Placed

# Sine of the angle by which the axis may deviate from the tangent plane.
OUT_OF_TANGENT = 1e-9


def across_normal(direction: tuple[float, float, float], normal: tuple[float, float, float]) -> Array:
    """Return the unit vector along an axis in the surface's axes.

    Raises ScenarioError if it is not at right angles to the normal.
    """
    axis, n = unit(direction, "surface.axis"), unit(normal, "surface.normal")
    if abs(out := float(axis @ n)) > OUT_OF_TANGENT:
        nearest = axis - out * n
        hint = f"; the nearest is {(nearest / np.linalg.norm(nearest)).round(9).tolist()}" if abs(out) < 0.999 else ""
        raise ScenarioError(f"surface.axis = {list(direction)}: must be at right angles to surface.normal{hint}")
    return (contact_frame(n)[[1, 2, 0]] @ axis) * [1.0, 1.0, 0.0]


class Cylinder(Placed):
    """A round bar, or the inside of a pipe."""

    radius: Annotated[Positive, RADIUS] = Field(0.3, description="radius, m")
    axis: Direction = Field(
        (1.0, 0.0, 0.0), description="along the cylinder, base frame; at right angles to the normal"
    )
    inside: Flag = Field(False, description="true: the tip is inside, in a pipe")

    def resolved(self) -> dict[str, Array]:
        """Return the axis in the surface's axes."""
        return {"axis": across_normal(self.axis, self.normal)}

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return the signed distance, s (ρ − R) with ρ the distance from the axis and s = −1 inside."""
        s, a = 1.0 - 2.0 * par.inside, par.axis
        along = p[0] * a[0] + p[1] * a[1]
        x, y, z = p[0] - along * a[0], p[1] - along * a[1], p[2] + s * par.radius
        over = x * x + y * y + p[2] * (p[2] + 2.0 * s * par.radius)  # ρ² − R², of a large R without cancellation
        size = math.sqrt(x * x + y * y + z * z)
        bend = s / size
        g0, g1, g2, a0, a1 = bend * x, bend * y, bend * z, a[0], a[1]
        gradient[0], gradient[1], gradient[2] = g0, g1, g2
        hessian[0, 0], hessian[1, 1] = bend * (1.0 - g0 * g0 - a0 * a0), bend * (1.0 - g1 * g1 - a1 * a1)
        hessian[2, 2] = bend * (1.0 - g2 * g2)
        hessian[0, 1] = hessian[1, 0] = -bend * (g0 * g1 + a0 * a1)
        hessian[0, 2] = hessian[2, 0] = -bend * g0 * g2
        hessian[1, 2] = hessian[2, 1] = -bend * g1 * g2
        return float(s * over / (size + par.radius))
