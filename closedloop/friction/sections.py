"""What a scenario may say of friction: one section a law, for a surface and for joints.

    SurfaceFriction    coefficients without unit, which the normal force multiplies
    JointFriction      the same laws in N m; each parameter is one number for all joints, or one per joint

`closedloop.friction.packing.pack` turns a section into what the kernels read. The laws themselves, their
sources and the ranges of their parameters are in the files named after them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from closedloop.sections import (
    COEFFICIENT,
    JOINT_SPEED_SCALE,
    PERIOD,
    SPEED_SCALE,
    TORQUE,
    Gain,
    NotNegative,
    Positive,
    Section,
    Size,
    stiffness_in,
    viscous_in,
)

Figure = float | tuple[float, ...]


def entries(value: Figure) -> tuple[float, ...]:
    """Return one number, or one per joint, as a tuple."""
    return value if isinstance(value, tuple) else (value,)


def _each(value: Figure, least: float, cure: str) -> Figure:
    """Refuse an entry below `least`, or at it if `least` is the smallest number above 0."""
    for index, entry in enumerate(entries(value)):
        if not entry >= least:
            raise ValueError(f"entry {index} is {entry:g}: {cure}" if isinstance(value, tuple) else cure)
    return value


def _none_negative(value: Figure) -> Figure:
    return _each(value, 0.0, "must not be negative")


def _all_positive(value: Figure) -> Figure:
    return _each(value, 5e-324, "must be greater than 0")


EXPONENT = Size(1e3, "", "the curve is a step", 1e-3, "the curve is flat")
JointNotNegative = Annotated[Gain, AfterValidator(_none_negative)]
JointPositive = Annotated[Gain, AfterValidator(_all_positive)]

Coefficient = Annotated[NotNegative, COEFFICIENT]
PositiveCoefficient = Annotated[Positive, COEFFICIENT]
Viscous = Annotated[NotNegative, viscous_in("N s/m")]
Damping = Annotated[NotNegative, viscous_in("s/m")]
SlipSpeed = Annotated[Positive, SPEED_SCALE]
Stiffness = Annotated[Positive, stiffness_in("1/m")]
Exponent = Annotated[Positive, EXPONENT]
Span = Annotated[NotNegative, PERIOD]
Torque = Annotated[JointNotNegative, TORQUE]
PositiveTorque = Annotated[JointPositive, TORQUE]
JointViscous = Annotated[JointNotNegative, viscous_in("N m s/rad")]
JointSpeed = Annotated[JointPositive, JOINT_SPEED_SCALE]
JointStiffness = Annotated[JointPositive, stiffness_in("N m/rad")]
JointExponent = Annotated[JointPositive, EXPONENT]
JointSpan = Annotated[JointNotNegative, PERIOD]


def _not_below(static: Figure, kinetic: Figure) -> None:
    """Refuse a static level below the kinetic one; lists must be of one length."""
    levels, floors = entries(static), entries(kinetic)
    count = max(len(levels), len(floors))
    if len(levels) not in (1, count) or len(floors) not in (1, count):
        raise ValueError(f"must have as many entries as kinetic, {len(floors)}")
    for index in range(count):
        a, b = levels[index % len(levels)], floors[index % len(floors)]
        if a < b:
            place = f"entry {index} is {a:g}: " if count > 1 else ""
            raise ValueError(f"{place}must not be below kinetic, {b:g}: static friction is the larger")


class Law(Section):
    """What all sections of friction share."""

    @field_validator("static", check_fields=False)
    @classmethod
    def _static_is_the_larger(cls, value: Figure, info: ValidationInfo) -> Figure:
        if "kinetic" in info.data:  # else it is at fault itself
            _not_below(value, info.data["kinetic"])
        return value


class JointLaw(Law):
    """What all sections of friction in joints share."""


class NoFriction(Law):
    """kind = "none": no friction."""

    kind: Literal["none"] = "none"


class SurfaceCoulomb(Law):
    """kind = "coulomb": of one size, against the slip."""

    kind: Literal["coulomb"] = "coulomb"
    coefficient: Coefficient = Field(description="coefficient of friction μ, static and kinetic, 1")


class SurfaceCoulombViscous(Law):
    """kind = "coulomb_viscous": Coulomb's, and a force proportional to the slip."""

    kind: Literal["coulomb_viscous"] = "coulomb_viscous"
    coefficient: Coefficient = Field(description="coefficient of friction μ, static and kinetic, 1")
    viscous: Viscous = Field(description="viscous coefficient b, N s/m, whatever the normal force")


