"""Admittance over a position servo: the measured force moves set points of the joints, which their servos follow.

    Outer loop, along n:   (M/g) ẍ_a = f_s − f_des − (B + B_c) ẋ_a,      |ẋ_a| ≤ v_max,  B_c in contact only
    Set points:            q_a = q_des + A⁺n x_a,        q̇_a = q̇_des + A⁺n ẋ_a
    Position servo:        Q = C + K_p (q_a − q) + K_d (q̇_a − q̇)

Most industrial arms take set points and no torques, so this is the form of their force control: the torque has no term
of the force, which the arm feels through its set points alone. A⁺ is the pseudo-inverse of the tip's Jacobian: the
joint rates of least norm that move the tip along n. In free motion f_s = 0 and the set point gains speed at g f_des/M
up to v_max. In contact at rest f_s = f_des, whatever the servo's stiffness: ẋ_a is the integral of the force error. On
a surface that with servo and joints has the stiffness k along n, (M/g) ẍ_a + (B + B_c) ẋ_a + k x_a = 0: the force
swings at √(g k/M) and decays with g (B + B_c)/2M, less what the sensor's delay and the servo's lag take from it.

Sources: the position-based form of D. Whitney, J. Dynamic Systems, Measurement and Control 99(2), 1977, and G. Zeng, A.
Hemami, An overview of robot force control, Robotica 15(5), 1997. M, g, B and v_max are what a maker's force mode has as
its own mass, gain scaling, damping and speed limit.
"""

from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import INERTIA, SPEED, Gain, NotNegative, Positive, gain_in
from closedloop.control.law import ControlLaw, LawInput, commanded_force, force_error_rate
from closedloop.control.tip_space import TipScratch, add_transposed, invert_gram
from closedloop.jit.kernel import kernel


class ServoAdmittanceLaw(ControlLaw):
    """[law] kind = "servo_admittance": the force error moves set points of a joint position servo (Whitney 1977)."""

    kp: Annotated[Gain, gain_in("N m/rad")] = Field(
        description="stiffness K_p of the position servo, N m/rad, one per joint or one for all"
    )
    kd: Annotated[Gain, gain_in("N m s/rad")] = Field(
        description="damping K_d of the position servo, N m s/rad, one per joint or one for all"
    )
    gain_scaling: Annotated[Positive, gain_in("")] = Field(
        1.0, description="g: the force error less the damping acts g times on the set point"
    )
    admittance_inertia: Annotated[Positive, INERTIA] = Field(20.0, description="mass M of the set point, kg")
    admittance_damping: Annotated[NotNegative, gain_in("N s/m")] = Field(
        200.0, description="damper B of the set point, N s/m"
    )
    contact_damping: Annotated[NotNegative, gain_in("N s/m")] = Field(
        0.0, description="damper B_c of the set point in contact, besides B, N s/m"
    )
    speed_limit: Annotated[Positive, SPEED] = Field(
        0.1, description="largest speed v_max of the set point along n, m/s, off the surface and on it"
    )

    states: ClassVar = ("force_error", "set_point", "set_point_rate")

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        n = x.q.shape[0]
        s = TipScratch(x.scratch, n)
        invert_gram(x.A, 0, s.eigen, s.inverse)
        for i in range(3):
            s.rest[i] = 1.0 if i == 0 else 0.0
        for j in range(n):
            s.joints[j] = 0.0
        add_transposed(x.A, s.inverse, s.rest, s.force, s.joints)
        rate = _limited(z.set_point_rate, par.speed_limit)
        for j in range(n):
            torque[j] = x.C[j] + par.kp[j] * (x.q_des[j] + s.joints[j] * z.set_point - x.q[j])
            torque[j] += par.kd[j] * (x.v_des[j] + s.joints[j] * rate - x.v[j])

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write ż; at its limit the speed does not grow further."""
        dz.force_error = force_error_rate(x, par, z, f)
        limit = par.speed_limit
        dz.set_point = rate = _limited(z.set_point_rate, limit)
        damping = par.admittance_damping + (par.contact_damping if x.pressed != 0.0 else 0.0)
        a = par.gain_scaling * (f - commanded_force(x, par, z) - damping * rate) / par.admittance_inertia
        if (z.set_point_rate >= limit and a > 0.0) or (z.set_point_rate <= -limit and a < 0.0):
            a = 0.0
        dz.set_point_rate = a

    @staticmethod
    def start(x: LawInput, par: Any, z: Any) -> None:
        """Write z at the start of a run: in contact the servo presses with f_des, else the set point is the tip's."""
        z.set_point = x.p[0] - x.p_des[0]
        if x.pressed == 0.0:
            z.set_point_rate = _limited(x.u[0], par.speed_limit)
            return
        for j in range(x.q.shape[0]):
            if par.kp[j] > 0.0:
                z.set_point -= x.A[0, j] * x.A[0, j] * x.f_des / par.kp[j]


@kernel
def _limited(speed: float, limit: float) -> float:
    """Return the speed, or the limit where it is above it."""
    return float(min(max(speed, -limit), limit))
