"""Admittance control: the measured force moves a set point along n, and a motion loop takes the tip there.

Outer loop, with two states:   M ẍ_a + B ẋ_a + K x_a = f − f_des
Inner loop:                    a_n = K_v (u_des + ẋ_a − u)_n + K_p (p_des + x_a − p)_n

and along the surface the motion law of `closedloop.control.operational_space`. In contact the inner loop acts
as the force −a_n/S_nn beside f_c, so that it does not push the tip along the surface. On a rigid surface f =
f_c + d − (K_v ẋ_a + K_p x_a)/S_nn, hence with K = 0

    M ẍ_a + (B + K_v/S_nn) ẋ_a + K_p/S_nn x_a = d

and the force settles at f_des whatever the disturbance d, with no integral of the force error but the set
point's motion. In free motion f = 0: the set point, and the tip after it, come down at f_des/B. A tip that is to leave
(f_des < 0) is pushed off by −f_des besides, as it was in contact, and its set point rises at −f_des/B.

Sources: D. Whitney, Force feedback control of manipulator fine motions, J. Dynamic Systems, Measurement and
Control 99(2), 1977; H. Seraji, Adaptive admittance control: an approach to explicit force control in compliant
motion, IEEE ICRA 1994.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.law_input import LawInput
from closedloop.control.operational_space import move_tip
from closedloop.control.parameters import DAMPING, INERTIA, K_P, K_V, STIFFNESS, WANTED
from closedloop.control.tip_space import motion_along_surface
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def admittance(x: LawInput, par: Array, gains: Array, f: float, z: Array, work: Array, torque: Array) -> None:
    """Write Q (n,); z (2,) is (x_a, ẋ_a), m, m/s, the rest as for `closedloop.control.operational_space`."""
    wanted = work[WANTED : WANTED + 3]
    motion_along_surface(x, par, wanted)
    a = par[K_V] * (x.u_des[0] + z[1] - x.u[0]) + par[K_P] * (x.p_des[0] + z[0] - x.p[0])
    if x.pressed != 0.0:
        wanted[0] = 0.0
        f -= a / x.S[0, 0]
    else:
        wanted[0] = a - x.S[0, 0] * min(f, 0.0)
    move_tip(x, gains, f, work, torque)


@kernel
def admittance_rates(x: LawInput, par: Array, z: Array, f: float, dz: Array) -> None:
    """Write the rates of z (2,): f is the measured force, N; it is zero in free motion."""
    force = f if x.pressed != 0.0 else 0.0
    dz[0] = z[1]
    dz[1] = (force - x.f_des - par[DAMPING] * z[1] - par[STIFFNESS] * z[0]) / par[INERTIA]
