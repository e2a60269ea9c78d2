"""Adaptive compensation of the surface's friction: its Coulomb and viscous coefficients, learned while sliding.

    F̂_t = −(θ₁ f_des û + θ₂ u)                     û, u: of the wanted motion, see `compensation.model`
    θ̇₁ = γ û·s,   θ̇₂ = γ f_des/v₀² u·s            s = P/(½ tr P) (ė + c e),   e = p_des − p along the surface

P is the tip's mobility along the surface. With a motion law ë + K_v ė + K_p e = P (F̂_t − F_t) and c < K_v the
function

    V = ½ (ė² + 2 c e·ė + (K_p + c K_v) e²) + θ̃²/(2 Γ)       has V̇ = −c K_p e² − (K_v − c) ė² ≤ 0

for a posture that changes slowly, so the path error vanishes; the two coefficients are found apart only where
the speed varies. At constant speed the force settles with the rate γ c f_des P/K_p. Coefficients do not become
negative.

Source: J. Craig, P. Hsu, S. Sastry, Adaptive control of mechanical manipulators, Int. J. Robotics Research 6(2), 1987,
whose regressor is cut down to friction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.compensation.model import wanted_direction
from closedloop.control.law_input import LawInput
from closedloop.control.parameters import ADAPTATION, CORNER, SMOOTHING, SPEED_SCALE
from closedloop.control.tip_space import surface_mobility
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def add_adapted(x: LawInput, par: Array, theta: Array, torque: Array) -> None:
    """Add −AᵀF̂_t, N m; θ (2,), without unit and N s/m."""
    if x.pressed == 0.0:
        return
    d1, d2, _ = wanted_direction(x, par[SMOOTHING])
    push1 = theta[0] * x.f_des * d1 + theta[1] * x.u_des[1]
    push2 = theta[0] * x.f_des * d2 + theta[1] * x.u_des[2]
    for j in range(torque.shape[0]):
        torque[j] += x.A[1, j] * push1 + x.A[2, j] * push2


@kernel
def adaptive_rates(x: LawInput, par: Array, theta: Array, dtheta: Array) -> None:
    """Write θ̇ (2,); zero off the surface and for a tip that cannot move along it."""
    dtheta[0], dtheta[1] = 0.0, 0.0
    if x.pressed == 0.0:
        return
    p11 = surface_mobility(x.S, x.pressed, 1, 1)
    p12 = surface_mobility(x.S, x.pressed, 1, 2)
    p22 = surface_mobility(x.S, x.pressed, 2, 2)
    mean = 0.5 * (p11 + p22)
    if not mean > 0.0:
        return
    e1 = x.u_des[1] - x.u[1] + par[CORNER] * (x.p_des[1] - x.p[1])
    e2 = x.u_des[2] - x.u[2] + par[CORNER] * (x.p_des[2] - x.p[2])
    s1, s2 = (p11 * e1 + p12 * e2) / mean, (p12 * e1 + p22 * e2) / mean
    d1, d2, _ = wanted_direction(x, par[SMOOTHING])
    rate = par[ADAPTATION] * (d1 * s1 + d2 * s2)
    dtheta[0] = rate if theta[0] > 0.0 or rate > 0.0 else 0.0
    scale = par[SPEED_SCALE]
    rate = par[ADAPTATION] * x.f_des / (scale * scale) * (x.u_des[1] * s1 + x.u_des[2] * s2)
    dtheta[1] = rate if theta[1] > 0.0 or rate > 0.0 else 0.0
