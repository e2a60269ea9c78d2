"""karnopp: friction with a band of speeds in which slip counts as none.

    |u| > D_v      F_t = −μ_k f u/|u| − b u
    |u| <= D_v     sticking is tried: the tip sticks if |F_t| <= μ_s f is enough to hold it

The band is what makes the model quick with a fixed step: the instant of zero slip need not be found. In
Karnopp's original the momentum is kept within the band; here a tip that sticks has u = 0, and what D_v takes is
at most the energy of that slow slip.

Source: D. Karnopp, Computer simulation of stick-slip friction in mechanical dynamic systems, J. Dyn. Sys.,
Meas., Control 107 (1985) 100-103. It leaves the slip function open; here it is Coulomb's and a viscous part.

Parameters: 0 <= μ_k <= μ_s, or for a joint torques, N m; D_v > 0, m/s (rad/s), small against the speeds of
interest; b >= 0, N s/m (N m s/rad).
"""

from typing import Any

from pydantic import Field

from closedloop.mechanics.friction.law import (
    Coefficient,
    JointFriction,
    JointSpeed,
    JointViscous,
    SlipSpeed,
    SurfaceFriction,
    Torque,
    Viscous,
)
from closedloop.mechanics.friction.laws.coulomb_viscous import CoulombViscous


class Karnopp(CoulombViscous):
    """The functions of the law, of the surface and of joints."""

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return μ_s."""
        return par.static

    @staticmethod
    def capture_speed(par: Any) -> float:
        """Return D_v, m/s or rad/s."""
        return par.dead_band


class SurfaceKarnopp(Karnopp, SurfaceFriction):
    """[friction] kind = "karnopp": slip within a band of speeds counts as none."""

    kinetic: Coefficient = Field(description="kinetic coefficient of friction μ_k, 1")
    static: Coefficient = Field(description="static coefficient of friction μ_s, 1; not below kinetic")
    dead_band: SlipSpeed = Field(description="slip speed D_v up to which the tip may be held, m/s")
    viscous: Viscous = Field(0.0, description="viscous coefficient b, N s/m, whatever the normal force")


class JointKarnopp(Karnopp, JointFriction):
    """[joint_friction] kind = "karnopp": motion within a band of speeds counts as none."""

    kinetic: Torque = Field(description="kinetic (Coulomb) torque, N m, one per joint or one for all")
    static: Torque = Field(description="static (break-away) torque, N m; not below kinetic")
    dead_band: JointSpeed = Field(description="joint speed up to which the joint may be held, rad/s")
    viscous: JointViscous = Field(0.0, description="viscous coefficient, N m s/rad")
