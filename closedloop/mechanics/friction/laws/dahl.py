"""dahl: an elastic bristle that yields at the Coulomb level.

    F_t = −σ_0 z f − b u,    ż = u − σ_0 |u|/μ z,    |z| <= μ/σ_0

In one dimension this is dF/dx = σ_0 (1 − F/F_C sgn u): with displacement, not with time, so hysteresis loops do not
depend on speed. A loop between ±x_0 has the force ±F_C tanh(σ_0 x_0/F_C) at its ends.

It has no static level above the kinetic one and no mode of sticking: a tip that is pulled below μ f creeps by the
deflection μ/σ_0 and stays.

Energy: σ_0|z|²/2 per newton of f is stored, and F_t·u + d/dt(stored) = −σ_0 a f|z|² − b|u|² <= 0 while f is
constant.

Source: P. R. Dahl, A solid friction model, The Aerospace Corporation, TOR-158(3107-18), 1968 (recalled); the
exponent of its factor (1 − F/F_C sgn u) is taken as 1, as is usual. It has no viscous part; b = 0 is the
published law.

Parameters: μ > 0, or for a joint the Coulomb torque, N m; σ_0 > 0, 1/m (N m/rad for a joint): μ/σ_0 is the largest
deflection, of the order of 1-50 µm for metals; b >= 0, N s/m (N m s/rad). States: z (d,), m (rad).
"""

from typing import Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.friction.bristle import advance, relax, stored
from closedloop.mechanics.friction.law import (
    FrictionLaw,
    JointFriction,
    JointStiffness,
    JointViscous,
    PositiveLevel,
    PositiveTorque,
    Slip,
    Stiffness,
    SurfaceFriction,
    Viscous,
    viscous_part,
)


@kernel
def yielding(stiffness: float, level: float, speed: float) -> float:
    """Return a = σ_0|u|/μ, 1/s, at the slip speed |u|."""
    return stiffness * speed / level


class Dahl(FrictionLaw):
    """The functions of the law, of the surface and of joints."""

    slip_states: ClassVar = ("deflection",)  # z, m (rad)

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write c = σ_0 z and w = b u."""
        for k in range(c.shape[0]):
            c[k] = par.stiffness * z.deflection[k]
        viscous_part(x, par.viscous, w)

    @staticmethod
    def rates(x: Slip, par: Any, z: Any, stuck: bool, dz: Any) -> None:
        """Write ż = u − a z."""
        relax(yielding(par.stiffness, par.kinetic, x.speed), x.u, z.deflection, dz.deflection)

    @staticmethod
    def decay(x: Slip, par: Any, z: Any, stuck: bool, a: Any) -> None:
        """Write a = σ_0|u|/μ."""
        a.deflection[:] = yielding(par.stiffness, par.kinetic, x.speed)

    @staticmethod
    def advance(x: Slip, par: Any, z: Any, stuck: bool, h: float) -> None:
        """Overwrite z with its value h seconds later."""
        advance(yielding(par.stiffness, par.kinetic, x.speed), x.u, h, z.deflection)

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return μ."""
        return par.kinetic

    @staticmethod
    def kinetic_level(par: Any) -> float:
        """Return μ."""
        return par.kinetic

    @staticmethod
    def stored_energy(par: Any, z: Any, stuck: bool) -> float:
        """Return ½ σ_0 |z|²."""
        return stored(par.stiffness, z.deflection)


class SurfaceDahl(Dahl, SurfaceFriction):
    """[friction] kind = "dahl": an elastic bristle that yields at the Coulomb level."""

    coefficient: PositiveLevel = Field(description="coefficient of friction μ, 1")
    stiffness: Stiffness = Field(description="bristle stiffness σ_0 per newton of normal force, 1/m")
    viscous: Viscous = Field(0.0, description="viscous coefficient b, N s/m, whatever the normal force")


class JointDahl(Dahl, JointFriction):
    """[joint_friction] kind = "dahl": an elastic bristle that yields at the Coulomb level."""

    kinetic: PositiveTorque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    stiffness: JointStiffness = Field(description="bristle stiffness σ_0, N m/rad")
    viscous: JointViscous = Field(0.0, description="viscous coefficient, N m s/rad")
