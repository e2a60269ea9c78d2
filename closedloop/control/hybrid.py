"""Hybrid position/force control, each direction either of the one or of the other (Raibert and Craig 1981).

    Q = C + K_p [T⁺(p_des − p)_t + N (q_des − q)] + K_d [T⁺(u_des − u)_t + N (q̇_des − q̇)] − Aᵀn f_c

T = (t1, t2)ᵀJᵣ are the two rows of the position-controlled directions, (S J) with the selection matrix S, and N
= 1 − A⁺A leaves the tip alone. The gains act on joints, as in the original; the position error reaches them
through (S J)⁺, because with J⁻¹S the loop is unstable in some postures though the gains are positive (An and
Hollerbach 1987), and (S J)⁺S J is a projection, which is not (Fisher and Mujtaba 1992). The original leaves
gravity to the integral terms; here C is fed forward, as in Eq. 33.

Off the surface the normal direction is the motion of `closedloop.control.tip_space.motion_along_normal`: towards the
surface only if f_des > 0.

Nothing decouples the directions: while joint errors last, the force deviates from f_c by −(nᵀA H⁻¹(...))/(nᵀS n).

Sources: M. Raibert, J. Craig, J. Dynamic Systems, Measurement and Control 103(2), 1981; W. Fisher, S. Mujtaba, Hybrid
position/force control: a correct formulation, Int. J. Robotics Research 11(4), 1992.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.law_input import LawInput
from closedloop.control.parameters import APPROACH, EIGEN, FORCE, INVERSE, K_V, SPARE, VECTORS
from closedloop.control.tip_space import jacobian_gram, motion_along_normal, pseudo_inverse
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def hybrid(x: LawInput, par: Array, gains: Array, f: float, work: Array, torque: Array) -> None:
    """Write Q (n,).

    Parameters
    ----------
    x : LawInput
    par : array
        See `closedloop.control.parameters`.
    gains : (2, n) array
        K_p, N m/rad, and K_d, N m s/rad, per joint.
    f : float
        f_c, N.
    work : (work_size(n),) array
        Scratch.
    torque : (n,) array
        Written, N m.
    """
    n = x.q.shape[0]
    inverse, error = work[INVERSE : INVERSE + 9].reshape(3, 3), work[VECTORS : VECTORS + n]
    push = -f
    if x.pressed == 0.0:
        a = motion_along_normal(x, f, 0.25 * par[K_V] * par[K_V], par[K_V], par[APPROACH])  # critically damped
        push = a / x.S[0, 0] if x.S[0, 0] > 0.0 else 0.0
    for j in range(n):
        torque[j] = x.C[j] + x.A[0, j] * push
    for part in range(2):  # position, then velocity
        have, want = (x.q, x.q_des) if part == 0 else (x.v, x.v_des)
        for j in range(n):
            error[j] = want[j] - have[j]
        # N e = e − A⁺A e
        jacobian_gram(x.A, 0, inverse)
        pseudo_inverse(inverse, work[EIGEN : EIGEN + 18], inverse)
        for i in range(3):
            s = 0.0
            for j in range(n):
                s += x.A[i, j] * error[j]
            work[SPARE + i] = -s
        _add_transposed(x.A, inverse, work[SPARE : SPARE + 3], work[FORCE : FORCE + 3], error)
        # + T⁺ e_t
        jacobian_gram(x.A, 1, inverse)
        pseudo_inverse(inverse, work[EIGEN : EIGEN + 18], inverse)
        work[SPARE] = 0.0
        for i in range(1, 3):
            work[SPARE + i] = x.p_des[i] - x.p[i] if part == 0 else x.u_des[i] - x.u[i]
        _add_transposed(x.A, inverse, work[SPARE : SPARE + 3], work[FORCE : FORCE + 3], error)
        for j in range(n):
            torque[j] += gains[part, j] * error[j]


@kernel
def _add_transposed(A: Array, inverse: Array, e: Array, y: Array, joints: Array) -> None:
    """Add Aᵀ(A Aᵀ)⁺e to `joints`; `y` (3,) is scratch."""
    for i in range(3):
        y[i] = inverse[i, 0] * e[0] + inverse[i, 1] * e[1] + inverse[i, 2] * e[2]
    for j in range(joints.shape[0]):
        joints[j] += A[0, j] * y[0] + A[1, j] * y[1] + A[2, j] * y[2]
