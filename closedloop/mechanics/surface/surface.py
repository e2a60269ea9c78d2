"""The base class of surfaces: a section of the scenario, and the function φ(p) whose zero the surface is.

A surface has axes of its own: z is its normal where it starts from, its `normal`, and x and y are the tangents t1 and
t2 there (`closedloop.mechanics.surface.plane.contact_frame`). Their origin is a point of the surface. A surface of
one's own is a class derived from `Surface`, with its parameters as typed fields and the one function `level`:

    class Saddle(Surface):
        bend: Annotated[Number, CURVATURE] = Field(2.0, description="curvature along x, and its negative along y, 1/m")

        @staticmethod
        def level(p, par, gradient, hessian):
            x, y, z = p
            gradient[0], gradient[1], gradient[2] = -par.bend * x, par.bend * y, 1.0
            hessian[0, 0], hessian[1, 1] = -par.bend, par.bend
            return z - 0.5 * par.bend * (x * x - y * y)

Those that ship are in `closedloop.mechanics.surface.kinds`, one file each, written the same way. What contact with a
surface means for the tip is the same for all of them: `closedloop.mechanics.surface.geometry`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Parameters
from closedloop.base.sections import LENGTH, PLACE, Direction, NotNegative, Positive, Size
from closedloop.base.sections import Coordinate as Coordinate

RADIUS = LENGTH
HalfLength = Annotated[Positive, LENGTH]
CURVATURE = Size(1e9, "1/m", "no tip is so small")


class Surface(Parameters):
    """[surface]: what the tip is in contact with."""

    folder: ClassVar[str] = "closedloop.mechanics.surface.kinds"
    #: Whether φ is the distance everywhere outside, of a body with edges too: a ball then needs no nearest point.
    is_distance: ClassVar[bool] = False

    normal: Direction = Field((0.0, 0.0, 1.0), description="out of the surface, base frame; any length but zero")
    gap: Annotated[NotNegative, PLACE] = Field(
        0.0, description="how far below the tip the surface lies at the start, m, if it is placed there"
    )
    extent: tuple[HalfLength, HalfLength] | None = Field(
        None, description="half-lengths along the two tangents, from the surface's origin to its edge, m; else none"
    )
    edge_radius: Annotated[Positive, LENGTH] | None = Field(
        None, description="distance of a round edge from the surface's origin, m, in place of `extent`"
    )
    contact: Literal["bilateral", "unilateral"] = Field(
        "bilateral",
        description="bilateral: the tip is held to the surface, as in the paper; unilateral: it may touch and leave",
    )

    def place(self, normal: Array) -> Array | None:
        """Return the origin of the surface's axes (3,), m, base frame; None: `gap` below the tip at the start.

        `normal` (3,) is the unit normal there.
        """
        return None

    def bounds(self) -> tuple[float, float]:
        """Return the half-lengths along x and y, m: inf without an edge, the radius and 0 for a round edge.

        Raises
        ------
        ScenarioError
            If two edges are given.
        """
        if self.edge_radius is None:
            return self.extent or (math.inf, math.inf)
        if self.extent is not None:
            raise ScenarioError("surface.edge_radius: cannot be combined with surface.extent; leave out one of them")
        return self.edge_radius, 0.0

    def solid(self) -> tuple[float, ...]:
        """Return the sizes of a block by which `edge_distance` finds where its faces end; zeros of other surfaces."""
        return (0.0,) * 5

    def seams(self) -> tuple[Array, Array]:
        """Return the x and the y, m, at which third derivatives of φ jump, across lines along the other tangent."""
        return np.zeros(0), np.zeros(0)

    def list_length(self) -> int:
        """Return how many entries each parameter has that is a list."""
        return 0

    @staticmethod
    @abstractmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ at p (3,), m, in the surface's axes, and write ∇φ (3,) and ∇∇φ (3, 3), which are zero when asked.

        φ is zero on the surface and positive off it, in m or any other unit; of a signed distance |∇φ| = 1. It has
        continuous second derivatives, and a gradient that does not vanish near the surface.
        """


class Placed(Surface):
    """A surface that may be placed by a point of it."""

    point: tuple[Coordinate, Coordinate, Coordinate] | Literal["start"] = Field(
        "start",
        description='point of the surface where `normal` is its normal, base frame, m, or "start": below the tip',
    )

    def place(self, normal: Array) -> Array | None:
        """Return `point`."""
        return None if self.point == "start" else np.array(self.point)


SURFACES = Family(Surface, usual="plane")  # type: ignore[type-abstract]  # it makes no instance of the base
