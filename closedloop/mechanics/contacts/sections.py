"""What happens where bodies touch: [impact], how the tip bounces, and [[contact]], contacts of other points."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from closedloop.base.families import OneOf
from closedloop.base.sections import (
    COEFFICIENT,
    Coordinate,
    Direction,
    NotNegative,
    Positive,
    Restitution,
    Section,
    Size,
)
from closedloop.mechanics.impact.restitution import RESTITUTIONS
from closedloop.mechanics.surface.compliance import COMPLIANCES, Compliance
from closedloop.mechanics.surface.motion import MOTIONS, SurfaceMotion
from closedloop.mechanics.surface.surface import SURFACES, Surface

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
        1e-4, description="a bounce slower than this becomes contact, m/s"
    )


def _one_line(value: Any) -> Any:
    """A name stands in headers and comments of the files that are written, so nothing in it ends a line."""
    if isinstance(value, str) and not value.isprintable():
        raise ValueError("must be a name on one line, of characters that can be printed")
    return value


OneLine = Annotated[str, BeforeValidator(_one_line)]


class ContactSection(Section):
    """[[contact]]: a point of a link that touches a surface of another link, or of the world; any number of them."""

    name: OneLine = Field("", description="name of the contact; contact 1, contact 2 ... if left out")
    link: str = Field(description="frame that the point belongs to")
    at: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="the point, m, axes of that frame; or a list of points, each a contact of its own"
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
        None, description="how it gives way, as [compliance] says it; not at all if left out"
    )
    friction: Annotated[NotNegative, COEFFICIENT] = Field(0.0, description="Coulomb's coefficient of friction μ, 1")
    restitution: Restitution = Field(
        0.0, description="coefficient of restitution, 0 to 1: of its law alone, Newton's with others"
    )
    restitution_law: Annotated[str, OneOf(RESTITUTIONS, words=(AS_IMPACT,))] = Field(
        AS_IMPACT, description=f"law of restitution where it strikes alone; {AS_IMPACT}: that of impact.law"
    )
