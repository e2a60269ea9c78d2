"""The normal of a surface that the controller does not know, estimated from force and motion.

The tip moves in the tangent plane, and friction acts against its slip. So what the measured force has across the
velocity is the contact force f n alone, whatever the coefficient of friction:

    m = P F/|P F|,   P = 1 − û ûᵀ        F: the reading of a sensor of three axes; û: direction of the tip's velocity
    b' = K_n (m_t − b)                   b: what the estimate n̂ has along the tangents of the frame believed in

The estimate follows a normal that turns with the time constant 1/K_n. The desired force is turned from the normal that
the controller believes in to n̂: what is added is −f_des Jᵣᵀ(n̂ − n). Below `least_speed` the direction of the velocity
is not known, and below `least_force` nothing presses: the estimate then stays.

Source: T. Yoshikawa and A. Sudou, Dynamic hybrid position/force control of robot manipulators: on-line estimation of
unknown constraint, IEEE Trans. Robotics and Automation, 1993, who take the normal from the measured force, and the
tangent from the motion.
"""

import math
from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import FORCE, RATE, SPEED_SCALE, Positive
from closedloop.control.law import Compensation, LawInput
from closedloop.jit.kernel import kernel

# Largest tangential part of an estimate, the sine of 80 degrees: the desired force does not turn beyond.
STEEPEST = 0.985


@kernel
def measured_normal(x: LawInput, par: Any) -> tuple[bool, float, float]:
    """Return whether the reading tells the normal, and what m has along the two tangents."""
    speed = math.sqrt(x.u[0] * x.u[0] + x.u[1] * x.u[1] + x.u[2] * x.u[2])
    if x.pressed == 0.0 or not speed > par.least_speed:
        return False, 0.0, 0.0
    d0, d1, d2 = x.u[0] / speed, x.u[1] / speed, x.u[2] / speed
    along = d0 * x.f_measured + d1 * x.f_tangential[0] + d2 * x.f_tangential[1]
    m0, m1, m2 = x.f_measured - along * d0, x.f_tangential[0] - along * d1, x.f_tangential[1] - along * d2
    size = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    if not size > par.least_force or not m0 > 0.0:
        return False, 0.0, 0.0
    return True, m1 / size, m2 / size


class NormalCompensation(Compensation):
    """[compensation] kind = "normal": the surface's normal, estimated from force and motion; turns the force to it."""

    rate: Annotated[Positive, RATE] = Field(
        50.0, description="K_n, 1/s: the estimate follows the normal with the time constant 1/K_n"
    )
    least_speed: Annotated[Positive, SPEED_SCALE] = Field(
        1e-3, description="speed of the tip below which the estimate stays, m/s"
    )
    least_force: Annotated[Positive, FORCE] = Field(
        0.1, description="force across the velocity below which the estimate stays, N"
    )

    reads_tangential: ClassVar = True
    states: ClassVar = ("normal_t1", "normal_t2")  # b

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Add −f_des Jᵣᵀ(n̂ − n), N m."""
        if x.pressed == 0.0:
            return
        b1, b2 = z.normal_t1, z.normal_t2
        size = math.sqrt(b1 * b1 + b2 * b2)
        share = STEEPEST / size if size > STEEPEST else 1.0
        b1, b2 = share * b1, share * b2
        off = math.sqrt(1.0 - b1 * b1 - b2 * b2) - 1.0
        for j in range(torque.shape[0]):
            torque[j] -= x.f_des * (off * x.A[0, j] + b1 * x.A[1, j] + b2 * x.A[2, j])

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write ḃ, 1/s."""
        told, m1, m2 = measured_normal(x, par)
        dz.normal_t1, dz.normal_t2 = 0.0, 0.0
        if told:
            dz.normal_t1, dz.normal_t2 = par.rate * (m1 - z.normal_t1), par.rate * (m2 - z.normal_t2)
