"""A scenario: everything that determines a run, typed, frozen and validated; `to_toml` writes it as TOML.

A scenario is data: it can name a robot and numbers, never code. `closedloop.scenario.load` reads one.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from closedloop.base.families import Absent, Family, OneOf
from closedloop.base.sections import (
    ANGLE,
    FORCE,
    JOINT_SPEED,
    LENGTH,
    PERIOD,
    PLACE,
    SPEED,
    STEP,
    TORQUE,
    Coordinate,
    Direction,
    Flag,
    NotNegative,
    Number,
    OneLine,
    PerJoint,
    Positive,
    Restitution,
    Section,
    Size,
    Unit,
    usual,
)
from closedloop.base.upwards import called
from closedloop.control.drives import DrivesSection, TransmissionSection
from closedloop.control.law import COMPENSATIONS, LAWS, Compensation, ControlLaw
from closedloop.control.reference import path as paths
from closedloop.control.reference.path import ConstantForceSection, ForceProfile
from closedloop.control.sensor import NO_ENCODER, EncoderSection, Seed, SensorSection, encoder_kind
from closedloop.mechanics.contacts.sections import ContactSection, ImpactSection
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS, FrictionLaw, JointFriction, SurfaceFriction
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.mechanics.surface.motion import MOTIONS, SurfaceMotion
from closedloop.mechanics.surface.surface import COMPLIANCES, SURFACES, Compliance, Surface

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


DURATION = Size(1e9, "s", "no run lasts so long", 1e-9, "no step is so short")
IntegratorName = Annotated[str, OneOf(INTEGRATORS, ADAPTIVE, words=("auto",))]

# A number of 53 bits cannot be told apart from its neighbours below 1e-16, nor an error estimate from rounding much
# above; and a loose tolerance would locate no event.
LEAST_TOLERANCE, MOST_TOLERANCE = 1e-14, 1e-3


def _tolerance(value: float) -> float:
    if not LEAST_TOLERANCE <= value <= MOST_TOLERANCE:
        raise ValueError(f"must be from {LEAST_TOLERANCE:g} to {MOST_TOLERANCE:g}")
    return value


Tolerance = Annotated[Number, AfterValidator(_tolerance), Unit("")]


class StartSection(Section):
    """[start]: the state at t = 0."""

    q: Annotated[PerJoint, ANGLE] | None = Field(
        None,
        description="joint positions, rad (m), of a free joint x y z and the quaternion w x y z, in the order of "
        "coordinate_names: of a URDF by the joints' names, not as in the file; the model's home posture if left out",
    )
    v: Annotated[PerJoint, JOINT_SPEED] | None = Field(
        None, description="joint velocities, rad/s (m/s); at rest if left out"
    )
    assemble: Flag = Field(
        False, description="of a mechanism with loops: start at the closed posture nearest to start.q, however far"
    )


class TimeSection(Section):
    """[time]: how far and in what steps."""

    duration: Annotated[Positive, DURATION] = Field(8.0, description="length of the run, s; a whole number of steps")
    step: Annotated[Positive, STEP] = Field(0.001, description="step h, s; with dop853 only the time between rows")
    integrator: IntegratorName = Field(
        "auto",
        description="semi_implicit_euler is the paper's, dop853 chooses its own steps, time_stepping is for many "
        "contacts: one problem of impulses a step, no events; auto: rk4 where surface.contact is unilateral, "
        "since a scheme of order 1 shifts impacts by up to several steps, but semi_implicit_euler with "
        "a friction with states, such as lugre, and where contact is bilateral",
    )
    tolerance: Tolerance | None = Field(
        None,
        description="largest relative error of dop853 in each of its own steps; if left out 1e-12, and 1e-9 "
        "with friction at the tip or at soft contacts",
    )


DAMPING_RATIO = Size(1e6, "", "no closure is damped so", 1e-6, "nothing would die out")
TIME_CONSTANT = Size(1e300, "s", "no run lasts so long", 1e-9, "no step resolves it")


def _time_constant(value: Any) -> Any:
    if isinstance(value, str) and value == "auto":
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError('must be a number of seconds, or "auto"')
    if not 0 < value <= TIME_CONSTANT.most:  # compared as it is: a whole number may be too large for a float
        raise ValueError('must be greater than 0 and finite, or "auto"')
    return float(value)


TimeConstant = Annotated[float | Literal["auto"], BeforeValidator(_time_constant)]


class BaumgarteGains(Section):
    """Parameters of Baumgarte's stabiliser: s_v = 2ζ/T, s_p = 1/T²."""

    damping_ratio: Annotated[NotNegative, DAMPING_RATIO] = Field(
        0.707, description="damping ratio ζ with which the closure error dies out"
    )
    time_constant: Annotated[TimeConstant, TIME_CONSTANT] | None = Field(
        None,
        description='T, s; time.step if left out, 1 ms with dop853; "auto": two steps, or twice the shortest stable T '
        "where that is longer",
    )


