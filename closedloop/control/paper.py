"""The control law of the paper (Eq. 33), and the shape of a law of one's own.

    Q = −K_p (q − q_des) − K_d (q̇ − q̇_des)  +  C  +  Jᵣᵀn (−f_des)

The first two terms, the PD part, act from `pd_start` on; C (Coriolis, centrifugal and gravity) and the force term from
t = 0. The paper prints the position error as q − q_des; here the gains are positive numbers and the minus sign
stands in front, so a positive gain pulls the arm towards its path. The arm pushes the surface with f_des along −n,
hence the minus sign of the last term, and the surface answers with f along +n.

The paper has no force sensor. With `force_feedback` or `force_integral`, which are beside the paper, f_c of
`closedloop.control.force` takes the place of f_des.

A law of one's own is a function ``law(t, q, v, terms) -> Q`` (see `closedloop.simulation.simulate`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import select

if TYPE_CHECKING:
    from closedloop.robot.pinocchio import Terms

Array = NDArray[np.float64]
Law = Callable[[float, Array, Array, "Terms"], ArrayLike]
"""A control law: time, s; q, q̇ (n,) read-only; `Terms` of that state -> joint torque Q (n,), N m."""


@kernel_inlined
def paper_law(
    t: float,
    settings: Array,
    gains: Array,
    path: Array,
    q: Array,
    v: Array,
    C: Array,
    A: Array,
    torque: Array,
) -> None:
    """Write Q of Eq. 33.

    Parameters
    ----------
    t : float
        Time, s.
    settings : (2,) array
        f_des, N, and the instant from which the PD part acts, s.
    gains : (2, n) array
        K_p, N m/rad, and K_d, N m s/rad, per joint.
    path : (2, n) array
        q_des and q̇_des at t.
    q, v, C : (n,) arrays
        State and bias.
    A : (1, n) array
        nᵀJᵣ.
    torque : (n,) array
        Written: Q, N m.
    """
    pd = select(t >= settings[1], 1.0, 0.0)
    for j in range(q.shape[0]):
        torque[j] = (
            C[j] - A[0, j] * settings[0] - pd * (gains[0, j] * (q[j] - path[0, j]) + gains[1, j] * (v[j] - path[1, j]))
        )
