"""The types of the parameters of friction, of a surface and of joints: units, sizes and signs."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from closedloop.base.sections import (
    COEFFICIENT,
    JOINT_SPEED_SCALE,
    PERIOD,
    SPEED_SCALE,
    TORQUE,
    Gain,
    NotNegative,
    Positive,
    Size,
    stiffness_in,
    viscous_in,
)
from closedloop.jit.parameters import Named

Figure = float | tuple[float, ...]

# A joint no faster than this, rad/s (m/s), rests: more than the rounding of a velocity that friction has stopped.
AT_REST = 1e-9


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
# Of a law with one level: the functions of the law have it as `kinetic`, as a joint's.
Level = Annotated[Coefficient, Named("kinetic")]
PositiveCoefficient = Annotated[Positive, COEFFICIENT]
PositiveLevel = Annotated[PositiveCoefficient, Named("kinetic")]
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


def refuse_below(static: Figure, kinetic: Figure) -> None:
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
