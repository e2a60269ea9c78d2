"""[start], [time] and [stabiliser]: when a run begins and ends, and what keeps its closure error small."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from closedloop.base.families import OneOf
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
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS

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
