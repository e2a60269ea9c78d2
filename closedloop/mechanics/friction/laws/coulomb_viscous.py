"""coulomb_viscous: Coulomb's friction and a force proportional to the slip.

    slip     F_t = −μ f u/|u| − b u
    stick    |F_t| <= μ f

The viscous part does not depend on the normal force. Every law but coulomb may have one; it enters them all alike,
as the part w = b u.

Parameters: μ >= 0, or for a joint the Coulomb torque, N m; b >= 0, N s/m, or for a joint N m s/rad.
"""

from typing import Any

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.mechanics.friction.law import (
    JointFriction,
    JointViscous,
    Level,
    Slip,
    SurfaceFriction,
    Torque,
    Viscous,
    against_slip,
    viscous_part,
)
from closedloop.mechanics.friction.laws.coulomb import Coulomb


class CoulombViscous(Coulomb):
    """The functions of the law, of the surface and of joints."""

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write c = μ u/|u| and w = b u."""
        against_slip(x, par.kinetic, c)
        viscous_part(x, par.viscous, w)


class SurfaceCoulombViscous(CoulombViscous, SurfaceFriction):
    """[friction] kind = "coulomb_viscous": Coulomb's, and a force proportional to the slip."""

    coefficient: Level = Field(description="coefficient of friction μ, static and kinetic, 1")
    viscous: Viscous = Field(description="viscous coefficient b, N s/m, whatever the normal force")


class JointCoulombViscous(CoulombViscous, JointFriction):
    """[joint_friction] kind = "coulomb_viscous": Coulomb's, and a torque proportional to the joint velocity."""

    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    viscous: JointViscous = Field(description="viscous coefficient, N m s/rad")
