"""A scenario: everything that determines a run, typed, frozen and validated (TOML in, TOML out).

    scenario = load_scenario("wam_slide", {"law.force": 15.0})

A scenario file is data: it can name a robot and numbers, never code. Unknown keys are errors; `kind` picks a variant,
or a member of a family of plug-ins (`closedloop.families`), a user's own too where an override or Python names it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from closedloop.control.drives import DrivesSection
from closedloop.control.encoder import NO_ENCODER, EncoderSection, encoder_kind
from closedloop.control.law import COMPENSATIONS, LAWS, Compensation, ControlLaw
from closedloop.control.sensor import SensorSection
from closedloop.control.transmission import TransmissionSection
from closedloop.errors import ScenarioError
from closedloop.families import KEEP_ABSENT, Family, OneOf
from closedloop.friction.law import JOINT_LAWS, SURFACE_LAWS, FrictionLaw, JointFriction, SurfaceFriction
from closedloop.impact.restitution import RESTITUTIONS
from closedloop.integrators import ADAPTIVE, INTEGRATORS
from closedloop.reference import path as paths
from closedloop.reference.force import ConstantForceSection, ForceProfile
from closedloop.scenario.file import absolute, robot_file, scenario_text
from closedloop.scenario.file import shipped_scenarios as shipped_scenarios
from closedloop.sections import (
    ANGLE,
    COEFFICIENT,
    JOINT_SPEED,
    PLACE,
    STEP,
    Direction,
    Flag,
    NotNegative,
    Number,
    PerJoint,
    Positive,
    Restitution,
    Section,
    Size,
    Unit,
    usual,
)
from closedloop.surface.compliance import COMPLIANCES, Compliance
from closedloop.surface.motion import MOTIONS, SurfaceMotion
from closedloop.surface.surface import SURFACES, Surface
from robot_models.load import names_a_file
from robot_models.toml_text import toml_tables

Coordinate = Annotated[Number, PLACE]
GRAVITY = Annotated[Number, Size(1e4, "m/s²", "no body pulls so hard")]
MASS = Size(1e6, "kg", "no arm carries so much", 1e-9)
Moment = Annotated[Number, Size(1e9, "kg m²", "no tool is so large")]
TILT = Size(1.5, "rad", "the controller would press along the surface")
FACTOR = Size(1e3, "", "no model is so wrong", 1e-3, "no model is so wrong")
REST_SPEED = Size(1e4, "m/s", "nothing bounces so fast", 1e-12, "slower motion is rounding")
DAMPING_RATIO = Size(1e6, "", "no closure is damped so", 1e-6, "nothing would die out")
TIME_CONSTANT = Size(1e300, "s", "no run lasts so long", 1e-9, "no step resolves it")
DURATION = Size(1e9, "s", "no run lasts so long", 1e-9, "no step is so short")


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
    stops: Flag = Field(False, description="joints strike hard stops at their position limits")
    stop_restitution: Restitution = Field(
        0.0, description="restitution there: of a joint alone the ratio of its speeds after and before, from 0 to 1"
    )
    lock: dict[str, Annotated[Number, ANGLE]] | None = Field(
        None, description="joints held rigid, and where, rad (m); the model's own choice if left out"
    )
    gravity: tuple[GRAVITY, GRAVITY, GRAVITY] | None = Field(
        None, description="gravity in the base frame, m/s²; the model's own if left out: of a URDF [0, 0, -9.81]"
    )


RestitutionName = Annotated[str, OneOf(RESTITUTIONS)]


class ToolSection(Section):
    """[tool]: a rigid body fixed to the tip's frame; vectors in the axes of that frame."""

    offset: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="the tool's tip, which touches the surface, m, axes of the frame robot.tip"
    )
    mass: Annotated[NotNegative, MASS] = Field(0.0, description="mass, kg")
    centre: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="centre of mass, m, axes of the frame robot.tip"
    )
    inertia: tuple[Moment, Moment, Moment, Moment, Moment, Moment] = Field(
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
        1.0, description="masses and tensors of all links as the controller has them, of the true ones, drives apart"
    )
    payload: Annotated[NotNegative, MASS] = Field(
        0.0, description="mass at the tip that the arm carries and the controller does not know of, kg"
    )
    normal: Annotated[Number, TILT] = Field(
        0.0, description="angle by which the normal that the controller believes in is tilted off the surface's, rad"
    )
    normal_towards: Annotated[Number, ANGLE] = Field(
        0.0, description="direction in which it is tilted, rad from the first tangent t1 to the second"
    )
    friction: Annotated[NotNegative, FACTOR] = Field(
        1.0, description="figures of friction as the compensation has them, of those given in [compensation]"
    )

    def tilt(self) -> NDArray[np.float64]:
        """Return the contact frame that the controller believes in (3, 3): n, t1, t2 in the axes of the true one."""
        c, s = math.cos(self.normal), math.sin(self.normal)
        a, b = math.cos(self.normal_towards), math.sin(self.normal_towards)
        # n turns towards d = a t1 + b t2 and d away from n; e = −b t1 + a t2 stays.
        n, d, e = np.array([c, s * a, s * b]), np.array([-s, c * a, c * b]), np.array([0.0, -b, a])
        return np.stack([n, a * d - b * e, b * d + a * e])


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