class SurfaceStribeck(Law):
    """kind = "stribeck": falls from its static to its kinetic level as slip gets faster."""

    kind: Literal["stribeck"] = "stribeck"
    kinetic: Coefficient = Field(description="kinetic coefficient of friction μ_k, 1")
    static: Coefficient = Field(description="static coefficient of friction μ_s, 1; not below kinetic")
    stribeck_speed: SlipSpeed = Field(description="slip speed v_s of the fall from static to kinetic, m/s")
    exponent: Exponent = Field(2.0, description="exponent δ of the Stribeck curve; 2: Gaussian, 1: exponential")
    viscous: Viscous = Field(0.0, description="viscous coefficient b, N s/m, whatever the normal force")


class SurfaceKarnopp(Law):
    """kind = "karnopp": slip within a band of speeds counts as none."""

    kind: Literal["karnopp"] = "karnopp"
    kinetic: Coefficient = Field(description="kinetic coefficient of friction μ_k, 1")
    static: Coefficient = Field(description="static coefficient of friction μ_s, 1; not below kinetic")
    dead_band: SlipSpeed = Field(description="slip speed D_v up to which the tip may be held, m/s")
    viscous: Viscous = Field(0.0, description="viscous coefficient b, N s/m, whatever the normal force")


class SurfaceDahl(Law):
    """kind = "dahl": an elastic bristle that yields at the Coulomb level."""

    kind: Literal["dahl"] = "dahl"
    coefficient: PositiveCoefficient = Field(description="coefficient of friction μ, 1")
    stiffness: Stiffness = Field(description="bristle stiffness σ_0 per newton of normal force, 1/m")
    viscous: Viscous = Field(0.0, description="viscous coefficient b, N s/m, whatever the normal force")


class SurfaceLuGre(Law):
    """kind = "lugre": damped bristles that yield at the Stribeck curve."""

    kind: Literal["lugre"] = "lugre"
    kinetic: PositiveCoefficient = Field(description="kinetic coefficient of friction μ_k, 1")
    static: PositiveCoefficient = Field(description="static coefficient of friction μ_s, 1; not below kinetic")
    stribeck_speed: SlipSpeed = Field(description="slip speed v_s of the fall from static to kinetic, m/s")
    exponent: Exponent = Field(2.0, description="exponent δ of the Stribeck curve; 2 as published")
    stiffness: Stiffness = Field(description="bristle stiffness σ_0 per newton of normal force, 1/m")
    damping: Damping = Field(description="bristle damping σ_1 per newton of normal force, s/m")
    damping_speed: SlipSpeed | None = Field(
        None, description="slip speed v_d of σ_1 exp(−(u/v_d)²), m/s; constant damping, as published, if left out"
    )
    viscous: Viscous = Field(0.0, description="viscous coefficient σ_2, N s/m, whatever the normal force")


class SurfaceSevenParameter(Law):
    """kind = "seven_parameter": static friction that rises with rest, friction that lags the slip."""

    kind: Literal["seven_parameter"] = "seven_parameter"
    kinetic: Coefficient = Field(description="Coulomb level F_C per newton of normal force, 1")
    static_excess: Coefficient = Field(description="F_S∞: static level after a long rest, less F_C, 1")
    stribeck_speed: SlipSpeed = Field(description="slip speed v_s at which half the excess is left, m/s")
    stiffness: Stiffness = Field(description="stiffness k_t while stuck per newton of normal force, 1/m")
    memory_delay: Span = Field(description="τ_L: by how much the friction lags the slip, s")
    rise_time: Span = Field(description="γ: dwell time after which static friction has half risen, s")
    viscous: Viscous = Field(0.0, description="viscous coefficient F_v, N s/m, whatever the normal force")


class JointCoulomb(JointLaw):
    """kind = "coulomb": of one size, against the motion."""

    kind: Literal["coulomb"] = "coulomb"
    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")


