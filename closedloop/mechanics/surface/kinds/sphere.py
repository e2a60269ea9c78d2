"""[surface] kind = "sphere": |p − c| = R, touched from outside or from inside (a bowl)."""

import math
from typing import Annotated, Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import Flag, Positive
from closedloop.mechanics.surface.surface import RADIUS, Placed


class Sphere(Placed):
    """A ball, or a bowl: the inside of a sphere."""

    radius: Annotated[Positive, RADIUS] = Field(0.5, description="radius, m")
    inside: Flag = Field(False, description="true: the tip is inside, on a bowl")

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return the signed distance, s (|p − c| − R) with s = −1 inside."""
        s = 1.0 - 2.0 * par.inside
        x, y, z = p[0], p[1], p[2] + s * par.radius
        over = x * x + y * y + p[2] * (p[2] + 2.0 * s * par.radius)  # |p − c|² − R², of a large R without cancellation
        size = math.sqrt(x * x + y * y + z * z)
        bend = s / size
        g0, g1, g2 = bend * x, bend * y, bend * z
        gradient[0], gradient[1], gradient[2] = g0, g1, g2
        hessian[0, 0], hessian[1, 1] = bend * (1.0 - g0 * g0), bend * (1.0 - g1 * g1)
        hessian[2, 2] = bend * (1.0 - g2 * g2)
        hessian[0, 1] = hessian[1, 0] = -bend * g0 * g1
        hessian[0, 2] = hessian[2, 0] = -bend * g0 * g2
        hessian[1, 2] = hessian[2, 1] = -bend * g1 * g2
        return float(s * over / (size + par.radius))
