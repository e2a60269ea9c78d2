"""[surface] kind = "ellipsoid": (x/a)² + (y/b)² + (z/c)² = 1, touched from outside.

Its φ is no distance: |∇φ| differs from 1 off the pole and off the surface.
"""

from typing import Annotated, Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import Positive
from closedloop.mechanics.surface.surface import RADIUS, Placed


class Ellipsoid(Placed):
    """An ellipsoid with its pole, the end of the semi-axis c, where `normal` is the normal."""

    a: Annotated[Positive, RADIUS] = Field(0.4, description="semi-axis along the first tangent, m")
    b: Annotated[Positive, RADIUS] = Field(0.3, description="semi-axis along the second tangent, m")
    c: Annotated[Positive, RADIUS] = Field(0.2, description="semi-axis along the normal, m")

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return c ((x/a)² + (y/b)² + ((z + c)/c)² − 1)/2, whose gradient at the pole is of length 1."""
        x, y, z = p[0], p[1], p[2] + par.c
        xx, yy, zz = par.c / par.a**2, par.c / par.b**2, 1.0 / par.c
        gradient[0], gradient[1], gradient[2] = xx * x, yy * y, zz * z
        hessian[0, 0], hessian[1, 1], hessian[2, 2] = xx, yy, zz
        return float(0.5 * (xx * x * x + yy * y * y + zz * p[2] * (p[2] + 2.0 * par.c)))
