"""The control law of the paper (Eq. 33).

    Q = −K_p (q − q_des) − K_d (q̇ − q̇_des)  +  C  +  Jᵣᵀn (−f_des)

The first two terms, the PD part, act from `pd_start` on; C (Coriolis, centrifugal and gravity) and the force term from
t = 0. The paper prints the position error as q − q_des; here the gains are positive numbers and the minus sign
stands in front, so a positive gain pulls the arm towards its path. The arm pushes the surface with f_des along −n,
hence the minus sign of the last term, and the surface answers with f along +n.

The paper has no force sensor. With `force_feedback` or `force_integral`, which the paper does not have, f_c of
`closedloop.control.law.commanded_force` replaces f_des.
"""

from typing import Annotated, Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import Gain, Instant, gain_in
from closedloop.control.law import ControlLaw, LawInput, commanded_force
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import select


@kernel_inlined
def paper_law(
    t: float, f_des: float, par: Any, wanted: tuple[Array, Array], state: tuple[Array, Array], C: Array, A: Array,
    torque: Array,
) -> None:  # fmt: skip
    """Write Q of Eq. 33.

    `t`, `f_des`: time, s, and the wanted force, N.
    `par`: kp, N m/rad, and kd, N m s/rad, (n,) each, and pd_start, s.
    `wanted`, two (n,) arrays: q_des and q̇_des at t.
    `state`, two (n,) arrays: q and q̇.
    `C` (n,): bias.
    `A` (>= 1, n): its first row is nᵀJᵣ.
    `torque` (n,): written: Q, N m.
    """
    (q_des, v_des), (q, v) = wanted, state
    pd = select(t >= par.pd_start, 1.0, 0.0)
    for j in range(q.shape[0]):
        torque[j] = C[j] - A[0, j] * f_des - pd * (par.kp[j] * (q[j] - q_des[j]) + par.kd[j] * (v[j] - v_des[j]))


class PaperLaw(ControlLaw):
    """[law] kind = "paper": Eq. 33."""

    kp: Annotated[Gain, gain_in("N m/rad")] = Field(
        description="position gain K_p, N m/rad, one per joint or one for all"
    )
    kd: Annotated[Gain, gain_in("N m s/rad")] = Field(
        description="velocity gain K_d, N m s/rad, one per joint or one for all"
    )
    pd_start: Instant | None = Field(
        None,
        description="instant from which the PD part acts, s; that at which the reference starts to move if left out",
    )

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        paper_law(x.t, commanded_force(x, par, z), par, (x.q_des, x.v_des), (x.q, x.v), x.C, x.A, torque)
