"""Impedance control: the tip responds to forces like a spring and a damper, and presses with f_c (Hogan 1985).

    along the surface   M (ü − ü_des) + B (u − u_des) + K (p − p_des) = F_t
    along n, in contact f = f_c + B_n (u − u_des)_n + K_n (p − p_des)_n

M is the inertia that the arm itself has along the surface: changing it would need the force along the surface to be
measured. So a force F_t displaces the tip by F_t/K. The torque is that of `closedloop.control.tip_space.move_tip`, so
the directions are decoupled.

With a p_des below the surface the spring presses with K_n times the depth; with p_des on it the force is f_c. Another
inertia M_n along n would be the same as the force feedback K_f = 1/(M_n S_nn) − 1, which is `law.force_feedback`. In
free motion spring, damper and f_des act along n on the arm's own inertia: with f_des > 0 and K_n = 0 the tip approaches
the surface at f_des/B_n.

Source: N. Hogan, Impedance control: an approach to manipulation, J. Dynamic Systems, Measurement and Control 107(1),
1985.
"""

from typing import Annotated, Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import NotNegative, gain_in
from closedloop.control.law import ControlLaw, LawInput, commanded_force
from closedloop.control.tip_space import Posture, TipScratch, move_tip, surface_mobility


class ImpedanceLaw(ControlLaw, Posture):
    """[law] kind = "impedance": a spring and a damper at the tip, and a desired force (Hogan 1985)."""

    stiffness: Annotated[NotNegative, gain_in("N/m")] = Field(1200.0, description="spring K along the surface, N/m")
    damping: Annotated[NotNegative, gain_in("N s/m")] = Field(120.0, description="damper B along the surface, N s/m")
    normal_stiffness: Annotated[NotNegative, gain_in("N/m")] = Field(
        0.0, description="spring K_n along the normal, N/m"
    )
    normal_damping: Annotated[NotNegative, gain_in("N s/m")] = Field(
        200.0, description="damper B_n along the normal, N s/m; off the surface the tip comes down at force/B_n"
    )

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        f, s = commanded_force(x, par, z), TipScratch(x.scratch, x.q.shape[0])
        wanted, push = s.wanted, s.rest
        for i in range(1, 3):
            push[i] = par.damping * (x.u_des[i] - x.u[i]) + par.stiffness * (x.p_des[i] - x.p[i])
        for i in range(1, 3):
            wanted[i] = x.a_des[i]
            for k in range(1, 3):
                wanted[i] += surface_mobility(x.S, x.pressed, i, k) * push[k]
        away = par.normal_damping * (x.u[0] - x.u_des[0]) + par.normal_stiffness * (x.p[0] - x.p_des[0])
        wanted[0] = 0.0 if x.pressed != 0.0 else x.a_des[0] - x.S[0, 0] * (f + away)
        move_tip(x, par, f + away, torque)
