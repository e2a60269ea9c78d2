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

import math
from typing import Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.friction.law import (
    Coefficient,
    Exponent,
    JointExponent,
    JointFriction,
    JointSpeed,
    JointViscous,
    Slip,
    SlipSpeed,
    SurfaceFriction,
    Torque,
    Viscous,
    against_slip,
    viscous_part,
)
from closedloop.mechanics.friction.laws.coulomb_viscous import CoulombViscous


@kernel
def level(kinetic: float, static: float, stribeck_speed: float, exponent: float, speed: float) -> float:
    """Return g(v) at the slip speed v >= 0, without unit, or N m."""
    ratio = speed / stribeck_speed
    if ratio <= 0.0:
        fall = 1.0
    elif exponent == 2.0:
        near = min(ratio, 30.0)  # exp(−900) is zero already
        fall = math.exp(-near * near)
    else:
        fall = math.exp(-math.exp(min(exponent * math.log(ratio), 7.0)))  # exp(−e⁷) likewise
    return kinetic + (static - kinetic) * fall


class Stribeck(CoulombViscous):
    """The functions of the law, of the surface and of joints."""

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write c = g(|u|) u/|u| and w = b u."""
        g = level(par.kinetic, par.static, par.stribeck_speed, par.exponent, x.speed)
        against_slip(x, g, c)
        viscous_part(x, par.viscous, w)

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return μ_s."""
        return par.static


class SurfaceStribeck(Stribeck, SurfaceFriction):
    """[friction] kind = "stribeck": falls from its static to its kinetic level as slip gets faster."""

    kinetic: Coefficient = Field(description="kinetic coefficient of friction μ_k, 1")
    static: Coefficient = Field(description="static coefficient of friction μ_s, 1; not below kinetic")
    stribeck_speed: SlipSpeed = Field(description="Stribeck speed v_s, between static and kinetic friction, m/s")
    exponent: Exponent = Field(2.0, description="exponent δ of the Stribeck curve; 2: Gaussian, 1: exponential")
    viscous: Viscous = Field(0.0, description="viscous coefficient b, N s/m, whatever the normal force")


class JointStribeck(Stribeck, JointFriction):
    """[joint_friction] kind = "stribeck": falls from its static to its kinetic level as the joint gets faster."""

    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    static: Torque = Field(description="static (break-away) torque, N m; not below kinetic")
    stribeck_speed: JointSpeed = Field(description="Stribeck speed of the joint, rad/s")
    exponent: JointExponent = Field(2.0, description="exponent δ of the Stribeck curve; 2: Gaussian, 1: exponential")
    viscous: JointViscous = Field(0.0, description="viscous coefficient, N m s/rad")