class ContactSection(Section):
    """[[contact]]: a point of a link that touches a plane of another link, or of the world; any number of them."""

    name: str = Field("", description="what it is called; contact 1, contact 2 ... if left out")
    link: str = Field(description="frame that the point belongs to")
    at: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="the point, m, axes of that frame"
    )
    against: str = Field("world", description="frame that the plane belongs to; world: the base frame")
    normal: Direction = Field(
        (0.0, 0.0, 1.0), description="normal of the plane, towards the point, axes of the frame against; any length"
    )
    through: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="a point of the plane, m, axes of the frame against"
    )
    friction: Annotated[NotNegative, COEFFICIENT] = Field(0.0, description="Coulomb's coefficient of friction μ, 1")
    restitution: Restitution = Field(0.0, description="Newton's coefficient of restitution, 0 to 1")


class StartSection(Section):
    """[start]: the state at t = 0."""

    q: Annotated[PerJoint, ANGLE] | None = Field(
        None, description="joint positions, rad (m); the model's home posture if left out"
    )
    v: Annotated[PerJoint, JOINT_SPEED] | None = Field(
        None, description="joint velocities, rad/s (m/s); at rest if left out"
    )
    assemble: Flag = Field(
        False, description="of a mechanism with loops: start at the closed posture nearest to start.q, however far"
    )


