"""Before slip: the tip or joint on its bristles is a mass on a spring and a damper, and sets the step.

    m ü + (σ_1 f + b) u̇ + σ_0 f u = 0        ω = √(σ_0 f/m),  ζ = (σ_1 f + b)/(2 m ω)

A semi-implicit Euler step h of it is stable for ω²h² + 4ζωh < 4 (Jury's test of z² − (2 − 2ζωh − ω²h²) z + 1 −
2ζωh), and that also bounds a step with `advance`, whose bristles before slip move as the tip does.
"""

from __future__ import annotations

import math
from typing import Any

from closedloop.mechanics.friction.law import FrictionLaw
from closedloop.mechanics.friction.packing import joint_parameters, surface_parameters


def presliding_motion(
    section: FrictionLaw, mass: float, load: float = 1.0, joint: int | None = None, n: int = 1
) -> tuple[float, float]:
    """Return the natural frequency ω, rad/s, and the damping ratio ζ of small motions before slip.

    Parameters
    ----------
    section : FrictionLaw
        A law with a stiffness: dahl, lugre or seven_parameter (which has no damping while it is stuck).
    mass : float
        Mass that moves, kg; of the tip of an arm 1/(tᵀA H⁻¹Aᵀt) along a tangent t. Of a joint, kg m².
    load : float
        Normal force f, N; 1 for a joint.
    joint, n : int, optional
        Which of n joints; left out for a surface.
    """
    par = surface_parameters(section) if joint is None else joint_parameters(section, n)[joint]
    if not hasattr(section, "stiffness"):
        raise ValueError(f"{section.kind} has no stiffness: give dahl, lugre or seven_parameter")
    stiffness, damping = bristle(section, par, load)
    omega = math.sqrt(stiffness / mass)
    return omega, damping / (2.0 * mass * omega)


def bristle(section: FrictionLaw, par: Any, load: float) -> tuple[float, float]:
    """Return stiffness, N/m, and damping, N s/m, before slip under a normal force, N; of a law without, zeros."""
    damper = 0.0 if section.sticks == "spring" else getattr(par, "damping", 0.0) * load + getattr(par, "viscous", 0.0)
    return float(getattr(par, "stiffness", 0.0)) * load, float(damper)


def largest_step(omega: float, zeta: float) -> float:
    """Return the step h, s, below which semi-implicit Euler is stable: 2 (√(1 + ζ²) − ζ)/ω."""
    return 2.0 / (omega * (math.sqrt(1.0 + zeta * zeta) + zeta))
