"""The arm of a scenario: [robot], the [tool] on its tip, and [model_error], what its controller is wrong about."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from closedloop.base.sections import (
    ANGLE,
    PLACE,
    Coordinate,
    Direction,
    Flag,
    NotNegative,
    Number,
    Positive,
    Restitution,
    Section,
    Size,
)

GRAVITY = Annotated[Number, Size(1e4, "m/s²", "no body pulls so hard")]
MASS = Size(1e6, "kg", "no arm carries so much", 1e-9)
TensorEntry = Annotated[Number, Size(1e9, "kg m²", "no tool is so large")]
TILT = Size(1.5, "rad", "the controller would press along the surface")
FACTOR = Size(1e3, "", "no model is so wrong", 1e-3, "no model is so wrong")


class RobotSection(Section):
    """[robot]: the arm."""

    model: str = Field(
        "wam4",
        description="shipped name, example-robot-data name, or a .urdf or MJCF .xml path, in a file from the file's "
        "own folder, on the command line from the current one",
    )
    tip: str | None = Field(None, description="frame that touches the surface; the model's own tip if left out")
    drive_inertia: Flag = Field(True, description="add the drives' inertia (armature) to the mass matrix")
    friction: Flag = Field(
        False,
        description="let the damping and friction of the URDF's <dynamics> act in the joints, as viscous coefficients "
        "and Coulomb torques: the law coulomb_viscous of joint_friction, which must be left out then",
    )
    stops: Flag = Field(
        False,
        description="joints strike hard stops at their position limits; limits of loop joints are stops in any case",
    )
    stop_restitution: Restitution = Field(
        0.0, description="restitution there: of a joint alone the ratio of its speeds after and before, from 0 to 1"
    )
    lock: dict[str, Annotated[Number, ANGLE]] | None = Field(
        None, description="joints held rigid, and where, rad (m); the model's own choice if left out"
    )
    gravity: tuple[GRAVITY, GRAVITY, GRAVITY] | None = Field(
        None, description="gravity in the base frame, m/s²; the model's own if left out: of a URDF [0, 0, -9.81]"
    )


class ToolSection(Section):
    """[tool]: a rigid body fixed to the tip's frame; vectors in the axes of that frame."""

    offset: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="the tool's tip, which touches the surface, m, axes of the frame robot.tip"
    )
    mass: Annotated[NotNegative, MASS] = Field(0.0, description="mass, kg")
    centre: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="centre of mass, m, axes of the frame robot.tip"
    )
    inertia: tuple[TensorEntry, TensorEntry, TensorEntry, TensorEntry, TensorEntry, TensorEntry] = Field(
        (0.0,) * 6, description="tensor about the centre of mass, kg m²: xx, yy, zz, xy, xz, yz"
    )
    radius: Annotated[NotNegative, PLACE] = Field(
        0.0,
        description="radius of the tool's round end at its tip, m, 0 of a point: a path through a narrower hollow of "
        "the surface is refused; nothing else depends on it",
    )
    axis: Direction = Field(
        (0.0, 0.0, 1.0), description="axis of the tool, out of it at its tip, axes of the frame robot.tip; any length"
    )


class ModelErrorSection(Section):
    """[model_error]: what the controller is wrong about; the arm is that of [robot] and [tool]."""

    masses: Annotated[Positive, FACTOR] = Field(
        1.0, description="ratio of the controller's to the true masses and inertias of all links, without drives"
    )
    payload: Annotated[NotNegative, MASS] = Field(
        0.0, description="mass at the tip that the arm carries and the controller's model does not have, kg"
    )
    normal: Annotated[Number, TILT] = Field(
        0.0, description="angle between the controller's normal and the true normal of the surface, rad"
    )
    normal_towards: Annotated[Number, ANGLE] = Field(
        0.0, description="direction in which it is tilted, rad from the first tangent t1 to the second"
    )
    friction: Annotated[NotNegative, FACTOR] = Field(
        1.0, description="factor of the friction values of [compensation], as the controller uses them"
    )

    def tilt(self) -> NDArray[np.float64]:
        """Return the contact frame that the controller believes in (3, 3): n, t1, t2 in the axes of the true one."""
        c, s = math.cos(self.normal), math.sin(self.normal)
        a, b = math.cos(self.normal_towards), math.sin(self.normal_towards)
        # n turns towards d = a t1 + b t2 and d away from n; e = −b t1 + a t2 stays.
        n, d, e = np.array([c, s * a, s * b]), np.array([-s, c * a, c * b]), np.array([0.0, -b, a])
        return np.stack([n, a * d - b * e, b * d + a * e])