def _time_constant(value: Any) -> Any:
    if isinstance(value, str):
        if value != "auto":
            raise ValueError('must be a number of seconds, or "auto"')
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
    time_constant: Annotated[TimeConstant, TIME_CONSTANT] = Field(
        0.001, description='T, s, or "auto": two steps, or twice the shortest stable T where that is longer'
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


def _name(value: Any) -> Any:
    """A name becomes a folder that results are written to, so it must not lead anywhere else."""
    if isinstance(value, str) and (not value.isprintable() or set(value) & set("/\\:") or value.startswith(".")):
        raise ValueError("must be a plain name without slashes, colons or a leading dot")
    return value


Name = Annotated[str, BeforeValidator(_name)]
IntegratorName = Annotated[str, OneOf(INTEGRATORS, ADAPTIVE, words=("auto",))]

# A number of 53 bits cannot be told apart from its neighbours below 1e-16, nor an error estimate from rounding much
# above; and a loose tolerance would locate no event.
LEAST_TOLERANCE, MOST_TOLERANCE = 1e-14, 1e-3


def _tolerance(value: float) -> float:
    if not LEAST_TOLERANCE <= value <= MOST_TOLERANCE:
        raise ValueError(f"must be from {LEAST_TOLERANCE:g} to {MOST_TOLERANCE:g}")
    return value


Tolerance = Annotated[Number, AfterValidator(_tolerance), Unit("")]


class TimeSection(Section):
    """[time]: how far and in what steps."""

    duration: Annotated[Positive, DURATION] = Field(8.0, description="length of the run, s; a whole number of steps")
    step: Annotated[Positive, STEP] = Field(0.001, description="step h, s; with dop853 only the time between rows")
    integrator: IntegratorName = Field(
        "auto",
        description="semi_implicit_euler is the paper's, dop853 chooses its own steps; auto: rk4 where surface.contact "
        "is unilateral, since a scheme of order 1 shifts impacts by up to several steps, but semi_implicit_euler with "
        "a friction with states, such as lugre, and where contact is bilateral",
    )
    tolerance: Tolerance | None = Field(
        None,
        description="relative error that dop853 allows itself in each of its own steps; if left out 1e-12, and 1e-9 "
        "with friction at the tip",
    )


Stabiliser = Annotated[
    BaumgarteSection | ProjectionSection | BothSection | NoStabiliserSection,
    Field(discriminator="kind"),
    usual(BaumgarteSection),
]


class Scenario(Section):
    """Everything that determines a run; see the sections for the keys."""

    name: Name = Field("unnamed", description="the shipped name or the file's stem")
    description: str = Field("", description="one line for --list")
    robot: RobotSection = Field(RobotSection(), description="the arm, its tip, and joints held rigid")
    surface: Annotated[Surface, SURFACES] = Field(
        default_factory=lambda: SURFACES["plane"](), description="the surface, and whether the tip may leave it"
    )
    surface_motion: Annotated[SurfaceMotion, MOTIONS] = Field(
        default_factory=lambda: MOTIONS["none"](), description="how the surface moves"
    )
    tool: ToolSection = Field(ToolSection(), description="a tool on the tip: where its tip is, and its mass")
    model_error: ModelErrorSection = Field(ModelErrorSection(), description="what the controller is wrong about")
    compliance: Annotated[Compliance, COMPLIANCES] = Field(
        default_factory=lambda: COMPLIANCES["none"](), description="how the surface gives way, if it is soft"
    )
    impact: ImpactSection = Field(ImpactSection(), description="how the tip bounces, where it may leave the surface")
    contact: tuple[ContactSection, ...] | None = Field(
        None, description="contacts of the robot's links besides the tip's, each with a plane of a link or of the world"
    )
    start: StartSection = Field(StartSection(), description="the posture and the velocity at t = 0")
    reference: Annotated[paths.Path, paths.PATHS] = Field(
        default_factory=lambda: paths.PATHS["hold"](), description="the path that the tip is to follow"
    )
    law: Annotated[ControlLaw, LAWS] = Field(description="the control law, its gains, and the force to press with")
    compensation: Annotated[Compensation, COMPENSATIONS] = Field(
        default_factory=lambda: COMPENSATIONS["none"](), description="what the controller does against friction"
    )
    sensor: SensorSection = Field(SensorSection(), description="the force sensor: noise, bias, delay, resolution")
    encoder: EncoderSection = Field(EncoderSection(), description="what the controller measures of the joints")
    transmission: TransmissionSection = Field(
        TransmissionSection(), description="elastic joints: stiffness, damping and motor inertia"
    )
    drives: DrivesSection = Field(DrivesSection(), description="the joints' drives: limits of torque and of its rate")
    friction: Annotated[SurfaceFriction, SURFACE_LAWS] = Field(
        default_factory=lambda: SURFACE_LAWS["none"](), description="friction between tip and surface"
    )
    joint_friction: Annotated[JointFriction, JOINT_LAWS] = Field(
        default_factory=lambda: JOINT_LAWS["none"](), description="friction in the joints"
    )
    force_profile: ForceProfile = Field(ConstantForceSection(), description="the desired force over time")
    stabiliser: Stabiliser = Field(BaumgarteSection(), description="what keeps the closure error small")
    time: TimeSection = Field(TimeSection(), description="duration, step and integrator")

    @model_validator(mode="after")
    def _choose_integrator(self) -> Self:
        """Replace "auto" by a scheme, so that a scenario states the integrator of its run."""
        if self.time.integrator == "auto":
            # The states of friction are stiff: the semi-implicit scheme takes them exactly, rk4 does not at such steps.
            laws = (self.friction, self.joint_friction)
            stiff = any(isinstance(law, FrictionLaw) and law.has_states() for law in laws)
            chosen = "rk4" if self.surface.contact == "unilateral" and not stiff else "semi_implicit_euler"
            self.__dict__["time"] = self.time.model_copy(update={"integrator": chosen})
        return self

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
    return found


def load_scenario(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario and check it.

    Parameters
    ----------
    name : str or Path
        A shipped name (see `shipped_scenarios`) or a path to a .toml file.
    overrides : mapping, optional
        Dotted keys and values laid over the file before it is checked, such as ``{"law.force": 15.0}``. Overriding a
        `kind` drops the keys of the old kind that the new one does not know, if the file has them: of those given here
        none is dropped. A user's class is named here, as ``{"reference.kind": "my_module:MyPath"}`` or by the class
        itself.

    Raises
    ------
    ScenarioError
        If there is no such scenario, or the file or an override is at fault; names the key, the value and the cure,
        of each fault on a line of its own.
    """
    text, stem, where, folder = scenario_text(name)
    return parse_scenario(text, stem, where, overrides, folder=folder)


def parse_scenario(
    text: str, stem: str = "unnamed", where: str = "scenario", overrides: Mapping[str, Any] | None = None,
    *, keep_absent: bool = False, folder: Path | None = None,
) -> Scenario:  # fmt: skip
    """Read a scenario from TOML text; `where` names its origin in messages. See `load_scenario`.

    A robot's file is looked up from `folder`, that of the scenario's own file, if it has one. With `keep_absent` a
    user's class not named in this process is kept as it is, for inspection and not to be run: see
    `closedloop.families.Absent`.
    """
    try:
        data = toml_tables(text)
    except ValueError as error:
        raise ScenarioError(f"{where}: not valid TOML: {error}") from None
    data.setdefault("name", stem)
    robot = data.get("robot")
    given = {"robot", "robot.model"} & (overrides or {}).keys()
    if folder is not None and isinstance(robot, dict) and "model" in robot and not given:
        robot["model"] = robot_file(robot["model"], folder, where)
    return scenario_of(data, where, overrides or {}, keep_absent=keep_absent)


def scenario_of(
    data: dict[str, Any], where: str, overrides: Mapping[str, Any], *, keep_absent: bool = False
) -> Scenario:
    """Check a scenario given as the tables of its file; `data` is written to. See `parse_scenario`."""
    try:
        for key in sorted(_standing(overrides), key=_turn):
            _override(data, key, deepcopy(overrides[key]))
        return Scenario.model_validate(data, context={KEEP_ABSENT: keep_absent})
    except RecursionError:
        raise ScenarioError(f"{where}: a value is nested too deeply") from None
    except ValidationError as error:
        from closedloop.scenario.messages import explain

        raise ScenarioError(*(f"{where}: {fault}" for fault in explain(error, data))) from None


def _standing(overrides: Mapping[str, Any]) -> list[str]:
    """Return the keys that stand, in the order given: a section given whole replaces the keys of it given before."""
    standing: list[str] = []
    for key in overrides:
        standing = [before for before in standing if not before.startswith(f"{key}.")]
        standing.append(key)
    return standing


def _turn(key: str) -> int:
    """Return when a key is laid over the file: sections before kinds, and kinds, which drop keys, before others."""
    return 2 if not key.endswith(".kind") and "." in key else int("." in key)


def _override(data: dict[str, Any], key: str, value: Any) -> None:
    parts = key.split(".")
    section = data
    if key == "robot.model" and isinstance(value, str) and names_a_file(value):
        value = absolute(value)
    if family := families().get(key):
        value = family.named(value, key)
    elif isinstance(value, dict) and (family := families().get(f"{key}.kind")) and "kind" in value:
        value["kind"] = family.named(value["kind"], f"{key}.kind")
    for part in parts[:-1]:
        section = section.setdefault(part, {})
        if not isinstance(section, dict):
            raise ScenarioError(f"{key}: '{part}' is not a section")
    if parts[-1] == "kind" and len(parts) == 2 and isinstance(value, str) and section.get("kind") != value:
        from closedloop.scenario.messages import variant_keys

        known = variant_keys(parts[0], value)
        for stale in [k for k in section if k not in known]:
            del section[stale]
    section[parts[-1]] = value
