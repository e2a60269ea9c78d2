"""Everything of a step but the robot's own terms, in one compiled call: law, closure, Eq. 24, record, advance.

The caller provides H, C, Jᵣ, r and J̇ᵣq̇ of the state (q, v), from Pinocchio or from anything else; this function asks
no further. Between calls nothing is kept but the arrays it was given.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.closure import plane_rows, stabilised_acceleration
from closedloop.compiled import entry_kernel, kernel
from closedloop.control import paper_law
from closedloop.integrate import advance
from closedloop.solve import DIVERGED, OK, condition, eliminate, residual
from closedloop.tip import tip_kinematics

Array = NDArray[np.float64]

# A joint at 10⁴ rad/s (m/s) is no robot any more; the run stops there, long before the numbers overflow.
SPEED_LIMIT = 1e4

# The law is evaluated outside (a user's Python function) or here (Eq. 33).
LAW_GIVEN, LAW_PAPER = 0, 1


# Where the parts of `constants` begin.
PLANE, STABILISER, SETTINGS, OFFSET, GRAVITY, STEP, NODE, SEMI_IMPLICIT, CONSTANTS = (
    0,
    4,
    6,
    8,
    11,
    14,
    15,
    16,
    17,
)


def pack_constants(
    plane: ArrayLike,
    stabiliser: ArrayLike,
    settings: ArrayLike,
    offset: ArrayLike,
    gravity: ArrayLike,
    h: float,
    node_spacing: float,
    semi_implicit: bool,
) -> Array:
    """Return the (CONSTANTS,) array of everything that stays the same from step to step.

    Each array argument costs a call from Python about 60 ns, so the constants travel as one.

    Parameters
    ----------
    plane : (4,) array
        Unit normal n and offset d, m.
    stabiliser : (2,) array
        s_v, 1/s, and s_p, 1/s²; zeros for none.
    settings : (2,) array
        f_des, N, and the instant from which the PD part acts, s.
    offset : (3,) array
        Tip in the frame of the joint that carries it, m.
    gravity : (3,) array
        m/s², base frame.
    h, node_spacing : float
        Step, and time between two rows of the path, s.
    semi_implicit : bool
        See `closedloop.integrate.advance`.
    """
    parts = (plane, stabiliser, settings, offset, gravity, h, node_spacing, semi_implicit)
    return np.concatenate([np.asarray(x, dtype=np.float64).ravel() for x in parts])


@kernel
def memory_layout(n: int, m: int, stages: int) -> tuple[int, int, int, int]:
    """Return where in a step's memory, an array of rows of n numbers, its parts begin, and how many rows it has.

    The first three rows are q, q̇ and Q; then follow the integrator's stages, then Jᵣ (3 rows), the matrices of
    Eq. 24 (2 m + n + 3 rows), and numbers that come in threes and m's.
    """
    jacobian = 3 + 2 * (stages + 1)
    matrices = jacobian + 3
    small = matrices + 2 * m + n + 3
    return jacobian, matrices, small, small + (6 + 8 * m + m * m + n - 1) // n


class Row(NamedTuple):
    """Where each column begins in a recorded row; `width` is the row's length."""

    q: int
    v: int
    acceleration: int
    torque: int
    position: int
    velocity: int
    contact_force: int
    stabiliser_force: int
    closure_error: int
    closure_rate: int
    scalars: int
    width: int

    @classmethod
    def of(cls, n: int, m: int) -> Row:
        """Lay out a row for n joints and m closure rows."""
        lengths = (n, n, n, n, 3, 3, m, m, m, m, len(SCALARS))
        ends = np.cumsum((0, *lengths)).tolist()
        return cls(*ends)


SCALARS = ("residual_motion", "residual_closure", "kkt_condition", "normal_mobility", "kinetic_energy")


@kernel
def record(
    row: Array, q: Array, v: Array, qdd: Array, torque: Array, r: Array, J: Array, f: Array, f_stabiliser: Array,
    e: Array, rate: Array, scalars: tuple[float, float, float, float, float],
) -> None:  # fmt: skip
    """Write one row in the order of `Row`."""
    n, m = q.shape[0], f.shape[0]
    for j in range(n):
        row[j] = q[j]
        row[n + j] = v[j]
        row[2 * n + j] = qdd[j]
        row[3 * n + j] = torque[j]
    at = 4 * n
    for k in range(3):
        row[at + k] = r[k]
        speed = 0.0
        for j in range(n):
            speed += J[k, j] * v[j]
        row[at + 3 + k] = speed
    at += 6
    for k in range(m):
        row[at + k] = f[k]
        row[at + m + k] = f_stabiliser[k]
        row[at + 2 * m + k] = e[k]
        row[at + 3 * m + k] = rate[k]
    at += 4 * m
    for k in range(5):
        row[at + k] = scalars[k]


