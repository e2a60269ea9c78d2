"""The robot of a scenario: [robot], its [tool], free [[body]], [[external_force]], [belief] and [model_error]."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from closedloop.base.sections import (
    ANGLE,
    FORCE,
    JOINT_SPEED,
    LENGTH,
    PERIOD,
    PLACE,
    SPEED,
    TORQUE,
    Coordinate,
    Direction,
    Flag,
    NotNegative,
    Number,
    OneLine,
    Positive,
    Restitution,
    Section,
    Size,
)
from closedloop.control.sensor import Seed
from closedloop.mechanics.surface.motion import MOTIONS, SurfaceMotion
from closedloop.mechanics.surface.surface import SURFACES, Surface

# The model of a scenario that has free bodies alone.
NO_ROBOT = "none"
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
        "own folder, on the command line from the current one; none: each [[body]] alone",
    )
    tip: str | None = Field(None, description="frame that touches the surface; the model's own tip if left out")
    drive_inertia: Flag = Field(True, description="add the drives' inertia (armature) to the mass matrix")
    friction: Flag = Field(
        False,
        description="let the damping and friction of the robot's file act in the joints, as viscous coefficients "
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
        None,
        description="joints held rigid, and where, rad (m), a free or ball joint as the file has it, at 0; the model's "
        "own choice if left out",
    )
    gravity: tuple[GRAVITY, GRAVITY, GRAVITY] | None = Field(
        None, description="gravity in the base frame, m/s²; the model's own if left out: of a URDF [0, 0, -9.81]"
    )


class ToolSection(Section):
    """[tool]: a rigid body fixed to the tip's frame; vectors in the axes of that frame."""

    offset: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0),
        description="the tool's tip, which touches the surface, or the centre of its round end, m, axes of the frame "
        "robot.tip",
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
        description="radius of the tool's round end about its tip, m, 0 of a point: the ball touches the surface, "
        "and a path through a narrower hollow of it is refused",
    )
    axis: Direction = Field(
        (0.0, 0.0, 1.0), description="axis of the tool, out of it at its tip, axes of the frame robot.tip; any length"
    )


Edge = Annotated[Positive, LENGTH]
Velocity = Annotated[Number, SPEED]
Spin = Annotated[Number, JOINT_SPEED]
# Which keys say how large a shape is.
MEASURES = {"box": ("edges",), "ball": ("radius",), "cylinder": ("radius", "length")}


class BodySection(Section):
    """[[body]]: a rigid body beside the robot, which moves freely; its origin is the middle of its shape."""

    name: OneLine = Field(description="name of its link, which [[contact]] refers to")
    shape: Literal["box", "ball", "cylinder"] = Field(description="its shape, drawn and in collisions")
    edges: tuple[Edge, Edge, Edge] | None = Field(None, description="of a box: lengths along its axes x, y, z, m")
    radius: Edge | None = Field(None, description="of a ball or a cylinder, m")
    length: Edge | None = Field(None, description="of a cylinder, along its axis z, m")
    mass: Annotated[Positive, MASS] = Field(description="mass, kg; its centre is the origin")
    inertia: tuple[TensorEntry, TensorEntry, TensorEntry, TensorEntry, TensorEntry, TensorEntry] | None = Field(
        None, description="tensor, kg m²: xx, yy, zz, xy, xz, yz; that of uniform density if left out"
    )
    position: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="of the origin at the start, m, base frame"
    )
    quaternion: tuple[Number, Number, Number, Number] = Field(
        (1.0, 0.0, 0.0, 0.0), description="orientation at the start: w, x, y, z, of any length"
    )
    velocity: tuple[Velocity, Velocity, Velocity] = Field(
        (0.0, 0.0, 0.0), description="of the origin at the start, m/s, axes of the base frame"
    )
    spin: tuple[Spin, Spin, Spin] = Field(
        (0.0, 0.0, 0.0), description="angular velocity at the start, rad/s, axes of the body"
    )

    @model_validator(mode="after")
    def _measured(self) -> Self:
        """Ask for the lengths of the shape, and for no others."""
        needed = MEASURES[self.shape]
        for key in ("edges", "radius", "length"):
            if (getattr(self, key) is None) == (key in needed):
                given = "is missing" if key in needed else "must be left out"
                raise ValueError(f"{key} {given}: the size of a {self.shape} is {' and '.join(needed)}")
        if not any(self.quaternion):
            raise ValueError("quaternion has length zero: [1, 0, 0, 0] does not turn")
        return self

    @property
    def size(self) -> tuple[float, ...]:
        """What `robot_models.bodies.FreeBody` calls its size, m."""
        values = (getattr(self, key) for key in MEASURES[self.shape])
        return tuple(x for value in values for x in (value if isinstance(value, tuple) else (value,)))


