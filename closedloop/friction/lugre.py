"""lugre: bristles with damping that yield at the Stribeck curve; the model of Lund and Grenoble.

    F_t = −(σ_0 z + σ_1 ż) f − b u,    ż = u − |u|/z_max z,    σ_0 z_max = g(|u|) = μ_k + (μ_s − μ_k) exp(−(|u|/v_s)^δ)

Steady sliding has ż = 0 and F_t = −g(|u|) f u/|u| − b u, the Stribeck curve; |z| <= μ_s/σ_0 always. Small
motions see a spring and a damper: ω = √(σ_0 f/m), ζ = (σ_1 f + b)/(2√(σ_0 f m)). The force at break-away
depends on how fast the load grows.

Energy. σ_0|z|²/2 per newton of f is stored, and with a = |u|/z_max and f constant the loss is

    −F_t·u − d/dt(stored) >= f (σ_0 a|z|² − σ_1 a|z||u| + (σ_1 + b/f)|u|²)

which can be negative: at high speed bristles that are bent far spring back, ż is against the slip, and σ_1 ż
pushes along it. It is never so if

    b/f >= σ_1 (μ_s − μ_k)/μ_k        (constant σ_1; there also necessary), or
    v_d <= 4√(2e) μ_k/σ_1             (damping that falls with speed, σ_1 exp(−(|u|/v_d)²))

The first follows from |z| <= μ_s/σ_0. For a constant σ_1 it is the condition of N. Barabanov and R. Ortega,
Necessary and sufficient conditions for passivity of the LuGre friction model, IEEE Trans. Automatic Control 45
(2000) 830-832 (recalled, and as others quote it from Åström and Canudas de Wit 2008, Eq. 7). The second makes
the quadratic form definite for every z: with b = 0 that is σ_1(v) v <= 4 g(v), and v exp(−(v/v_d)²) is at most
v_d/√(2e). The published figures, with constant σ_1, fulfil neither. Where f changes, energy comes and goes with
the stiffness of bent bristles, at most μ_s²/(2σ_0) per newton.

Under a small load that oscillates about a mean the bristles let the tip drift, as dahl's do.

Source: C. Canudas de Wit, H. Olsson, K. J. Åström, P. Lischinsky, A new model for control of systems with
friction, IEEE Trans. Automatic Control 40 (1995) 419-425; K. J. Åström and C. Canudas de Wit, Revisiting the
LuGre friction model, IEEE Control Systems Magazine 28(6) (2008) 101-114. Two dimensions: the isotropic
extension, z and u vectors.

Parameters: 0 < μ_k <= μ_s, or for a joint torques, N m; v_s > 0, m/s; δ > 0, 2 as published; σ_0 > 0, 1/m (N
m/rad); σ_1 >= 0, s/m (N m s/rad); v_d > 0, m/s, infinite as published; b >= 0, N s/m (N m s/rad). States: z
(d,), m (rad).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import DAMPING, DAMPING_SPEED, KINETIC, STATIC, STIFFNESS, VISCOUS
from closedloop.friction.stribeck import level
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def yielding(par: Array, speed: float) -> float:
    """Return a = |u|/z_max, 1/s, at the slip speed |u|."""
    return par[STIFFNESS] * speed / level(par, speed)  # type: ignore[no-any-return]


@kernel
def damping(par: Array, speed: float) -> float:
    """Return σ_1 at the slip speed |u|, s/m, or N m s/rad."""
    ratio = min(speed / par[DAMPING_SPEED], 30.0)
    return par[DAMPING] * math.exp(-ratio * ratio)  # type: ignore[no-any-return]


@kernel
def force(par: Array, u: Array, speed: float, z: Array, c: Array) -> None:
    """Write c = σ_0 z + σ_1 ż (d,): the friction per newton of normal force, or N m, without its viscous part."""
    a = yielding(par, speed)
    s = damping(par, speed)
    for k in range(c.shape[0]):
        c[k] = par[STIFFNESS] * z[k] + s * (u[k] - a * z[k])


def passive_damping_speed(par: Array) -> float:
    """Return the largest v_d, m/s, with which the law never adds energy: 4√(2e) μ_k/σ_1."""
    return 4.0 * math.sqrt(2.0 * math.e) * float(par[KINETIC]) / float(par[DAMPING]) if par[DAMPING] > 0.0 else math.inf


def passive_viscous(par: Array, load: float = 1.0) -> float:
    """Return the least b, N s/m, with which the law never adds energy at normal forces up to `load`, N."""
    return load * float(par[DAMPING] * (par[STATIC] - par[KINETIC]) / par[KINETIC])


def is_passive(par: Array, load: float = 1.0) -> bool:
    """Return whether the law is known never to add energy, by one of the two conditions above.

    Parameters
    ----------
    par : (PARAMETERS,) array
        Parameters of one law.
    load : float
        The largest normal force f, N; for a joint 1. It matters to the viscous condition alone.
    """
    return bool(par[VISCOUS] >= passive_viscous(par, load) or par[DAMPING_SPEED] <= passive_damping_speed(par))
