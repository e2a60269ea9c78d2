"""Hybrid position/force control, each direction either of the one or of the other (Raibert and Craig 1981).

    Q = C + K_p [T⁺(p_des − p)_t + N (q_des − q)] + K_d [T⁺(u_des − u)_t + N (q̇_des − q̇)] − Aᵀn f_c

T = (t1, t2)ᵀJᵣ are the two rows of the position-controlled directions, (S J) with the selection matrix S, and N
= 1 − A⁺A leaves the tip alone. The gains act on joints, as in the original; the position error reaches them
through (S J)⁺, because with J⁻¹S the loop is unstable in some postures though the gains are positive (An and
Hollerbach 1987), and (S J)⁺S J is a projection, which is not (Fisher and Mujtaba 1992). The original leaves
gravity to the integral terms; here C is fed forward, as in Eq. 33.

Off the surface the normal direction is the motion of `closedloop.control.tip_space.motion_along_normal`: towards the
surface only if f_des > 0.

The directions are not decoupled: while there are joint errors, the force deviates from f_c by −(nᵀA H⁻¹(...))/(nᵀS n).

Sources: M. Raibert, J. Craig, J. Dynamic Systems, Measurement and Control 103(2), 1981; W. Fisher, S. Mujtaba, Hybrid
position/force control: a correct formulation, Int. J. Robotics Research 11(4), 1992.
"""

from typing import Annotated, Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import RATE, Positive, gain_in
from closedloop.control.law import LawInput, commanded_force
from closedloop.control.tip_space import (
    Approach,
    GainNotNegative,
    TipScratch,
    add_transposed,
    invert_gram,
    motion_along_normal,
)


class HybridLaw(Approach):
    """[law] kind = "hybrid": position and force in their own directions, gains on the joints (Raibert, Craig 1981)."""

    kp: Annotated[GainNotNegative, gain_in("N m/rad")] = Field(
        description="position gain K_p, N m/rad, one per joint or one for all"
    )
    kd: Annotated[GainNotNegative, gain_in("N m s/rad")] = Field(
        description="velocity gain K_d, N m s/rad, one per joint or one for all"
    )
    approach_damping: Annotated[Positive, RATE] = Field(40.0, description="gain of the approach speed, 1/s")

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        n, f = x.q.shape[0], commanded_force(x, par, z)
        s = TipScratch(x.scratch, n)
        push, damping = -f, par.approach_damping
        if x.pressed == 0.0:
            a = motion_along_normal(x, f, 0.25 * damping * damping, damping, par.approach_speed)  # critically damped
            push = a / x.S[0, 0] if x.S[0, 0] > 0.0 else 0.0
        for j in range(n):
            torque[j] = x.C[j] + x.A[0, j] * push
        for part in range(2):  # position, then velocity
            have, want = (x.q, x.q_des) if part == 0 else (x.v, x.v_des)
            for j in range(n):
                s.joints[j] = want[j] - have[j]
            # N e = e − A⁺A e
            invert_gram(x.A, 0, s.eigen, s.inverse)
            for i in range(3):
                along = 0.0
                for j in range(n):
                    along += x.A[i, j] * s.joints[j]
                s.rest[i] = -along
            add_transposed(x.A, s.inverse, s.rest, s.force, s.joints)
            # + T⁺ e_t
            invert_gram(x.A, 1, s.eigen, s.inverse)
            s.rest[0] = 0.0
            for i in range(1, 3):
                s.rest[i] = x.p_des[i] - x.p[i] if part == 0 else x.u_des[i] - x.u[i]
            add_transposed(x.A, s.inverse, s.rest, s.force, s.joints)
            for j in range(n):
                torque[j] += (par.kp[j] if part == 0 else par.kd[j]) * s.joints[j]
