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
v_d/√(2e). The published values, with constant σ_1, fulfil neither. Where f changes, energy comes and goes with
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

import math
from typing import Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.friction.bristle import advance, relax
from closedloop.mechanics.friction.law import (
    Damping,
    Exponent,
    JointExponent,
    JointFriction,
    JointSpeed,
    JointStiffness,
    JointViscous,
    PositiveCoefficient,
    PositiveTorque,
    Slip,
    SlipSpeed,
    Stiffness,
    SurfaceFriction,
    Viscous,
    joint_parameters,
    surface_parameters,
    viscous_part,
)
from closedloop.mechanics.friction.laws.dahl import Dahl
from closedloop.mechanics.friction.laws.stribeck import level


@kernel
def yielding(par: Any, speed: float) -> float:
    """Return a = |u|/z_max, 1/s, at the slip speed |u|."""
    g = level(par.kinetic, par.static, par.stribeck_speed, par.exponent, speed)
    return par.stiffness * speed / g


@kernel
def damping(par: Any, speed: float) -> float:
    """Return σ_1 at the slip speed |u|, s/m, or N m s/rad."""
    ratio = min(speed / par.damping_speed, 30.0)
    return par.damping * math.exp(-ratio * ratio)


def passive_damping_speed(par: Any) -> float:
    """Return the largest v_d, m/s, with which the law never adds energy: 4√(2e) μ_k/σ_1."""
    return 4.0 * math.sqrt(2.0 * math.e) * float(par.kinetic) / float(par.damping) if par.damping > 0.0 else math.inf


def passive_viscous(par: Any, load: float = 1.0) -> float:
    """Return the least b, N s/m, with which the law never adds energy at normal forces up to `load`, N."""
    return load * float(par.damping * (par.static - par.kinetic) / par.kinetic)


def is_passive(par: Any, load: float = 1.0) -> bool:
    """Return whether the law is known never to add energy, by one of the two conditions above.

    `par`: parameters of one contact, by name.
    `load`: the largest normal force f, N; for a joint 1. It matters to the viscous condition alone.
    """
    return bool(par.viscous >= passive_viscous(par, load) or par.damping_speed <= passive_damping_speed(par))


class LuGre(Dahl):
    """The functions of the law, of the surface and of joints."""

    def resolved(self) -> dict[str, float]:
        """Return what the parameters that are left out are: without a v_d the damping does not fall."""
        return {} if getattr(self, "damping_speed", None) is not None else {"damping_speed": math.inf}

    def energy_fault(self, load: float = 1.0, n: int | None = None) -> str | None:
        """See `FrictionLaw.energy_fault`: at high speed, with the constant damping of its publication, it may."""
        contacts = [surface_parameters(self)] if n is None else joint_parameters(self, n)
        for joint, par in enumerate(contacts):
            if is_passive(par, load):
                continue
            place, speed, unit = ("", "m/s", "N s/m") if n is None else (f" of joint {joint}", "rad/s", "N m s/rad")
            cures = (
                f"damping_speed = {passive_damping_speed(par):.3g} {speed} or less",
                f"viscous = {passive_viscous(par, load):.3g} {unit} or more",
            )
            return f"lugre{place} may add energy at high speed: {cures[0]}, or {cures[1]}, would keep it from that"
        return None

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write c = σ_0 z + σ_1 ż and w = b u."""
        a, s = yielding(par, x.speed), damping(par, x.speed)
        for k in range(c.shape[0]):
            c[k] = par.stiffness * z.deflection[k] + s * (x.u[k] - a * z.deflection[k])
        viscous_part(x, par.viscous, w)

    @staticmethod
    def rates(x: Slip, par: Any, z: Any, stuck: bool, dz: Any) -> None:
        """Write ż = u − a z."""
        relax(yielding(par, x.speed), x.u, z.deflection, dz.deflection)

    @staticmethod
    def decay(x: Slip, par: Any, z: Any, stuck: bool, a: Any) -> None:
        """Write a = |u|/z_max."""
        a.deflection[:] = yielding(par, x.speed)

    @staticmethod
    def advance(x: Slip, par: Any, z: Any, stuck: bool, h: float) -> None:
        """Overwrite z with its value h seconds later."""
        advance(yielding(par, x.speed), x.u, h, z.deflection)

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return μ_s."""
        return par.static


class SurfaceLuGre(LuGre, SurfaceFriction):
    """[friction] kind = "lugre": damped bristles that yield at the Stribeck curve."""

    kinetic: PositiveCoefficient = Field(description="kinetic coefficient of friction μ_k, 1")
    static: PositiveCoefficient = Field(description="static coefficient of friction μ_s, 1; not below kinetic")
    stribeck_speed: SlipSpeed = Field(description="Stribeck speed v_s, between static and kinetic friction, m/s")
    exponent: Exponent = Field(2.0, description="exponent δ of the Stribeck curve; 2 as published")
    stiffness: Stiffness = Field(description="bristle stiffness σ_0 per newton of normal force, 1/m")
    damping: Damping = Field(description="bristle damping σ_1 per newton of normal force, s/m")
    damping_speed: SlipSpeed | None = Field(
        None, description="slip speed v_d of σ_1 exp(−(u/v_d)²), m/s; constant damping, as published, if left out"
    )
    viscous: Viscous = Field(0.0, description="viscous coefficient σ_2, N s/m, whatever the normal force")


class JointLuGre(LuGre, JointFriction):
    """[joint_friction] kind = "lugre": damped bristles that yield at the Stribeck curve."""

    kinetic: PositiveTorque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    static: PositiveTorque = Field(description="static (break-away) torque, N m; not below kinetic")
    stribeck_speed: JointSpeed = Field(description="Stribeck speed of the joint, rad/s")
    exponent: JointExponent = Field(2.0, description="exponent δ of the Stribeck curve; 2 as published")
    stiffness: JointStiffness = Field(description="bristle stiffness σ_0, N m/rad")
    damping: JointViscous = Field(description="bristle damping σ_1, N m s/rad")
    damping_speed: JointSpeed | None = Field(
        None, description="joint speed v_d of σ_1 exp(−(u/v_d)²), rad/s; constant damping, as published, if left out"
    )
    viscous: JointViscous = Field(0.0, description="viscous coefficient σ_2, N m s/rad")
