"""Admittance control: the measured force moves a set point along n, and a motion loop takes the tip there.

    Outer loop, with two states:   M ẍ_a + B ẋ_a + K x_a = f − f_des
    Inner loop:                    a_n = K_v (u_des + ẋ_a − u)_n + K_p (p_des + x_a − p)_n

and along the surface the motion law of `closedloop.control.laws.operational_space`. In contact the inner loop acts
as the force −a_n/S_nn beside f_c, so that it does not push the tip along the surface. On a rigid surface f =
f_c + d − (K_v ẋ_a + K_p x_a)/S_nn, hence with K = 0

    M ẍ_a + (B + K_v/S_nn) ẋ_a + K_p/S_nn x_a = d

and the force settles at f_des for any constant disturbance d, with no integral of the force error but the motion of the
set point. In free motion f = 0: the set point, and the tip after it, approach the surface at f_des/B. With f_des < 0
the tip is pushed off by −f_des besides, as in contact, and its set point rises at −f_des/B.

Sources: D. Whitney, Force feedback control of manipulator fine motions, J. Dynamic Systems, Measurement and
Control 99(2), 1977; H. Seraji, Adaptive admittance control: an approach to explicit force control in compliant
motion, IEEE ICRA 1994.
"""

from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import INERTIA, NotNegative, Positive, gain_in
from closedloop.control.law import ControlLaw, LawInput, commanded_force, force_error_rate
from closedloop.control.tip_space import TipMotion, TipScratch, motion_along_surface, move_tip


class AdmittanceLaw(ControlLaw, TipMotion):
    """[law] kind = "admittance": the force error moves a set point along the normal (Whitney 1977, Seraji 1994)."""

    admittance_inertia: Annotated[Positive, INERTIA] = Field(2.0, description="mass M of the set point, kg")
    admittance_damping: Annotated[NotNegative, gain_in("N s/m")] = Field(
        200.0, description="damper B of the set point, N s/m; off the surface the tip comes down at force/B"
    )
    admittance_stiffness: Annotated[NotNegative, gain_in("N/m")] = Field(
        0.0, description="spring K of the set point, N/m; above 0 some force error stays"
    )

    states: ClassVar = ("force_error", "set_point", "set_point_rate")

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        f, wanted = commanded_force(x, par, z), TipScratch(x.scratch, x.q.shape[0]).wanted
        motion_along_surface(x, par, wanted)
        a = par.motion_damping * (x.u_des[0] + z.set_point_rate - x.u[0])
        a += par.motion_stiffness * (x.p_des[0] + z.set_point - x.p[0])
        if x.pressed != 0.0:
            wanted[0] = 0.0
            f -= a / x.S[0, 0]
        else:
            wanted[0] = a - x.S[0, 0] * min(f, 0.0)
        move_tip(x, par, f, torque)

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write ż; in free motion no force is measured."""
        dz.force_error = force_error_rate(x, par, z, f)
        force = f if x.pressed != 0.0 else 0.0
        yields = par.admittance_damping * z.set_point_rate + par.admittance_stiffness * z.set_point
        dz.set_point = z.set_point_rate
        dz.set_point_rate = (force - x.f_des - yields) / par.admittance_inertia

    @staticmethod
    def start(x: LawInput, par: Any, z: Any) -> None:
        """Write z at the start of a run: in free motion the set point is at the tip."""
        if x.pressed == 0.0:
            z.set_point = x.p[0] - x.p_des[0]
