"""A disturbance observer in joint space: no model of friction, no acceleration sensor.

    q̈ = H⁻¹(Q − C + Aᵀn f) + δ        δ: what friction, in the joints and at the tip, adds
    δ̂ = K_o (q̇ − ξ)                  ξ̇ = H⁻¹(Q − C + Aᵀn f) + δ̂

hence δ̂' = K_o (δ − δ̂): the estimate follows what acts on the arm within 1/K_o, and the torque −H δ̂ takes it
out. f is what the force sensor says, so an error of the force counts as a disturbance too and settles with the
same rate. At an impact q̇ jumps unexplained, and δ̂ by K_o times as much, unless `restart_observer` is told of
it.

Sources: K. Ohnishi, M. Shibata, T. Murakami, Motion control for advanced mechatronics, IEEE/ASME Trans. Mechatronics
1(1), 1996; W.-H. Chen and others, A nonlinear disturbance observer for robotic manipulators, IEEE Trans. Industrial
Electronics 47(4), 2000.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.solve import back_substitute, forward_substitute
from closedloop.control.law_input import LawInput
from closedloop.control.parameters import RATE, VECTORS
from closedloop.control.tip_space import add_mass_times
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def add_observed(x: LawInput, par: Array, xi: Array, work: Array, torque: Array) -> None:
    """Add −H δ̂, N m; ξ (n,), rad/s."""
    n = torque.shape[0]
    estimate = work[VECTORS : VECTORS + n]
    for j in range(n):
        estimate[j] = par[RATE] * (x.v[j] - xi[j])
    add_mass_times(x.H, estimate, -1.0, torque)


@kernel
def observer_rates(x: LawInput, par: Array, xi: Array, f: float, torque: Array, work: Array, dxi: Array) -> None:
    """Write ξ̇ (n,), rad/s², from the torque that acts, N m, and the measured force, N."""
    n = torque.shape[0]
    a = work[VECTORS : VECTORS + n]
    for j in range(n):
        a[j] = torque[j] - x.C[j] + x.A[0, j] * f
    forward_substitute(x.L, a)
    back_substitute(x.L, a)
    for j in range(n):
        dxi[j] = a[j] + par[RATE] * (x.v[j] - xi[j])


@kernel
def restart_observer(dv: Array, xi: Array) -> None:
    """Keep the estimate over a jump dv (n,), rad/s, of the joint velocity: an impact that the controller knows of."""
    for j in range(xi.shape[0]):
        xi[j] += dv[j]
