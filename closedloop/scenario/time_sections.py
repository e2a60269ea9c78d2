"""When a run begins and ends: [start], the state at t = 0, and [time], how far and in what steps."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from closedloop.base.families import OneOf
from closedloop.base.sections import ANGLE, JOINT_SPEED, STEP, Flag, Number, PerJoint, Positive, Section, Size, Unit
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
        description="semi_implicit_euler is the paper's, dop853 chooses its own steps; auto: rk4 where surface.contact "
        "is unilateral, since a scheme of order 1 shifts impacts by up to several steps, but semi_implicit_euler with "
        "a friction with states, such as lugre, and where contact is bilateral",
    )
    tolerance: Tolerance | None = Field(
        None,
        description="largest relative error of dop853 in each of its own steps; if left out 1e-12, and 1e-9 "
        "with friction at the tip",
    )
