"""seven_parameter: a spring while stuck; while sliding a Stribeck curve that remembers rest and lags the slip.

    stuck     F_t = −k_t x f                              until k_t|x| = F_C + F_S(γ, t_d)
    sliding   F_t = −[F_C + F_S(γ, t_d)/(1 + (v(t − τ_L)/v_s)²)] f u/|u| − F_v u
    F_S(γ, t_d) = F_Sa + (F_S∞ − F_Sa) t_d/(t_d + γ)

t_d is the dwell time, how long the contact was stuck before it slid, F_Sa the Stribeck part at the end of the
slide before that, v(t − τ_L) the slip speed of a moment ago. F_S is the *excess* over F_C. The Stribeck curve
is Lorentzian (that of LuGre is Gaussian): their v_s are not the same figure.

Slip turns into sticking where u = 0. Then F_Sa becomes the Stribeck part of that instant, t_d starts at 0, and
x, the displacement from where the spring is relaxed, starts in the direction of the slip at the length at which
the spring pulls as the slip did (`stick`). So the force does not jump. At break-away it does not jump either if
the slip of a moment ago was none. (The start of x is this project's choice.)

Energy: k_t|x|²/2 per newton of f is stored while stuck, (F_C + F_S)²/(2 k_t) while sliding (the asperities stay
bent). It does not jump at break-away and can only fall where slip ends, so the law never adds energy while f is
constant. Stuck, it has no damping at all, as published: a tip that is stuck goes on quivering.

Source: B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, A survey of models, analysis tools and compensation
methods for the control of machines with friction, Automatica 30 (1994) 1083-1138; the equations as public code
quotes them, a bracket of F_S(γ, t_d) put right so that t_d = 0 gives F_Sa and a long rest F_S∞.

Parameters. The ranges are those of that survey as recalled: neither its table nor a work that quotes it could be
found to check them, so take them for orders of magnitude. F_C 0.001-0.1 of the normal force; F_v from 0, N s/m;
F_S∞ 0.001-0.1 of the normal force; k_t = (F_C + F_S)/δx with δx 1-50 µm, 1/m; v_s 1e-5-0.1 m/s; τ_L 1-50 ms; γ
0-200 s, where 0 is a static friction that is there at once. For a joint torques in N m, and rad for m. States:
t_d, s; F_Sa; x (d,), m (rad).
"""

from typing import Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.friction.law import (
    Coefficient,
    FrictionLaw,
    JointFriction,
    JointSpan,
    JointSpeed,
    JointStiffness,
    JointViscous,
    Slip,
    SlipSpeed,
    Span,
    Stiffness,
    SurfaceFriction,
    Torque,
    Viscous,
    against_slip,
    length_of,
    viscous_part,
)


@kernel
def static_excess(par: Any, z: Any) -> float:
    """Return F_S(γ, t_d) after a dwell time t_d, s, and a slide that ended at the Stribeck part F_Sa."""
    if par.rise_time == 0.0:
        return par.static_excess
    return z.last + (par.static_excess - z.last) * z.dwell / (z.dwell + par.rise_time)


@kernel
def stribeck_part(par: Any, delayed_speed: float, z: Any) -> float:
    """Return F_S/(1 + (v/v_s)²) for the slip speed v of τ_L ago, m/s."""
    ratio = min(delayed_speed / par.stribeck_speed, 1e100)
    return static_excess(par, z) / (1.0 + ratio * ratio)


@kernel
def breakaway(par: Any, z: Any) -> float:
    """Return F_C + F_S(γ, t_d), at which a contact that is stuck starts to slide."""
    return par.kinetic + static_excess(par, z)


