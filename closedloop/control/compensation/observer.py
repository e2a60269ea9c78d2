"""A disturbance observer in joint space: no model of friction, no acceleration sensor.

    q̈ = H⁻¹(Q − C + Aᵀn f) + δ        δ: what friction, in the joints and at the tip, adds
    δ̂ = K_o (q̇ − ξ)                  ξ̇ = H⁻¹(Q − C + Aᵀn f) + δ̂

hence δ̂' = K_o (δ − δ̂): the estimate converges with the time constant 1/K_o, and the torque −H δ̂ compensates it. f is
the reading of the force sensor, so an error of the force counts as a disturbance too and settles with the same rate. At
an impact q̇ jumps, and δ̂ by K_o times as much, unless `restart` corrects ξ.

Sources: K. Ohnishi, M. Shibata, T. Murakami, Motion control for advanced mechatronics, IEEE/ASME Trans. Mechatronics
1(1), 1996; W.-H. Chen and others, A nonlinear disturbance observer for robotic manipulators, IEEE Trans. Industrial
Electronics 47(4), 2000.
"""

from typing import Annotated, Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import RATE, Positive
from closedloop.control.law import Compensation, LawInput
from closedloop.control.tip_space import add_mass_times
from closedloop.mechanics.closure.solve import back_substitute, forward_substitute


class ObserverCompensation(Compensation):
    """[compensation] kind = "observer": friction in joints and at the tip estimated from the joints' motion."""

    rate: Annotated[Positive, RATE] = Field(
        100.0, description="K_o, 1/s: the estimate follows a disturbance with the time constant 1/K_o"
    )

    joint_states: ClassVar = ("observed_velocity",)  # ξ, rad/s

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Add −H δ̂, N m."""
        n = torque.shape[0]
        estimate = x.scratch[0:n]
        for j in range(n):
            estimate[j] = par.rate * (x.v[j] - z.observed_velocity[j])
        add_mass_times(x.H, estimate, -1.0, torque)

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write ξ̇ (n,), rad/s², from the torque that acts, N m, and the measured force, N."""
        n = torque.shape[0]
        a = x.scratch[0:n]
        for j in range(n):
            a[j] = torque[j] - x.C[j] + x.A[0, j] * f
        forward_substitute(x.L, a, 0, n)
        back_substitute(x.L, a, 0, n)
        for j in range(n):
            dz.observed_velocity[j] = a[j] + par.rate * (x.v[j] - z.observed_velocity[j])

    @staticmethod
    def start(x: LawInput, par: Any, z: Any) -> None:
        """Write ξ at the start of a run, with the estimate zero."""
        for j in range(x.v.shape[0]):
            z.observed_velocity[j] = x.v[j]

    @staticmethod
    def restart(dv: Array, par: Any, z: Any) -> None:
        """Keep the estimate over a jump dv (n,), rad/s, of the joint velocity: the controller knows of the impact."""
        for j in range(dv.shape[0]):
            z.observed_velocity[j] += dv[j]
