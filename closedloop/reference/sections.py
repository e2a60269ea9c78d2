"""What [reference] of a scenario may say: one section for each kind of motion."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from closedloop.reference.lists import MotionInstants, Points
from closedloop.sections import LENGTH, SPEED, NotNegative, Number, Positive, Section, Size, Vector3

# More passes than this are a slip of the keyboard.
MOST_PASSES = 1000
TURNS = Size(1e6, "", "no path goes round so often", 1e-9)


def _passes(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("must be a whole number")
    if not 1 <= value <= MOST_PASSES:
        raise ValueError(f"must be between 1 and {MOST_PASSES}")
    return value


class HoldSection(Section):
    """[reference] kind = "hold": the tip stays where it starts."""

    kind: Literal["hold"] = "hold"


class LineSection(Section):
    """[reference] kind = "line": the tip runs straight along the surface."""

    kind: Literal["line"] = "line"
    direction: Vector3 = Field(description="direction of the tip's motion, base frame; any length but zero")
    speed: Annotated[Number, SPEED] = Field(
        description="tip speed, m/s, the mean one with minimum_jerk; negative runs backwards"
    )
    start: NotNegative = Field(0.5, description="instant at which the tip starts to move, s")
    stop: NotNegative = Field(description="instant at which it stops, s")
    timing: Literal["constant", "minimum_jerk"] = Field(
        "constant",
        description="constant: at constant speed, with a velocity step at either end; minimum_jerk: from rest to rest",
    )


class CircleSection(Section):
    """[reference] kind = "circle": the tip goes round in the surface, from rest to rest with minimum jerk."""

    kind: Literal["circle"] = "circle"
    direction: Vector3 = Field(
        description="direction from the tip's start to the centre, along the surface, base frame; any length but zero"
    )
    radius: Annotated[Positive, LENGTH] = Field(description="radius of the circle, m")
    turns: Annotated[Number, TURNS] = Field(
        1.0, description="how many times round; positive: counter-clockwise seen from off the surface; not zero"
    )
    start: NotNegative = Field(0.5, description="instant at which the tip starts to move, s")
    stop: NotNegative = Field(description="instant at which it stops, s")


class FigureEightSection(Section):
    """[reference] kind = "figure_eight": the tip runs an eight in the surface, from rest to rest with minimum jerk.

    It is the Lissajous figure x = (width/2) sin φ, y = (height/2) sin 2φ; the tip starts at the crossing.
    """

    kind: Literal["figure_eight"] = "figure_eight"
    direction: Vector3 = Field(description="along the eight, in the surface, base frame; any length but zero")
    width: Annotated[Positive, LENGTH] = Field(description="extent of the eight along direction, m")
    height: Annotated[Positive, LENGTH] = Field(description="extent of the eight across it, m")
    turns: Annotated[Positive, TURNS] = Field(1.0, description="how many times round the eight")
    start: NotNegative = Field(0.5, description="instant at which the tip starts to move, s")
    stop: NotNegative = Field(description="instant at which it stops, s")


class RasterSection(Section):
    """[reference] kind = "raster": the tip runs to and fro in the surface, as in polishing or scanning.

    Each pass and each step to the next is a minimum-jerk motion from rest to rest, so the corners are sharp. The time
    is shared out so that all have the same peak acceleration.
    """

    kind: Literal["raster"] = "raster"
    direction: Vector3 = Field(description="direction of the first pass, along the surface, base frame")
    length: Annotated[Positive, LENGTH] = Field(description="length of a pass, m")
    pitch: Annotated[Number, LENGTH] = Field(
        description="distance from a pass to the next, m; positive: to the left of direction seen from off the surface"
    )
    passes: Annotated[int, BeforeValidator(_passes)] = Field(description=f"how many passes, 1 to {MOST_PASSES}")
    start: NotNegative = Field(0.5, description="instant at which the tip starts to move, s")
    stop: NotNegative = Field(description="instant at which it stops, s")


class WaypointsSection(Section):
    """[reference] kind = "waypoints": straight from point to point, in space: to approach, press beyond, retract."""

    kind: Literal["waypoints"] = "waypoints"
    times: MotionInstants = Field(description="instants at which the tip is at the points, s, increasing")
    points: Points = Field(
        description="displacements of the tip from its start, m, base frame, one an instant; the first is [0, 0, 0]"
    )
    timing: Literal["minimum_jerk", "linear"] = Field(
        "minimum_jerk", description="minimum_jerk: at rest at every point; linear: constant velocity between points"
    )


Reference = Annotated[
    LineSection | HoldSection | CircleSection | FigureEightSection | RasterSection | WaypointsSection,
    Field(discriminator="kind"),
]
