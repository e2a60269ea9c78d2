"""The base classes of surfaces and of compliances, each a section of the scenario.

A soft surface pushes with f(δ, δ̇), δ the depth of the tip in it, in place of the multiplier of Eq. 24: there is no
constraint along the normal, and nothing for a stabiliser to do there. As the stiffness grows, f approaches that
multiplier. A surface that the tip may leave (unilateral) does not pull: where f(δ, δ̇) is negative, f is zero; contact
begins and ends at δ = 0, without an impulse.

A compliance of one's own is a class derived from `Compliance`, with its parameters as typed fields and two functions.
Those that ship are in `closedloop.mechanics.surface.compliances`, one file each, written the same way.

The base class of surfaces: a section of the scenario, and the function φ(p) whose zero the surface is.

A surface has axes of its own: z is its normal where it starts from, its `normal`, and x and y are the tangents t1 and
t2 there (`closedloop.mechanics.surface.placed.contact_frame`). Their origin is a point of the surface. A surface of
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

# Gauss and Legendre's rule with eight points, on −1 to 1: half of the points, and their weights.
POINTS = (0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363)
WEIGHTS = (0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763)

# The fastest at which a surface may throw out what starts inside it, m/s: a body that fell from 5 m comes with as much.
# What is faster is no motion that has been interrupted, but a surface that is in a wrong place.
FASTEST_OUT = 10.0


def largest_mobility(H: Array, rows: Array) -> float:
    """Return the largest eigenvalue of G H⁻¹ Gᵀ, 1/kg, of rows G (m, n); 0 if some joint moves no inertia."""
    try:
        return float(np.linalg.eigvalsh(rows @ np.linalg.solve(H, rows.T))[-1])
    except np.linalg.LinAlgError:
        return 0.0


class Compliance(Parameters):
    """[compliance]: stiffness and damping of the surface."""

    folder: ClassVar[str] = "closedloop.mechanics.surface.compliances"

    def static_depth(self, force: float) -> float:
        """Return the depth, m, at which the surface pushes a tip at rest with a force >= 0, N."""
        return 0.0

    def tangent(self, depth: float) -> tuple[float, float]:
        """Return stiffness, N/m, and damping, N s/m, of small motions about a depth, m: what a step must resolve."""
        return 0.0, 0.0

    def thrown_out(self, depth: float, mobility: float) -> str:
        """Return in words that a start so deep, m, is not one, of what has this mobility, 1/kg; "" if it is.

        A spring throws it out at δ √(k w), of one that stiffens to its order.
        """
        stiffness = max(self.tangent(depth)[0], 0.0) if depth > 0.0 and mobility > 0.0 else 0.0
        speed = depth * math.sqrt(stiffness * mobility)
        return f", which throws it out at some {speed:.3g} m/s" if speed > FASTEST_OUT else ""

    @staticmethod
    def force(depth: float, speed: float, par: Any) -> float:
        """Return the force f along the normal, N, at a depth, m, that grows at `speed`, m/s."""
        return 0.0


COMPLIANCES = Family(Compliance, usual="none")


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
