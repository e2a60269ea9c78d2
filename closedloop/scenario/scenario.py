"""A scenario: everything that determines a run, typed, frozen and validated; `to_toml` writes it as TOML.

A scenario is data: it can name a robot and numbers, never code. `closedloop.scenario.load` reads one.
"""

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from closedloop.base.families import Absent, Family, OneOf
from closedloop.base.sections import (
    ANGLE,
    JOINT_SPEED,
    STEP,
    Flag,
    NotNegative,
    Number,
    PerJoint,
    Positive,
    Section,
    Size,
    Unit,
    usual,
)
from closedloop.base.upwards import called
from closedloop.control.drives import DrivesSection, TransmissionSection
from closedloop.control.law import COMPENSATIONS, LAWS, Compensation, ControlLaw
from closedloop.control.reference import path as paths
from closedloop.control.reference.force import ConstantForceSection, ForceProfile
from closedloop.control.sensor import NO_ENCODER, EncoderSection, SensorSection, encoder_kind
from closedloop.mechanics.contacts.sections import ContactSection, ImpactSection
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS, FrictionLaw, JointFriction, SurfaceFriction
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.mechanics.surface.motion import MOTIONS, SurfaceMotion
from closedloop.mechanics.surface.surface import COMPLIANCES, SURFACES, Compliance, Surface
from closedloop.scenario.robot_sections import (
    BeliefSection,
    BodySection,
    ExternalForceSection,
    MocapSection,
    ModelErrorSection,
    RobotSection,
    ToolSection,
)

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
        None,
        description="contacts of the robot's links, in addition to the tip's",
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