@kernel
def kinetic_energy(H: Array, v: Array) -> float:
    """Return ½ q̇ᵀH q̇, J, from H's upper triangle."""
    total = 0.0
    for i in range(v.shape[0]):
        total += 0.5 * H[i, i] * v[i] * v[i]
        for j in range(i + 1, v.shape[0]):
            total += H[i, j] * v[i] * v[j]
    return total


@kernel
def step(
    i: int, at: int, stage: int, law: int, H: Array, C: Array, J: Array, r: Array, drift: Array,
    constants: Array, joints: Array, path: Array, tableau: Array, memory: Array, rows: Array,
) -> int:  # fmt: skip
    """Do one stage of one step, once the terms of the state are known.

    Parameters
    ----------
    i : int
        The row that this step writes; after the last row nothing is advanced.
    at : int
        The row of `path` that belongs to this stage's instant.
    stage : int
        Stage of the integrator; stage 0 is the row's own state and is recorded.
    law : int
        LAW_PAPER: evaluate Eq. 33 into the torque. LAW_GIVEN: use the torque as it is.
    H, C, J, r, drift : (n, n), (n,), (>=3, n), (3,), (3,) arrays
        The terms; only H's upper triangle is read.
    constants : (CONSTANTS,) array
        See `pack_constants`.
    joints : (3, n) array
        K_p, K_d and whether the joint moves the tip (1 or 0).
    path : (P, 2, n) array
        q_des and q̇_des.
    tableau : (S + 1, S) array
        See `closedloop.integrate.advance`.
    memory : (rows, n) array
        q, q̇ and Q, of which the first two are advanced in place and the third is written or read; then
        scratch, see `memory_layout`.
    rows : (N, width) array
        Row i is written at stage 0; see `Row`.

    Returns
    -------
    status : int
        OK, SINGULAR, NOT_POSITIVE_DEFINITE or DIVERGED; the row is written, and the state advanced, only if OK.
    """
    n, m = memory.shape[1], 1
    q, v, torque = memory[0], memory[1], memory[2]
    _, w, small_at, _ = memory_layout(n, m, tableau.shape[1])
    A, X, L = memory[w : w + m], memory[w + m : w + 2 * m], memory[w + 2 * m : w + 2 * m + n]
    w += 2 * m + n
    y, qdd, column = memory[w], memory[w + 1], memory[w + 2]
    small = memory[small_at:].reshape(-1)[6:]
    gamma, e, rate, b = small[0:m], small[m : 2 * m], small[2 * m : 3 * m], small[3 * m : 4 * m]
    b_stabiliser, f, f_stabiliser = small[4 * m : 5 * m], small[5 * m : 6 * m], small[6 * m : 7 * m]
    share, S = small[7 * m : 8 * m], small[8 * m : 8 * m + m * m].reshape(m, m)

    plane_rows(constants[PLANE:STABILISER], J, r, drift, v, A, gamma, e, rate)
    if law == LAW_PAPER:
        paper_law(at * constants[NODE], constants[SETTINGS:OFFSET], joints, path[at], q, v, C, A, torque)
    stabilised_acceleration(constants[STABILISER:SETTINGS], gamma, e, rate, b, b_stabiliser)
    status, mobility = eliminate(H, torque, C, A, b, b_stabiliser, J, L, X, S, y, qdd, f, f_stabiliser)
    if status != OK:
        return status
    total = abs(f[0])
    for j in range(n):
        total += abs(qdd[j])
        if not abs(v[j]) <= SPEED_LIMIT:
            return DIVERGED
    if not math.isfinite(total):
        return DIVERGED
    if stage == 0:
        motion, closed = residual(H, torque, C, A, b, y, X, qdd, f)
        k = condition(H, A, L, X, S, column, share)
        record(
            rows[i], q, v, qdd, torque, r, J, f, f_stabiliser, e, rate,
            (motion, closed, k, mobility, kinetic_energy(H, v)),
        )  # fmt: skip
    if i + 1 < rows.shape[0]:
        advance(stage, constants[STEP], constants[SEMI_IMPLICIT] != 0.0, tableau, qdd, memory[3:], q, v)
    return OK


@entry_kernel
def step_on_pinocchio(
    i: int, at: int, stage: int, law: int,
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    constants: Array, joints: Array, path: Array, tableau: Array, memory: Array, rows: Array,
) -> int:  # fmt: skip
    """Do one stage of one step on what `pinocchio.crba` and `pinocchio.nonLinearEffects` left in their data.

    See `step`, and `closedloop.tip.tip_kinematics` for the parameters that only this function has.
    """
    n, m = memory.shape[1], 1
    at_jacobian, _, at_small, _ = memory_layout(n, m, tableau.shape[1])
    J, point = memory[at_jacobian : at_jacobian + 3], memory[at_small:].reshape(-1)
    r, drift = point[0:3], point[3:6]
    tip_kinematics(
        joint_jacobian, rotation, origin, velocity, acceleration,
        constants[OFFSET:GRAVITY], constants[GRAVITY:STEP], joints[2], J, r, drift,
    )  # fmt: skip
    return step(i, at, stage, law, H, C, J, r, drift, constants, joints, path, tableau, memory, rows)
