"""Projection: the stabiliser that puts the state back on the closure after each step, instead of pulling it there.

The position moves by Δq = −H⁻¹Aᵀ (A H⁻¹Aᵀ)⁻¹ e until e is down to rounding, then the velocity by
Δq̇ = −H⁻¹Aᵀ (A H⁻¹Aᵀ)⁻¹ A q̇. Of all moves that close the loop these are the smallest in the norm of the mass matrix:
what a contact impulse would do. The force of Eq. 24 carries no share of it, and the stabiliser has no gain to choose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import entry_kernel
from closedloop.solve import back_substitute, cholesky, forward_substitute
from closedloop.step import GRAVITY, OFFSET, PLANE, STABILISER, STEP
from closedloop.tip import tip_kinematics

Array = NDArray[np.float64]

POSITION, VELOCITY = 0, 1

# e = n·r − d is a sum of a few products of numbers of a metre: 4 ε each way. Newton's method is quadratic, and from the
# nanometres or micrometres that a step leaves it is there after one move; five are for a start a millimetre off.
CLOSED = 2e-15
MOST_MOVES = 5


@entry_kernel
def project_on_pinocchio(
    level: int, memory: Array, work: Array, H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array,
    velocity: Array, acceleration: Array, constants: Array, joints: Array,
) -> float:  # fmt: skip
    """Move the state once towards the closure, on what Pinocchio's passes left; return how far off it was.

    Parameters
    ----------
    level : int
        POSITION: move q if |e| is over CLOSED, and return |e|, m. VELOCITY: move q̇, and return |A q̇|, m/s.
    memory : (>=2, n) array
        q and q̇, moved in place.
    work : (n + 5, n) array
        Scratch.
    H, C, joint_jacobian, rotation, origin, velocity, acceleration, constants, joints
        See `closedloop.step.step_on_pinocchio`; C is not read.
    """
    n = memory.shape[1]
    L, J, A, X = work[0:n], work[n : n + 3], work[n + 3], work[n + 4]
    point = np.empty((2, 3))
    tip_kinematics(
        joint_jacobian, rotation, origin, velocity, acceleration,
        constants[OFFSET:GRAVITY], constants[GRAVITY:STEP], joints[2], J, point[0], point[1],
    )  # fmt: skip
    plane = constants[PLANE:STABILISER]
    off: float = 0.0
    for j in range(n):
        A[j] = plane[0] * J[0, j] + plane[1] * J[1, j] + plane[2] * J[2, j]
        X[j] = A[j]
        off += A[j] * memory[1, j]
    if level == POSITION:
        r = point[0]
        off = plane[0] * r[0] + plane[1] * r[1] + plane[2] * r[2] - plane[3]
        if abs(off) <= CLOSED:
            return float(abs(off))
    if not cholesky(H, L):
        return float(abs(off))  # the next step says so
    forward_substitute(L, X)
    mobility = 0.0
    for j in range(n):
        mobility += X[j] * X[j]
    back_substitute(L, X)
    if mobility > 0.0:
        for j in range(n):
            memory[level, j] -= X[j] * off / mobility
    return float(abs(off))
