"""[surface] kind = "box": a block, touched from outside; its faces, edges and corners by a ball, faces by a point."""

import math
from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import LENGTH, Direction, Positive
from closedloop.mechanics.surface.kinds.cylinder import across_normal
from closedloop.mechanics.surface.surface import Placed

Edge = Annotated[Positive, LENGTH]


class Box(Placed):
    """A block; the surface's origin is the middle of the face with its `normal`."""

    is_distance: ClassVar[bool] = True

    edges: tuple[Edge, Edge, Edge] = Field(
        (0.1, 0.1, 0.1), description="lengths along the axis, across it, and along the normal, m"
    )
    axis: Direction = Field(
        (1.0, 0.0, 0.0), description="along the first edge, base frame; at right angles to the normal"
    )

    def resolved(self) -> dict[str, Array]:
        """Return the axis in the surface's axes."""
        return {"axis": across_normal(self.axis, self.normal)}

    def solid(self) -> tuple[float, ...]:
        """Return the axis along the first edge, two numbers, and half the edges, m."""
        axis = self.resolved()["axis"]
        return (float(axis[0]), float(axis[1]), *(0.5 * edge for edge in self.edges))

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return the distance: from the nearest point of the box outside it, from the nearest face inside it."""
        a0, a1 = par.axis[0], par.axis[1]
        h0, h1, h2 = 0.5 * par.edges[0], 0.5 * par.edges[1], 0.5 * par.edges[2]
        x, y, z = a0 * p[0] + a1 * p[1], a0 * p[1] - a1 * p[0], p[2] + h2
        # p[2] is beyond the face of the origin without the rounding of a large edge
        d0, d1, d2 = abs(x) - h0, abs(y) - h1, p[2] if z > 0.0 else -z - h2
        s0, s1, s2 = math.copysign(1.0, x), math.copysign(1.0, y), math.copysign(1.0, z)
        u0, u1, u2 = max(d0, 0.0), max(d1, 0.0), max(d2, 0.0)
        size = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
        if size > 0.0:
            n0, n1, n2, level = s0 * u0 / size, s1 * u1 / size, s2 * u2 / size, size
            b0, b1, b2 = 1.0 if u0 > 0.0 else 0.0, 1.0 if u1 > 0.0 else 0.0, 1.0 if u2 > 0.0 else 0.0
        else:
            level = max(d0, d1, d2)
            n0, n1, n2 = 0.0, 0.0, 0.0
            if level == d2:
                n2 = s2
            elif level == d0:
                n0 = s0
            else:
                n1 = s1
            b0, b1, b2, size = 0.0, 0.0, 0.0, 1.0
        k00, k11, k22 = (b0 - n0 * n0) / size, (b1 - n1 * n1) / size, (b2 - n2 * n2) / size
        if b0 + b1 + b2 <= 1.0:  # a face is flat
            k00, k11, k22 = 0.0, 0.0, 0.0
        k01, k02, k12 = -n0 * n1 / size, -n0 * n2 / size, -n1 * n2 / size
        gradient[0], gradient[1], gradient[2] = a0 * n0 - a1 * n1, a1 * n0 + a0 * n1, n2
        hessian[0, 0] = a0 * a0 * k00 - 2.0 * a0 * a1 * k01 + a1 * a1 * k11
        hessian[1, 1] = a1 * a1 * k00 + 2.0 * a0 * a1 * k01 + a0 * a0 * k11
        hessian[0, 1] = hessian[1, 0] = a0 * a1 * (k00 - k11) + (a0 * a0 - a1 * a1) * k01
        hessian[0, 2] = hessian[2, 0] = a0 * k02 - a1 * k12
        hessian[1, 2] = hessian[2, 1] = a1 * k02 + a0 * k12
        hessian[2, 2] = k22
        return float(level)
