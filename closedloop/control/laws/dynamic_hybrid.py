"""Dynamic hybrid control: the motion along the surface through resolved joint accelerations (Yoshikawa 1987).

    Q = H q̈_c + C − Aᵀn f_c,        q̈_c = q̈₀ + A⁺(a − Ȧq̇ − A q̈₀)

For a plane Yoshikawa's E_F is nᵀ and E_P is (t1, t2)ᵀ, both constant, so a is the motion servo a_des + K_v
(u_des − u) + K_p (p_des − p) along the surface and zero along n. A⁺ is the inverse of least joint acceleration;
for an arm without redundancy it is A⁻¹ and the law is that of `operational_space`, for others it spends the
freedom differently: q̈₀ is followed as closely in joint acceleration, not in kinetic energy, as the tip allows. Off the
surface a along n is that of `closedloop.control.tip_space.motion_along_normal`: towards the surface only if f_des > 0.

Source: T. Yoshikawa, Dynamic hybrid position/force control of robot manipulators: description of hand constraints and
calculation of joint driving force, IEEE J. Robotics and Automation 3(5), 1987.
"""

from typing import Any

from closedloop.base.arrays import Array
from closedloop.control.law import LawInput, commanded_force
from closedloop.control.tip_space import (
    Approach,
    TipMotion,
    TipScratch,
    add_mass_times,
    add_transposed,
    invert_gram,
    posture,
    rest_of,
    wanted_acceleration,
)


class DynamicHybridLaw(Approach, TipMotion):
    """[law] kind = "dynamic_hybrid": resolved joint acceleration (Yoshikawa 1987)."""

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        n, f = x.q.shape[0], commanded_force(x, par, z)
        s = TipScratch(x.scratch, n)
        a = s.joints
        wanted_acceleration(x, par, f, s.wanted)
        invert_gram(x.A, 0, s.eigen, s.inverse)
        posture(x, par, a)
        rest_of(x, s.wanted, a, s.rest)
        add_transposed(x.A, s.inverse, s.rest, s.force, a)
        for j in range(n):
            torque[j] = x.C[j]
        add_mass_times(x.H, a, 1.0, torque)
        if x.pressed != 0.0:
            for j in range(n):
                torque[j] -= x.A[0, j] * f
