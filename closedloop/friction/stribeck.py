"""stribeck: friction that falls from its static to its kinetic level as slip gets faster.

    slip     F_t = −g(|u|) f u/|u| − b u,    g(v) = μ_k + (μ_s − μ_k) exp(−(v/v_s)^δ)
    stick    |F_t| <= μ_s f

Source of the curve: L. C. Bo and D. Pavelescu, The friction-speed relation and its influence on the critical
velocity of stick-slip motion, Wear 82 (1982) 277-289; with δ = 2, the Gaussian, in B. Armstrong-Hélouvry,
Control of Machines with Friction, 1991, and in LuGre (1995). (References recalled; the curve as printed in C.
Canudas de Wit et al. 1995.)

Parameters: 0 <= μ_k <= μ_s, or for a joint torques, N m; v_s > 0, m/s (rad/s); δ > 0, mostly 0.5-2; b >= 0, N s/m
(N m s/rad).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import EXPONENT, KINETIC, STATIC, STRIBECK_SPEED
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def level(par: Array, speed: float) -> float:
    """Return g(v) at the slip speed v >= 0, without unit, or N m."""
    ratio = speed / par[STRIBECK_SPEED]
    if ratio <= 0.0:
        fall = 1.0
    elif par[EXPONENT] == 2.0:
        near = min(ratio, 30.0)  # exp(−900) is zero already
        fall = math.exp(-near * near)
    else:
        fall = math.exp(-math.exp(min(par[EXPONENT] * math.log(ratio), 7.0)))  # exp(−e⁷) likewise
    return par[KINETIC] + (par[STATIC] - par[KINETIC]) * fall  # type: ignore[no-any-return]