Force = Annotated[Number, FORCE]
Moment = Annotated[Number, TORQUE]
Instant = Annotated[NotNegative, PERIOD]


class ExternalForceSection(Section):
    """[[external_force]]: a force and a moment from outside on a point of the robot, of which the law does not know."""

    link: str | None = Field(
        None, description="frame that has the point; if left out the tip, where the force sensor feels it"
    )
    at: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="the point, m, axes of that frame"
    )
    force: tuple[Force, Force, Force] = Field((0.0, 0.0, 0.0), description="force at the point, N")
    moment: tuple[Moment, Moment, Moment] = Field((0.0, 0.0, 0.0), description="moment, N m")
    axes: str = Field("world", description="frame whose axes force and moment are in; world: the base frame")
    start: Instant = Field(0.0, description="instant at which it begins, s")
    duration: Annotated[Positive, PERIOD] | None = Field(
        None, description="how long it acts, s; to the end of the run if left out"
    )

    def place(self, tip: str, offset: tuple[float, float, float]) -> tuple[str, tuple[float, ...]]:
        """Return the frame and the point of it, m; the tool's tip is at `offset`, m, in the frame `tip`."""
        if self.link is not None:
            return self.link, self.at
        return tip, tuple(a + b for a, b in zip(self.at, offset, strict=True))

    def shares(self, since: NDArray[np.float64], h: float) -> NDArray[np.float64]:
        """Return the share of the steps of h that begin at these instants, s, in which the force is there."""
        inside = np.minimum(self.end, since + h) - np.maximum(self.start, since)
        return np.maximum(inside, 0.0) / h

    @property
    def end(self) -> float:
        """Instant at which it ends, s."""
        return math.inf if self.duration is None else self.start + self.duration


class MocapSection(Section):
    """[[mocap]]: a frame that moves as it is told, and what loop joints hold onto it."""

    frame: str = Field(description="a frame that is fixed to the world, as a mocap body of an MJCF is")
    motion: Annotated[SurfaceMotion, MOTIONS] = Field(
        description="how it moves from where it is fixed, with the keys of [surface_motion], base frame"
    )


class BeliefSection(Section):
    """[belief]: the surface that path, law and compensation take for the true one; what is left out is as it is."""

    surface: Annotated[Surface, SURFACES] | None = Field(
        None, description="the surface that the controller believes in, with the keys of [surface]"
    )
    surface_motion: Annotated[SurfaceMotion, MOTIONS] | None = Field(
        None, description="how the controller believes that it moves, with the keys of [surface_motion]"
    )
    normal_noise: Annotated[NotNegative, TILT] = Field(
        0.0,
        description="standard deviation of the tilt of the normal that it believes in about either tangent, rad, drawn "
        "anew at each step",
    )
    seed: Seed = Field(0, description="seed of that noise")

    def draws(self, count: int) -> NDArray[np.float64]:
        """Return the tilts (count, 2), rad, one row a step."""
        return self.normal_noise * np.random.default_rng(self.seed).standard_normal((count, 2))

    @property
    def differs(self) -> bool:
        """Whether anything is said of a surface other than the true one."""
        return self.surface is not None or self.surface_motion is not None


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
        0.0, description="direction of the tilt, rad from the first tangent t1 to the second"
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
