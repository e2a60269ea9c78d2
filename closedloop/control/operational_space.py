"""Force and motion in operational space, with the dynamics of the tip made linear (Khatib 1987).

    Q = C + H q̈₀ + Aᵀ [ Λ (a − Ȧq̇ − A q̈₀) − n f_c ]        Λ = (A H⁻¹Aᵀ)⁺

a is the acceleration wanted of the tip: along the surface a_des + K_v (u_des − u) + K_p (p_des − p), along n
zero, since there the force is controlled (Khatib's Ω and Ω̃ are diagonal in the contact frame). q̈₀ draws the
joints towards q_des; its part that would move the tip is taken out through the dynamically consistent inverse
H⁻¹AᵀΛ, so it moves a redundant arm within itself, without touching tip or force. On a rigid surface without
friction the tip then obeys ë + K_v ė + K_p e = 0 along the surface, and f = f_c. Off the surface a along n is that of
`closedloop.control.tip_space.motion_along_normal`: towards the surface only if f_des > 0.

Source: O. Khatib, A unified approach for motion and force control of robot manipulators: the operational space
formulation, IEEE J. Robotics and Automation 3(1), 1987. All of C is compensated here, not only what the tip feels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.law_input import LawInput
from closedloop.control.parameters import EIGEN, FORCE, INVERSE, SPARE, VECTORS, WANTED
from closedloop.control.tip_space import (
    add_mass_times,
    add_tip_force,
    posture,
    pseudo_inverse,
    rest_of,
    wanted_acceleration,
)
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def operational_space(x: LawInput, par: Array, gains: Array, f: float, work: Array, torque: Array) -> None:
    """Write Q (n,).

    Parameters
    ----------
    x : LawInput
    par : array
        See `closedloop.control.parameters`.
    gains : (2, n) array
        Of the posture, 1/s² and 1/s.
    f : float
        f_c, N.
    work : (work_size(n),) array
        Scratch.
    torque : (n,) array
        Written, N m.
    """
    wanted_acceleration(x, par, f, work[WANTED : WANTED + 3])
    move_tip(x, gains, f, work, torque)


@kernel
def move_tip(x: LawInput, gains: Array, f: float, work: Array, torque: Array) -> None:
    """Write the torque that gives the tip the acceleration in `work[WANTED:]` and presses with f, N, if in contact."""
    n = x.q.shape[0]
    inverse = work[INVERSE : INVERSE + 9].reshape(3, 3)
    wanted, F, rest = work[WANTED : WANTED + 3], work[FORCE : FORCE + 3], work[SPARE : SPARE + 3]
    a = work[VECTORS : VECTORS + n]
    pseudo_inverse(x.S, work[EIGEN : EIGEN + 18], inverse)
    posture(x, gains, a)
    rest_of(x, wanted, a, rest)
    for i in range(3):
        F[i] = inverse[i, 0] * rest[0] + inverse[i, 1] * rest[1] + inverse[i, 2] * rest[2]
    if x.pressed != 0.0:
        F[0] -= f
    for j in range(n):
        torque[j] = x.C[j]
    add_mass_times(x.H, a, 1.0, torque)
    add_tip_force(x.A, F, torque)