class SevenParameter(FrictionLaw):
    """The functions of the law, of the surface and of joints."""

    sticks: ClassVar = "spring"
    states: ClassVar = ("dwell", "last")  # t_d, s, and F_Sa
    slip_states: ClassVar = ("displacement",)  # x, m (rad)

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write c = (F_C + F_S/(1 + (v/v_s)²)) u/|u| and w = F_v u."""
        against_slip(x, par.kinetic + stribeck_part(par, x.delayed_speed, z), c)
        viscous_part(x, par.viscous, w)

    @staticmethod
    def hold(par: Any, z: Any, c: Array) -> None:
        """Write c = k_t x."""
        for k in range(c.shape[0]):
            c[k] = par.stiffness * z.displacement[k]

    @staticmethod
    def rates(x: Slip, par: Any, z: Any, stuck: bool, dz: Any) -> None:
        """Write the rates of t_d and x, which rest while it slides."""
        dz.dwell, dz.last = (1.0 if stuck else 0.0), 0.0
        for k in range(x.u.shape[0]):
            dz.displacement[k] = x.u[k] if stuck else 0.0

    @staticmethod
    def advance(x: Slip, par: Any, z: Any, stuck: bool, h: float) -> None:
        """Overwrite t_d and x with their values h seconds later."""
        if stuck:
            z.dwell += h
            for k in range(x.u.shape[0]):
                z.displacement[k] += h * x.u[k]

    @staticmethod
    def stick(x: Slip, par: Any, z: Any) -> None:
        """Overwrite the states where slip has just ended: the spring takes over its force."""
        last = stribeck_part(par, x.delayed_speed, z)
        for k in range(x.direction.shape[0]):
            z.displacement[k] = (par.kinetic + last) / par.stiffness * x.direction[k]
        z.dwell = 0.0
        z.last = last

    @staticmethod
    def rest(par: Any, z: Any) -> None:
        """Write F_Sa: static friction has fully risen."""
        z.last = par.static_excess

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return F_C + F_S(γ, t_d)."""
        return breakaway(par, z)

    @staticmethod
    def kinetic_level(par: Any) -> float:
        """Return F_C."""
        return par.kinetic

    @staticmethod
    def lag(par: Any) -> float:
        """Return τ_L, s."""
        return par.memory_delay

    @staticmethod
    def stored_energy(par: Any, z: Any, stuck: bool) -> float:
        """Return ½ k_t |x|²; while it slides, what is stored in asperities that stay bent."""
        reach = length_of(z.displacement) if stuck else breakaway(par, z) / par.stiffness
        return 0.5 * par.stiffness * reach * reach


class SurfaceSevenParameter(SevenParameter, SurfaceFriction):
    """[friction] kind = "seven_parameter": static friction that rises with rest, friction that lags the slip."""

    kinetic: Coefficient = Field(description="Coulomb level F_C per newton of normal force, 1")
    static_excess: Coefficient = Field(description="F_S∞: static level after a long rest, less F_C, 1")
    stribeck_speed: SlipSpeed = Field(description="slip speed v_s at which half the excess is left, m/s")
    stiffness: Stiffness = Field(description="stiffness k_t while stuck per newton of normal force, 1/m")
    memory_delay: Span = Field(description="τ_L: by how much the friction lags the slip, s")
    rise_time: Span = Field(description="γ: dwell time after which static friction has half risen, s")
    viscous: Viscous = Field(0.0, description="viscous coefficient F_v, N s/m, whatever the normal force")


class JointSevenParameter(SevenParameter, JointFriction):
    """[joint_friction] kind = "seven_parameter": static friction rises with rest, friction lags the motion."""

    kinetic: Torque = Field(description="kinetic (Coulomb) torque F_C, N m, one per joint or one for all")
    static_excess: Torque = Field(description="F_S∞: static torque after a long rest, less F_C, N m")
    stribeck_speed: JointSpeed = Field(description="joint speed v_s at which half the excess is left, rad/s")
    stiffness: JointStiffness = Field(description="stiffness k_t while stuck, N m/rad")
    memory_delay: JointSpan = Field(description="τ_L: by how much the friction lags the motion, s")
    rise_time: JointSpan = Field(description="γ: dwell time after which static friction has half risen, s")
    viscous: JointViscous = Field(0.0, description="viscous coefficient F_v, N m s/rad")
