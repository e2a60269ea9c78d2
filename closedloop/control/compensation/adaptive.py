"""Adaptive compensation of the surface's friction: its Coulomb and viscous coefficients, learned while sliding.

    F̂_t = −(θ₁ f_des û + θ₂ u)                     û, u: of the desired motion, see `compensation.model`
    θ̇₁ = γ û·s,   θ̇₂ = γ f_des/v₀² u·s            s = P/(½ tr P) (ė + c e),   e = p_des − p along the surface

P is the tip's mobility along the surface. With a motion law ë + K_v ė + K_p e = P (F̂_t − F_t) and c < K_v the function

    V = ½ (ė² + 2 c e·ė + (K_p + c K_v) e²) + θ̃²/(2 Γ)       has V̇ = −c K_p e² − (K_v − c) ė² ≤ 0

for a posture that changes slowly, so the path error vanishes; the two coefficients are found apart only where the speed
varies. At constant speed the force settles with the rate γ c f_des P/K_p. Coefficients do not become negative.

Source: J. Craig, P. Hsu, S. Sastry, Adaptive control of mechanical manipulators, Int. J. Robotics Research 6(2), 1987,
whose regressor is cut down to friction.
"""

from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import RATE, SPEED_SCALE, Positive, gain_in
from closedloop.control.compensation.model import desired_direction
from closedloop.control.law import Compensation, ControlLaw, LawInput
from closedloop.control.tip_space import TipMotion, surface_mobility


class AdaptiveCompensation(Compensation):
    """[compensation] kind = "adaptive": the surface's Coulomb and viscous coefficients, estimated while sliding."""

    gain: Annotated[Positive, gain_in("1/m")] = Field(
        100.0, description="γ, 1/m: growth of the Coulomb coefficient per metre of path error"
    )
    corner: Annotated[Positive, RATE] = Field(
        20.0, description="c, 1/s: weight of the path error beside its rate; below motion_damping"
    )
    speed_scale: Annotated[Positive, SPEED_SCALE] = Field(
        0.02, description="v_0, m/s: speed at which both coefficients adapt at the same rate"
    )
    smoothing_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.001, description="desired speed below which nothing is adapted, m/s"
    )

    states: ClassVar = ("coulomb", "viscous")  # θ, without unit and N s/m

    def check(self, law: ControlLaw) -> None:
        """Refuse a corner with which the adaptation does not settle."""
        if isinstance(law, TipMotion) and self.corner >= law.motion_damping:
            raise ScenarioError(
                f"compensation.corner = {self.corner:g}: must be below law.motion_damping, {law.motion_damping:g}, "
                "for the adaptation to settle"
            )

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Add −AᵀF̂_t, N m."""
        if x.pressed == 0.0:
            return
        d1, d2, _ = desired_direction(x, par.smoothing_speed)
        push1 = z.coulomb * x.f_des * d1 + z.viscous * x.u_des[1]
        push2 = z.coulomb * x.f_des * d2 + z.viscous * x.u_des[2]
        for j in range(torque.shape[0]):
            torque[j] += x.A[1, j] * push1 + x.A[2, j] * push2

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write θ̇; zero off the surface and for a tip that cannot move along it."""
        dz.coulomb, dz.viscous = 0.0, 0.0
        if x.pressed == 0.0:
            return
        p11 = surface_mobility(x.S, x.pressed, 1, 1)
        p12 = surface_mobility(x.S, x.pressed, 1, 2)
        p22 = surface_mobility(x.S, x.pressed, 2, 2)
        mean = 0.5 * (p11 + p22)
        if not mean > 0.0:
            return
        e1 = x.u_des[1] - x.u[1] + par.corner * (x.p_des[1] - x.p[1])
        e2 = x.u_des[2] - x.u[2] + par.corner * (x.p_des[2] - x.p[2])
        s1, s2 = (p11 * e1 + p12 * e2) / mean, (p12 * e1 + p22 * e2) / mean
        d1, d2, _ = desired_direction(x, par.smoothing_speed)
        rate = par.gain * (d1 * s1 + d2 * s2)
        dz.coulomb = rate if z.coulomb > 0.0 or rate > 0.0 else 0.0
        scale = par.speed_scale
        rate = par.gain * x.f_des / (scale * scale) * (x.u_des[1] * s1 + x.u_des[2] * s2)
        dz.viscous = rate if z.viscous > 0.0 or rate > 0.0 else 0.0
