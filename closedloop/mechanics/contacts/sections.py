"""What happens where bodies touch: [impact], how the tip bounces, and [[contact]], contacts of other points."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from closedloop.base.families import OneOf
from closedloop.base.sections import (
    COEFFICIENT,
    PLACE,
    Coordinate,
    Direction,
    NotNegative,
    OneLine,
    Positive,
    Restitution,
    Section,
    Size,
)
from closedloop.mechanics.friction.law import SURFACE_LAWS, SurfaceFriction
from closedloop.mechanics.impact.single import RESTITUTIONS
from closedloop.mechanics.limits import SLIGHT
from closedloop.mechanics.surface.motion import MOTIONS, SurfaceMotion
from closedloop.mechanics.surface.surface import COMPLIANCES, SURFACES, Compliance, Surface

REST_SPEED = Size(1e4, "m/s", "nothing bounces so fast", 1e-12, "slower motion is rounding")
AS_IMPACT = "impact"
RestitutionName = Annotated[str, OneOf(RESTITUTIONS)]


class ImpactSection(Section):
    """[impact]: the law of impact between tip and surface; used only where surface.contact is "unilateral"."""

    restitution: Restitution = Field(0.0, description="coefficient of restitution, 0 to 1")
    law: RestitutionName = Field(
        "stronge",
        description="restitution as a ratio of velocities (newton), impulses (poisson) or energies (stronge)",
    )
    rest_speed: Annotated[Positive, REST_SPEED] = Field(
        1e-4, description="a bounce slower than this becomes contact, m/s; of a joint off its stop rad/s"
    )


ARM = Size(10.0, "m", "no contact is so wide", 1e-9, "smaller ones are rounding")
# What `at` says of all collision shapes of the link.
COLLISION = "collision"
# A shape thinner than this share of its largest half axis has one half axis less.
THIN = SLIGHT
HalfAxis = tuple[Coordinate, Coordinate, Coordinate]


def _a_place(value: Any) -> Any:
    """Refuse a word other than "collision" in place of a point."""
    if isinstance(value, str) and value != COLLISION:
        raise ValueError('must be a point, a list of points, or "collision"')
    return value


Place = Annotated[tuple[Coordinate, Coordinate, Coordinate] | Literal["collision"], Field(union_mode="left_to_right")]


class EdgeSection(Section):
    """contact.edge: an edge of the link about `at`, which crosses those of a box, or a rod, about `through`."""

    half: HalfAxis = Field(description="half the edge, m, axes of the frame link")
    sides: tuple[HalfAxis, HalfAxis] | None = Field(
        None, description="normals of its two faces, out of the body; left out for a rod"
    )
    onto: tuple[HalfAxis, ...] = Field(
        description="half axes of the box, m, axes of the frame against: three vectors at right angles; one for a rod"
    )
    onto_radius: Annotated[NotNegative, PLACE] = Field(0.0, description="radius of that rod, m")
    crossing: Literal["first", "last"] = Field(
        "first", description="an edge crosses a box twice at most: first or last, as seen along `half`"
    )

    @model_validator(mode="after")
    def _lengths(self) -> Self:
        """Refuse edges of no length."""
        if len(self.onto) not in (1, 3) or not all(any(axis) for axis in (self.half, *self.onto)):
            raise ValueError("edge: half and onto must be vectors of some length, onto one or three of them")
        return self


class BoxSection(Section):
    """contact.box: a box of the link about `at`, which touches a box about `through`; with time stepping."""

    half: tuple[HalfAxis, HalfAxis, HalfAxis] = Field(description="half axes of the box, m, axes of the frame link")
    onto: tuple[HalfAxis, HalfAxis, HalfAxis] = Field(description="of the other box, m, axes of the frame against")
    point: Annotated[int, Field(ge=0, le=7)] = Field(
        0, description="which of the points of the two, of 0 to 7; one contact for each, in this order"
    )


class ContactSection(Section):
    """[[contact]]: a point or a round shape of a link that touches a surface of another link, or of the world."""

    name: OneLine = Field("", description="name of the contact; contact 1, contact 2 ... if left out")
    link: str = Field(description="frame that the point belongs to")
    at: Annotated[Place, BeforeValidator(_a_place)] = Field(
        (0.0, 0.0, 0.0),
        description="the point, m, axes of that frame; or a list of points, each a contact of its own; or a face, "
        "{ disc = radius } or { rectangle = [length, width] }, of which the pad of `compliance` presses; or "
        '"collision": the corners, balls, capsules, ellipsoids and rims of the collision shapes of the link',
    )
    radius: Annotated[NotNegative, PLACE] = Field(
        0.0, description="radius of a ball about the point, which rolls on the surface, m; 0: the point itself touches"
    )
    half_axes: tuple[HalfAxis, ...] | None = Field(
        None,
        description="half axes of an ellipsoid about the point, m, axes of that frame: a list of three vectors, or of "
        "two, for the edge of a disc; on a plane at rest in the frame against",
    )
    edge: EdgeSection | None = Field(
        None, description="an edge about the point, which crosses edges of the frame against"
    )
    box: BoxSection | None = Field(None, description="a box about the point, which touches a box of the frame against")
    onto: Literal["surface", "collision"] = Field(
        "surface", description='"collision": it touches the collision shapes of the link against, not its surface'
    )
    against: str = Field("world", description="frame that the surface belongs to; world: the base frame")
    normal: Direction = Field(
        (0.0, 0.0, 1.0), description="normal of the surface, towards the point, axes of the frame against; any length"
    )
    through: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="the point of the surface with that normal, m, axes of the frame against"
    )
    surface: Annotated[Surface, SURFACES] | None = Field(
        None, description="its shape, with the keys of [surface]; a plane if left out"
    )
    motion: Annotated[SurfaceMotion, MOTIONS] | None = Field(
        None, description="its motion in the frame against, with the keys of [surface_motion]; at rest if left out"
    )
    compliance: Annotated[Compliance, COMPLIANCES] | None = Field(
        None, description="its stiffness and damping, with the keys of [compliance]; rigid if left out"
    )
    friction: Annotated[NotNegative, COEFFICIENT] = Field(0.0, description="Coulomb's coefficient of friction μ, 1")
    friction_law: Annotated[SurfaceFriction, SURFACE_LAWS] | None = Field(
        None, description="another law of friction in its place, with the keys of [friction]; Coulomb's if left out"
    )
    rolling: Annotated[NotNegative, ARM] = Field(
        0.0, description="arm of the moment against rolling, m: at most this times the normal force"
    )
    pivoting: Annotated[NotNegative, ARM] = Field(
        0.0, description="arm of the moment against pivoting about the normal, m: at most this times the normal force"
    )
    restitution: Restitution = Field(
        0.0, description="coefficient of restitution, 0 to 1: of its law alone, Newton's with others"
    )
    restitution_law: Annotated[str, OneOf(RESTITUTIONS, words=(AS_IMPACT,))] = Field(
        AS_IMPACT, description=f"law of restitution where it strikes alone; {AS_IMPACT}: that of impact.law"
    )

    @model_validator(mode="after")
    def _of_one_shape(self) -> Self:
        """Refuse half axes that are none, and a shape beside those of the link."""
        if self.at == COLLISION and (self.radius or self.half_axes is not None):
            given = "radius" if self.radius else "half_axes"
            raise ValueError(f'at = "collision" takes the shapes of the link: {given} must be left out')
        if self.half_axes is not None:
            H = np.array(self.half_axes).reshape(-1, 3)
            if len(H) not in (2, 3) or np.min(np.linalg.svd(H, compute_uv=False)) < THIN * np.max(np.abs(H)):
                raise ValueError("half_axes must be two or three vectors in different directions")
        return self

    @property
    def point(self) -> tuple[float, float, float]:
        """The point, m, of a contact that is not of all collision shapes of its link."""
        assert not isinstance(self.at, str)
        return self.at

    @property
    def resists(self) -> bool:
        """Whether it has a moment against rolling or pivoting."""
        return self.rolling > 0.0 or self.pivoting > 0.0

    @property
    def rolls(self) -> bool:
        """Whether a round shape touches, and not a point."""
        return self.radius > 0.0 or self.half_axes is not None

    rest_speed: Annotated[Positive, REST_SPEED] | None = Field(
        None, description="a bounce slower than this becomes contact, m/s; impact.rest_speed if left out"
    )

    @model_validator(mode="after")
    def _one_friction(self) -> Self:
        if self.friction_law is not None and self.friction != 0.0:
            raise ValueError("friction and friction_law are both given: leave one of them out")
        return self
