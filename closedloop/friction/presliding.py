"""Before slip: the tip or joint on its bristles is a mass on a spring and a damper, and sets the step.

    m ü + (σ_1 f + b) u̇ + σ_0 f u = 0        ω = √(σ_0 f/m),  ζ = (σ_1 f + b)/(2 m ω)

A semi-implicit Euler step h of it is stable for ω²h² + 4ζωh < 4 (Jury's test of z² − (2 − 2ζωh − ω²h²) z + 1 −
2ζωh), and that also bounds a step with `laws.advance_states`, whose bristles before slip move as the tip does.
"""

from __future__ import annotations

import math

from closedloop.friction.layout import DAMPING, STIFFNESS, VISCOUS
from closedloop.friction.packing import pack
from closedloop.friction.sections import Law


def presliding_motion(
    section: Law, mass: float, load: float = 1.0, joint: int | None = None, n: int = 1
) -> tuple[float, float]:
    """Return the natural frequency ω, rad/s, and the damping ratio ζ of small motions before slip.

    Parameters
    ----------
    section : Law
        A law with a stiffness: dahl, lugre or seven_parameter (which has no damping while it is stuck).
    mass : float
        Mass that moves, kg; of the tip of an arm 1/(tᵀA H⁻¹Aᵀt) along a tangent t. Of a joint, kg m².
    load : float
        Normal force f, N; 1 for a joint.
    joint, n : int, optional
        Which of n joints; left out for a surface.
    """
    par = pack(section)[1] if joint is None else pack(section, n)[1][joint]
    if par[STIFFNESS] == 0.0:
        raise ValueError(f"{getattr(section, 'kind', section)} has no stiffness: give dahl, lugre or seven_parameter")
    omega = math.sqrt(par[STIFFNESS] * load / mass)
    damper = 0.0 if getattr(section, "kind", "") == "seven_parameter" else par[DAMPING] * load + par[VISCOUS]
    return omega, float(damper) / (2.0 * mass * omega)


def largest_step(omega: float, zeta: float) -> float:
    """Return the step h, s, below which semi-implicit Euler is stable: 2 (√(1 + ζ²) − ζ)/ω."""
    return 2.0 / (omega * (math.sqrt(1.0 + zeta * zeta) + zeta))
