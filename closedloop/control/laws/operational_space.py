"""Force and motion control in operational space, with the dynamics of the tip linearised (Khatib 1987).

    Q = C + H q̈₀ + Aᵀ [ Λ (a − Ȧq̇ − A q̈₀) − n f_c ]        Λ = (A H⁻¹Aᵀ)⁺

a is the commanded acceleration of the tip: along the surface a_des + K_v (u_des − u) + K_p (p_des − p), along n
zero, since there the force is controlled (Khatib's Ω and Ω̃ are diagonal in the contact frame). q̈₀ draws the
joints towards q_des; its part that would move the tip is taken out through the dynamically consistent inverse
H⁻¹AᵀΛ, so it moves a redundant arm within itself, without touching tip or force. On a rigid surface without
friction the tip then obeys ë + K_v ė + K_p e = 0 along the surface, and f = f_c. Off the surface a along n is that of
`closedloop.control.tip_space.motion_along_normal`: towards the surface only if f_des > 0.

Source: O. Khatib, A unified approach for motion and force control of robot manipulators: the operational space
formulation, IEEE J. Robotics and Automation 3(1), 1987. All of C is compensated here, not only its part at the tip.
"""

from typing import Any

from closedloop.base.arrays import Array
from closedloop.control.law import LawInput, commanded_force
from closedloop.control.tip_space import Approach, TipMotion, TipScratch, move_tip, wanted_acceleration


class OperationalSpaceLaw(Approach, TipMotion):
    """[law] kind = "operational_space": the tip's own dynamics made linear (Khatib 1987)."""

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        f = commanded_force(x, par, z)
        wanted_acceleration(x, par, f, TipScratch(x.scratch, x.q.shape[0]).wanted)
        move_tip(x, par, f, torque)