class BaumgarteSection(BaumgarteGains):
    """[stabiliser] kind = "baumgarte": a spring and a damper inside Eq. 24, as in the paper."""

    kind: Literal["baumgarte"] = "baumgarte"


class ProjectionSection(Section):
    """[stabiliser] kind = "projection": position and velocity are projected onto the closure after each step."""

    kind: Literal["projection"] = "projection"


class BothSection(BaumgarteGains):
    """[stabiliser] kind = "both": Baumgarte inside the step, projection after it."""

    kind: Literal["both"] = "both"


class NoStabiliserSection(Section):
    """[stabiliser] kind = "none": the closure drifts (Fig. 7)."""

    kind: Literal["none"] = "none"


Stabiliser = Annotated[
    BaumgarteSection | ProjectionSection | BothSection | NoStabiliserSection,
    Field(discriminator="kind"),
    usual(BaumgarteSection),
]


def _name(value: Any) -> Any:
    """A name becomes a folder that results are written to, so it must not lead anywhere else."""
    if isinstance(value, str) and (not value.isprintable() or set(value) & set("/\\:") or value.startswith(".")):
        raise ValueError("must be a plain name without slashes, colons or a leading dot")
    return value


Name = Annotated[str, BeforeValidator(_name)]


class Scenario(Section):
    """Everything that determines a run; see the sections for the keys."""

    name: Name = Field("unnamed", description="the shipped name or the file's stem")
    description: str = Field("", description="one line for --list")
    robot: RobotSection = Field(RobotSection(), description="the arm, its tip, and joints held rigid")
    surface: Annotated[Surface, SURFACES] = Field(
        default_factory=lambda: SURFACES["none"](),
        description="the surface, and whether the tip may leave it; without it the tip touches nothing",
    )
    surface_motion: Annotated[SurfaceMotion, MOTIONS] = Field(
        default_factory=lambda: MOTIONS["none"](), description="how the surface moves"
    )
    tool: ToolSection = Field(ToolSection(), description="a tool on the tip: where its tip is, and its mass")
    model_error: ModelErrorSection = Field(ModelErrorSection(), description="errors of the controller's model")
    belief: BeliefSection = Field(BeliefSection(), description="the surface that the controller believes in")
    compliance: Annotated[Compliance, COMPLIANCES] = Field(
        default_factory=lambda: COMPLIANCES["none"](), description="stiffness and damping of a soft surface"
    )
    impact: ImpactSection = Field(ImpactSection(), description="how the tip bounces, where it may leave the surface")
    contact: tuple[ContactSection, ...] | None = Field(
        None, description="contacts of the robot's links, in addition to the tip's"
    )
    body: tuple[BodySection, ...] | None = Field(None, description="free bodies beside the robot")
    external_force: tuple[ExternalForceSection, ...] | None = Field(
        None, description="forces on the tip or a link from outside, of which the controller does not know"
    )
    mocap: tuple[MocapSection, ...] | None = Field(None, description="frames whose motion moves the robot")
    start: StartSection = Field(StartSection(), description="the posture and the velocity at t = 0")
    reference: Annotated[paths.Path, paths.PATHS] = Field(
        default_factory=lambda: paths.PATHS["hold"](),
        description="the path that the tip is to follow; without it a law holds the start",
    )
    law: Annotated[ControlLaw, LAWS] = Field(
        default_factory=lambda: LAWS["none"](),
        description="the control law, its gains, and the force to press with; without it there is no torque",
    )
    compensation: Annotated[Compensation, COMPENSATIONS] = Field(
        default_factory=lambda: COMPENSATIONS["none"](),
        description="what the controller adds against friction, or for an unknown normal",
    )
    sensor: SensorSection = Field(SensorSection(), description="the force sensor: noise, bias, delay, resolution")
    encoder: EncoderSection = Field(EncoderSection(), description="how the controller measures the joints")
    transmission: TransmissionSection = Field(
        TransmissionSection(), description="gears: elastic joints, backlash, friction of the load"
    )
    drives: DrivesSection = Field(DrivesSection(), description="the joints' drives: limits of torque and of its rate")
    friction: Annotated[SurfaceFriction, SURFACE_LAWS] = Field(
        default_factory=lambda: SURFACE_LAWS["none"](), description="friction between tip and surface"
    )
    joint_friction: Annotated[JointFriction, JOINT_LAWS] = Field(
        default_factory=lambda: JOINT_LAWS["none"](), description="friction in the joints; a free body has none"
    )
    force_profile: ForceProfile = Field(ConstantForceSection(), description="the desired force over time")
    stabiliser: Stabiliser = Field(BaumgarteSection(), description="what keeps the closure error small")
    time: TimeSection = Field(TimeSection(), description="duration, step and integrator")

    @model_validator(mode="after")
    def _choose_integrator(self) -> Self:
        """Replace "auto" by a scheme, so that a scenario states the integrator of its run."""
        if self.time.integrator == "auto":
            # The states of friction are stiff: the semi-implicit scheme takes them exactly, rk4 does not at such steps.
            laws = (self.friction, self.joint_friction, *(each.friction_law for each in self.contact or ()))
            stiff = any(isinstance(law, FrictionLaw) and law.has_states() for law in laws)
            chosen = "rk4" if self.surface.contact == "unilateral" and not stiff else "semi_implicit_euler"
            self.__dict__["time"] = self.time.model_copy(update={"integrator": chosen})
        return self

    @model_validator(mode="after")
    def _press_on_something(self) -> Self:
        """Let a law press with no force, where there is no surface and no force was asked for."""
        if not self.has_surface and "force" not in self.law.model_fields_set and not isinstance(self.law, Absent):
            self.__dict__["law"] = self.law.model_copy(update={"force": 0.0})
        return self

    def replace(self, changes: Mapping[str, Any] | None = None, /, **more: Any) -> "Scenario":
        """Return the scenario with other values of some keys: ``scenario.replace({"law.force": 12.0})``.

        Keys and values are as `closedloop.load_scenario` takes them; ``**{"law.force": 12.0}`` is the same.

        Raises
        ------
        ScenarioError
            If a key or a value is at fault.
        """
        replaced: Scenario = called("replace", self, {**(changes or {}), **more})
        return replaced

    @property
    def has_surface(self) -> bool:
        """Whether there is a surface that the tip may touch."""
        return self.surface.kind != "none"

    @property
    def has_law(self) -> bool:
        """Whether the scenario has a control law."""
        return self.law.kind != "none"

    @property
    def is_passive(self) -> bool:
        """Whether nothing does work on what moves: no law, force from outside or moving frame; surfaces are at rest."""
        motions = [self.surface_motion, *(each.motion for each in self.contact or ())]
        return not (self.has_law or self.external_force or self.mocap) and all(
            motion is None or motion.kind == "none" for motion in motions
        )

    @property
    def stores_energy(self) -> bool:
        """Whether something beside kinetic and potential energy stores any: soft surfaces, bristles, elastic joints."""
        contacts = self.contact or ()
        laws = (self.friction, self.joint_friction, *(each.friction_law for each in contacts))
        soft = [self.compliance, *(each.compliance for each in contacts)]
        return (
            any(each is not None and each.kind != "none" for each in soft)
            or any(isinstance(law, FrictionLaw) and law.has_states() for law in laws)
            or self.transmission.elastic
        )

    @property
    def rubs_in_joints(self) -> bool:
        """Whether there is friction in the joints."""
        return self.joint_friction.kind != "none" or self.robot.friction

    @property
    def reads_encoders(self) -> bool:
        """Whether the controller reads positions once a step, and does not see the state itself."""
        return encoder_kind(self.encoder) != NO_ENCODER or self.transmission.on_motors

    def to_toml(self) -> str:
        """Return the scenario as TOML text that `load_scenario` reads back to an equal one."""
        import tomli_w

        return tomli_w.dumps(self.model_dump(mode="python", exclude_none=True))


@cache
def families() -> dict[str, Family[Any] | OneOf]:
    """Return the keys of a scenario that pick a member of a family, such as "reference.kind", and the family."""
    found: dict[str, Family[Any] | OneOf] = {}
    for section, field in Scenario.model_fields.items():
        found |= {f"{section}.kind": each for each in field.metadata if isinstance(each, Family)}
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            for key, inner in field.annotation.model_fields.items():
                found |= {f"{section}.{key}": one for one in inner.metadata if isinstance(one, OneOf)}
            found |= {f"{section}.{key}.kind": family for key, family in families_in(field.annotation).items()}
    return found


@cache
def families_in(section: type[Section]) -> dict[str, Family[Any]]:
    """Return the keys of a section, or of a table of a list, that are sections of a family, and the family."""
    return {
        name: each
        for name, field in section.model_fields.items()
        for found in (field.metadata, *(getattr(part, "__metadata__", ()) for part in get_args(field.annotation)))
        for each in found
        if isinstance(each, Family)
    }