class JointCoulombViscous(JointLaw):
    """kind = "coulomb_viscous": Coulomb's, and a torque proportional to the joint velocity."""

    kind: Literal["coulomb_viscous"] = "coulomb_viscous"
    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    viscous: JointViscous = Field(description="viscous coefficient, N m s/rad")


class JointStribeck(JointLaw):
    """kind = "stribeck": falls from its static to its kinetic level as the joint gets faster."""

    kind: Literal["stribeck"] = "stribeck"
    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    static: Torque = Field(description="static (break-away) torque, N m; not below kinetic")
    stribeck_speed: JointSpeed = Field(description="joint speed of the fall from static to kinetic, rad/s")
    exponent: JointExponent = Field(2.0, description="exponent δ of the Stribeck curve; 2: Gaussian, 1: exponential")
    viscous: JointViscous = Field(0.0, description="viscous coefficient, N m s/rad")


class JointKarnopp(JointLaw):
    """kind = "karnopp": motion within a band of speeds counts as none."""

    kind: Literal["karnopp"] = "karnopp"
    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    static: Torque = Field(description="static (break-away) torque, N m; not below kinetic")
    dead_band: JointSpeed = Field(description="joint speed up to which the joint may be held, rad/s")
    viscous: JointViscous = Field(0.0, description="viscous coefficient, N m s/rad")


class JointDahl(JointLaw):
    """kind = "dahl": an elastic bristle that yields at the Coulomb level."""

    kind: Literal["dahl"] = "dahl"
    kinetic: PositiveTorque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    stiffness: JointStiffness = Field(description="bristle stiffness σ_0, N m/rad")
    viscous: JointViscous = Field(0.0, description="viscous coefficient, N m s/rad")


class JointLuGre(JointLaw):
    """kind = "lugre": damped bristles that yield at the Stribeck curve."""

    kind: Literal["lugre"] = "lugre"
    kinetic: PositiveTorque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    static: PositiveTorque = Field(description="static (break-away) torque, N m; not below kinetic")
    stribeck_speed: JointSpeed = Field(description="joint speed of the fall from static to kinetic, rad/s")
    exponent: JointExponent = Field(2.0, description="exponent δ of the Stribeck curve; 2 as published")
    stiffness: JointStiffness = Field(description="bristle stiffness σ_0, N m/rad")
    damping: JointViscous = Field(description="bristle damping σ_1, N m s/rad")
    damping_speed: JointSpeed | None = Field(
        None, description="joint speed v_d of σ_1 exp(−(u/v_d)²), rad/s; constant damping, as published, if left out"
    )
    viscous: JointViscous = Field(0.0, description="viscous coefficient σ_2, N m s/rad")


class JointSevenParameter(JointLaw):
    """kind = "seven_parameter": static friction that rises with rest, friction that lags the motion."""

    kind: Literal["seven_parameter"] = "seven_parameter"
    kinetic: Torque = Field(description="kinetic (Coulomb) torque F_C, N m, one per joint or one for all")
    static_excess: Torque = Field(description="F_S∞: static torque after a long rest, less F_C, N m")
    stribeck_speed: JointSpeed = Field(description="joint speed v_s at which half the excess is left, rad/s")
    stiffness: JointStiffness = Field(description="stiffness k_t while stuck, N m/rad")
    memory_delay: JointSpan = Field(description="τ_L: by how much the friction lags the motion, s")
    rise_time: JointSpan = Field(description="γ: dwell time after which static friction has half risen, s")
    viscous: JointViscous = Field(0.0, description="viscous coefficient F_v, N m s/rad")


SurfaceFriction = Annotated[
    NoFriction
    | SurfaceCoulomb
    | SurfaceCoulombViscous
    | SurfaceStribeck
    | SurfaceKarnopp
    | SurfaceDahl
    | SurfaceLuGre
    | SurfaceSevenParameter,
    Field(discriminator="kind"),
]
JointFriction = Annotated[
    NoFriction
    | JointCoulomb
    | JointCoulombViscous
    | JointStribeck
    | JointKarnopp
    | JointDahl
    | JointLuGre
    | JointSevenParameter,
    Field(discriminator="kind"),
]


def names_of(section: Any) -> tuple[str, ...]:
    """Return the names of a section's parameters."""
    return tuple(name for name in type(section).model_fields if name != "kind")
