"""seven_parameter: a spring while stuck; while sliding a Stribeck curve that remembers rest and lags the slip.

    stuck     F_t = −k_t x f                              until k_t|x| = F_C + F_S(γ, t_d)
    sliding   F_t = −[F_C + F_S(γ, t_d)/(1 + (v(t − τ_L)/v_s)²)] f u/|u| − F_v u
    F_S(γ, t_d) = F_Sa + (F_S∞ − F_Sa) t_d/(t_d + γ)

t_d is the dwell time, how long the contact was stuck before it slid, F_Sa the Stribeck part at the end of the
slide before that, v(t − τ_L) the slip speed of a moment ago. F_S is the *excess* over F_C. The Stribeck curve
is Lorentzian (that of LuGre is Gaussian): their v_s are not the same figure.

Slip turns into sticking where u = 0. Then F_Sa becomes the Stribeck part of that instant, t_d starts at 0, and
x, the displacement from where the spring is relaxed, starts in the direction of the slip at the length at which
the spring pulls as the slip did (`stick`). So the force does not jump. At break-away it does not jump either if
the slip of a moment ago was none. (The start of x is this project's choice.)

Energy: k_t|x|²/2 per newton of f is stored while stuck, (F_C + F_S)²/(2 k_t) while sliding (the asperities stay
bent). It does not jump at break-away and can only fall where slip ends, so the law never adds energy while f is
constant. Stuck, it has no damping at all, as published: a tip that is stuck goes on quivering.

Source: B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, A survey of models, analysis tools and compensation
methods for the control of machines with friction, Automatica 30 (1994) 1083-1138; the equations as public code
quotes them, a bracket of F_S(γ, t_d) put right so that t_d = 0 gives F_Sa and a long rest F_S∞.

Parameters. The ranges are those of that survey as recalled: neither its table nor a work that quotes it could be
found to check them, so take them for orders of magnitude. F_C 0.001-0.1 of the normal force; F_v from 0, N s/m;
F_S∞ 0.001-0.1 of the normal force; k_t = (F_C + F_S)/δx with δx 1-50 µm, 1/m; v_s 1e-5-0.1 m/s; τ_L 1-50 ms; γ
0-200 s, where 0 is a static friction that is there at once. For a joint torques in N m, and rad for m. States:
t_d, s; F_Sa; x (d,), m (rad).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import (
    DISPLACEMENT,
    DWELL,
    KINETIC,
    LAST,
    RISE_TIME,
    STATIC_EXCESS,
    STIFFNESS,
    STRIBECK_SPEED,
)
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def static_excess(par: Array, dwell: float, last: float) -> float:
    """Return F_S(γ, t_d) after a dwell time t_d, s, and a slide that ended at the Stribeck part F_Sa = `last`."""
    if par[RISE_TIME] == 0.0:
        return par[STATIC_EXCESS]  # type: ignore[no-any-return]
    return last + (par[STATIC_EXCESS] - last) * dwell / (dwell + par[RISE_TIME])  # type: ignore[no-any-return]


@kernel
def stribeck_part(par: Array, delayed_speed: float, z: Array) -> float:
    """Return F_S/(1 + (v/v_s)²) for the slip speed v of τ_L ago, m/s, and the states z (d + 2,)."""
    ratio = min(delayed_speed / par[STRIBECK_SPEED], 1e100)
    return static_excess(par, z[DWELL], z[LAST]) / (1.0 + ratio * ratio)  # type: ignore[no-any-return]


@kernel
def level(par: Array, delayed_speed: float, z: Array) -> float:
    """Return F_C + F_S/(1 + (v/v_s)²), the friction of sliding per newton of normal force, or N m."""
    return par[KINETIC] + stribeck_part(par, delayed_speed, z)  # type: ignore[no-any-return]


@kernel
def breakaway(par: Array, z: Array) -> float:
    """Return F_C + F_S(γ, t_d), at which a contact that is stuck starts to slide."""
    return par[KINETIC] + static_excess(par, z[DWELL], z[LAST])  # type: ignore[no-any-return]


@kernel
def stick(par: Array, delayed_speed: float, direction: Array, z: Array) -> None:
    """Overwrite z (d + 2,) where slip along `direction` (d,) has just ended, with v(t − τ_L) = `delayed_speed`."""
    last = stribeck_part(par, delayed_speed, z)
    for k in range(direction.shape[0]):
        z[DISPLACEMENT + k] = (par[KINETIC] + last) / par[STIFFNESS] * direction[k]
    z[DWELL] = 0.0
    z[LAST] = last


@kernel
def stored(par: Array, stuck: bool, z: Array, d: int) -> float:
    """Return the energy stored per newton of normal force, m (J for a joint)."""
    x = math.hypot(z[DISPLACEMENT], z[DISPLACEMENT + 1]) if d == 2 else abs(z[DISPLACEMENT])
    reach = x if stuck else breakaway(par, z) / par[STIFFNESS]
    return 0.5 * par[STIFFNESS] * reach * reach  # type: ignore[no-any-return]
