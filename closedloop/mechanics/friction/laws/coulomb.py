"""coulomb: friction of one size, against the slip.

    slip     F_t = −μ f u/|u|
    stick    |F_t| <= μ f

Source: C. A. Coulomb, Théorie des machines simples, 1785, and any textbook.

Parameters: the coefficient μ >= 0 (dry steel on steel about 0.1-0.6), or for a joint the Coulomb torque, N m.
"""

from typing import Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.mechanics.friction.law import (
    FrictionLaw,
    JointFriction,
    Level,
    Slip,
    SurfaceFriction,
    Torque,
    against_slip,
)


class Coulomb(FrictionLaw):
    """The functions of the law, of the surface and of joints."""

    sticks: ClassVar = "rigid"

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write c = μ u/|u|."""
        against_slip(x, par.kinetic, c)

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return μ, or the Coulomb torque, N m."""
        return par.kinetic

    @staticmethod
    def kinetic_level(par: Any) -> float:
        """Return the same."""
        return par.kinetic


class SurfaceCoulomb(Coulomb, SurfaceFriction):
    """[friction] kind = "coulomb": of one size, against the slip."""

    coefficient: Level = Field(description="coefficient of friction μ, static and kinetic, 1")


class JointCoulomb(Coulomb, JointFriction):
    """[joint_friction] kind = "coulomb": of one size, against the motion."""

    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
