"""What dahl and lugre share: a bristle of deflection z that follows the slip and yields.

    ż = u − a z,    a = |u|/z_max(|u|),    z_max the deflection of steady sliding

In two dimensions z and u are vectors and |u| a length, so the law knows no direction. Since a z_max = |u|, a
bristle within the largest z_max never leaves it: d|z|/dt <= |u| − a|z| <= 0 at its edge.

For a constant u the equation is linear in z with the solution

    z(h) = e^(−ah) z + (1 − e^(−ah))/a u

which `advance` takes as the step. It is a weighted mean of z and of the steady deflection u/a, so it stays
within the bound for a step of any length, where an explicit step would need a h < 2: at 0.1 m/s and z_max = 10
µm, h < 0.2 ms.

Before slip: the tip or joint on its bristles is a mass on a spring and a damper, and sets the step.

    m ü + (σ_1 f + b) u̇ + σ_0 f u = 0        ω = √(σ_0 f/m),  ζ = (σ_1 f + b)/(2 m ω)

A semi-implicit Euler step h of it is stable for ω²h² + 4ζωh < 4 (Jury's test of z² − (2 − 2ζωh − ω²h²) z + 1 −
2ζωh), and that also bounds a step with `advance`, whose bristles before slip move as the tip does.
"""

import math
from typing import Any

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.friction.law import FrictionLaw, length_of


@kernel
def relax(a: float, u: Array, z: Array, dz: Array) -> None:
    """Write ż = u − a z (d,), m/s, for a in 1/s."""
    for k in range(u.shape[0]):
        dz[k] = u[k] - a * z[k]


@kernel
def advance(a: float, u: Array, h: float, z: Array) -> None:
    """Overwrite z (d,), m, with its value h seconds later, the slip u (d,) staying as it is."""
    decay = math.exp(-a * h)
    gain = -math.expm1(-a * h) / a if a * h > 1e-300 else h
    for k in range(u.shape[0]):
        z[k] = decay * z[k] + gain * u[k]


@kernel
def stored(stiffness: float, z: Array) -> float:
    """Return ½ σ_0 |z|², the energy in bristles bent by z (d,) per newton of normal force, m; of a joint, J."""
    deflection = length_of(z)
    return 0.5 * stiffness * deflection * deflection


def bristle(section: FrictionLaw, par: Any, load: float) -> tuple[float, float]:
    """Return stiffness, N/m, and damping, N s/m, before slip under a normal force, N; of a law without, zeros."""
    damper = 0.0 if section.sticks == "spring" else getattr(par, "damping", 0.0) * load + getattr(par, "viscous", 0.0)
    return float(getattr(par, "stiffness", 0.0)) * load, float(damper)
