"""Friction fed forward from a model of it.

Surface, against F_t:  F̂_t = −[f_des (μ_k + (μ_s − μ_k) exp(−(|u|/v_s)²)) + b |u|] û
Joints:                τ̂_j = c_j v̂_j + b_j v_j

u and v are the desired velocities, which carry no noise and do not chatter about zero; the unit vectors are smoothed,
û = u/√(|u|² + ε²), so that the torque does not jump where the motion begins.

Source: the Stribeck curve in the form of Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30(7), 1994.
"""

import math
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator
from pydantic_core.core_schema import ValidationInfo

from closedloop.base.arrays import Array
from closedloop.base.sections import (
    COEFFICIENT,
    JOINT_SPEED_SCALE,
    SPEED_SCALE,
    TORQUE,
    NotNegative,
    Positive,
    viscous_in,
)
from closedloop.control.law import Compensation, LawInput
from closedloop.control.tip_space import GainNotNegative
from closedloop.jit.kernel import kernel


@kernel
def desired_direction(x: LawInput, smoothing: float) -> tuple[float, float, float]:
    """Return the two components of û, without unit, and |u|, m/s, of the desired motion along the surface."""
    speed = math.hypot(x.u_des[1], x.u_des[2])
    scale = math.hypot(speed, smoothing)
    if scale == 0.0:
        return 0.0, 0.0, 0.0
    return x.u_des[1] / scale, x.u_des[2] / scale, speed


class ModelCompensation(Compensation):
    """[compensation] kind = "model": assumed friction, fed forward along the desired motion."""

    kinetic: Annotated[NotNegative, COEFFICIENT] = Field(
        0.0, description="assumed kinetic coefficient of the surface's friction, 1"
    )
    static: Annotated[NotNegative, COEFFICIENT] | None = Field(
        None, description="assumed static coefficient, 1; the kinetic one if left out"
    )
    stribeck_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.01, description="assumed Stribeck speed, between static and kinetic friction, m/s (Gaussian)"
    )
    viscous: Annotated[NotNegative, viscous_in("N s/m")] = Field(
        0.0, description="assumed viscous coefficient of the surface's friction, N s/m"
    )
    smoothing_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.001, description="desired speed below which the feed-forward fades, m/s"
    )
    joint_coulomb: Annotated[GainNotNegative, TORQUE] = Field(
        0.0, description="assumed Coulomb torque, N m, one per joint or one for all"
    )
    joint_viscous: Annotated[GainNotNegative, viscous_in("N m s/rad")] = Field(
        0.0, description="assumed viscous coefficient, N m s/rad, one per joint or one for all"
    )
    joint_smoothing_speed: Annotated[Positive, JOINT_SPEED_SCALE] = Field(
        0.001, description="desired joint speed below which its feed-forward fades, rad/s (m/s)"
    )

    friction_values: ClassVar = ("kinetic", "static", "viscous", "joint_coulomb", "joint_viscous")

    @field_validator("static")
    @classmethod
    def _static_is_the_larger(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and value < info.data.get("kinetic", 0.0):
            raise ValueError(f"must not be below kinetic, {info.data['kinetic']:g}: static friction is the larger")
        return value

    def resolved(self) -> dict[str, float]:
        """Return what the parameters that are left out are."""
        return {} if self.static is not None else {"static": self.kinetic}

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Add the torque that overcomes the assumed friction, N m."""
        n = torque.shape[0]
        if x.pressed != 0.0:
            d1, d2, speed = desired_direction(x, par.smoothing_speed)
            mu = par.kinetic
            if par.stribeck_speed > 0.0:
                ratio = speed / par.stribeck_speed
                mu += (par.static - par.kinetic) * math.exp(-(ratio * ratio))
            size = x.f_des * mu + par.viscous * speed
            for j in range(n):
                torque[j] += size * (x.A[1, j] * d1 + x.A[2, j] * d2)
        for j in range(n):
            if par.joint_coulomb[j] != 0.0:
                torque[j] += par.joint_coulomb[j] * x.v_des[j] / math.hypot(x.v_des[j], par.joint_smoothing_speed)
            torque[j] += par.joint_viscous[j] * x.v_des[j]
