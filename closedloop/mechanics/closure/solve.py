"""Eq. 24, the one linear solve of a step, acceleration and contact force together; and how well a solution meets it.

    [ H   Aᵀ ] [ q̈ ]   [ Q − C ]
    [ A   0  ] [ −f ] = [  b_s  ]        A = nᵀJᵣ for the plane, m >= 1 rows in general

`solve_closure` is that line in numpy and LAPACK, for reading, for users and for tests. Inside a step the same
equation is solved by Cholesky of H and the Schur complement A H⁻¹Aᵀ (`closedloop.mechanics.closure.contact_force`),
which is faster, detects a singular pose, and separates the stabiliser's share of f. Tests compare the two.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array, IntArray
from closedloop.base.errors import ScenarioError
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import every, select

# What a joint moves while those before it give way, as a share of what it moves alone: below this it is the rounding of
# M, of which a sum over thirty joints leaves 1e-14, and the accelerations have no digit.
ROUNDING = 1e-13


@kernel_inlined
def motion_residual(H: Array, torque: Array, C: Array, qdd: Array, tip: Any, ends: IntArray) -> float:
    """Return the relative residual of the equation of motion: it shows that no force but Q, C and F acts on the arm.

    It is the largest |left − right| over the largest sum of the magnitudes of the terms.

    `H` (n, n): mass matrix; the upper triangle is read.
    `torque`, `C`, (n,) arrays: N m (N).
    `qdd` (n,): acceleration, rad/s² (m/s²).
    `tip`: a (3, n), S (3, 3), `drift_c`, b, a and F (3,), as `factorise`, `free_acceleration` and `pressed_force` left
        them.
    `ends` (n,): where the blocks of H end, see `closedloop.mechanics.robot.tree.group_ends`.
    """
    A, F, n = tip.A, tip.F, torque.shape[0]
    worst, scale, first = 0.0, 0.0, 0
    for i in range(n):
        if i == ends[first]:
            first = i
        r = C[i] - torque[i]
        s = abs(torque[i]) + abs(C[i])
        for j in range(first, ends[i]):
            h = H[i, j] if i <= j else H[j, i]
            r += h * qdd[j]
            s += abs(h * qdd[j])
        for k in range(3):
            r -= A[k, i] * F[k]
            s += abs(A[k, i] * F[k])
        worst = max(worst, abs(r))
        scale = max(scale, s)
    residual: float = worst / select(scale > 0.0, scale, 1.0)
    return residual


@kernel_inlined
def closure_residual(qdd: Array, tip: Any, rows: tuple[int, int]) -> float:
    """Return the same of the closure rows `rows`[0] .. `rows`[1] − 1: the tip's acceleration is that of the closure, b.

    The magnitudes include the free acceleration `a` and S F, which cancel: an arm at rest in contact has q̈ = 0, and
    rounding is relative to the two terms. So 1e-16 is the limit of the arithmetic.
    """
    A, S, drift_c, b, a, F = tip.A, tip.S, tip.drift_c, tip.b, tip.a, tip.F
    worst, scale, n = 0.0, 0.0, qdd.shape[0]
    for k in range(rows[0], rows[1]):
        r = drift_c[k] - b[k]
        s = abs(drift_c[k]) + abs(b[k]) + abs(a[k])
        for j in range(n):
            r += A[k, j] * qdd[j]
            s += abs(A[k, j] * qdd[j])
        for i in range(3):
            s += abs(S[k, i] * F[i])
        worst = max(worst, abs(r))
        scale = max(scale, s)
    residual: float = worst / select(scale > 0.0, scale, 1.0)
    return residual


# A H⁻¹Aᵀ is the tip's mobility along the normal, 1/kg: acceleration per newton. Below this share of its mobility
# in all directions together (the trace of Jᵣ H⁻¹Jᵣᵀ) the pose counts as singular. The share falls with the square
# of the Jacobian's angle to the singular pose: at 1e-12 that angle is 1e-6 rad, f is ill-determined to about six of
# its sixteen digits, and a force of 10 N along the normal takes a million times the joint acceleration. The same holds
# where no joint's lever arm along the normal is above 1e-6 of the arm's reach (its square above this share of reach²).
SINGULAR_MOBILITY = 1e-12

OK, SINGULAR, NOT_POSITIVE_DEFINITE, DIVERGED, PAINLEVE, CHATTER, LAW_FAILED = range(7)
NO_NORMAL, PUSHED, RUBS, CROWDED, LOOPS_OPEN = range(7, 12)


def bordered_matrix(H: ArrayLike, A: ArrayLike) -> Array:
    """Return the (n + m, n + m) matrix of Eq. 24 from H (n, n) and A (n,) or (m, n)."""
    H_, A_ = np.asarray(H, dtype=np.float64), np.atleast_2d(np.asarray(A, dtype=np.float64))
    m = A_.shape[0]
    return np.block([[H_, A_.T], [A_, np.zeros((m, m))]])


def solve_closure(H: ArrayLike, rhs: ArrayLike, A: ArrayLike, b: ArrayLike) -> tuple[Array, Array | float]:
    """Solve Eq. 24 for the joint acceleration and the contact force.

    Parameters
    ----------
    H : (n, n) array
        Mass matrix, kg m² (kg for prismatic joints), symmetric positive definite.
    rhs : (n,) array
        Q − C, N m.
    A : (n,) or (m, n) array
        Closure rows; nᵀJᵣ for the plane.
    b : float or (m,) array
        b_s of Eq. 23, m/s².

    Returns
    -------
    qdd : (n,) array
        Joint acceleration q̈, rad/s².
    f : float or (m,) array
        Contact force, N, positive along +n on the robot; a float when A is (n,).

    Raises
    ------
    ScenarioError
        If they are no arrays of numbers, the shapes do not fit, or an entry is not finite.
    numpy.linalg.LinAlgError
        If the pose is singular: the matrix has no inverse.
    """
    try:
        matrix, tau, rows, accelerations = (np.asarray(x, dtype=np.float64) for x in (H, rhs, A, b))
    except (TypeError, ValueError):
        raise ScenarioError("Eq. 24: H, Q - C, A and b must be arrays of numbers") from None
    rows, accelerations = np.atleast_2d(rows), np.atleast_1d(accelerations)
    n, m = tau.size, rows.shape[0]
    if matrix.shape != (n, n) or tau.shape != (n,) or rows.shape != (m, n) or accelerations.shape != (m,):
        raise ScenarioError(
            f"Eq. 24 needs H (n, n), Q - C (n,), A (m, n), b (m,); got {np.shape(H)}, {tau.shape}, "
            f"{np.shape(A)}, {np.shape(b)}"
        )
    matrix = bordered_matrix(H, rows)
    right = np.concatenate([tau, accelerations])
    if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(right))):
        raise ScenarioError("Eq. 24: H, Q - C, A and b must be finite")
    solution = np.linalg.solve(matrix, right)
    force = -solution[n:]
    return solution[:n], float(force[0]) if np.ndim(A) == 1 else force


# The next four do their work for one block of a block-diagonal matrix, rows `first` .. `end` − 1; see
# `closedloop.mechanics.robot.tree.group_ends`.
@kernel_inlined
def cholesky(M: Array, L: Array, first: int, end: int) -> bool:
    """Write the lower triangle L of M = L Lᵀ, reading M's upper triangle; False if M is singular to rounding, or worse.

    The diagonal of L holds the reciprocals 1/Lᵢᵢ: everything that follows divides by them.
    """
    for j in range(first, end):
        s = M[j, j]
        for k in range(first, j):
            s -= L[j, k] * L[j, k]
        if not every(s > ROUNDING * M[j, j]):
            return False
        L[j, j] = 1.0 / math.sqrt(s)
        odd = j + 1 + (end - j - 1) % 2
        for i in range(j + 1, odd):
            s = M[j, i]
            for k in range(first, j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s * L[j, j]
        for i in range(odd, end, 2):  # two rows at once: of thirty joints in three quarters of the time
            s, t = M[j, i], M[j, i + 1]
            for k in range(first, j):
                s -= L[i, k] * L[j, k]
                t -= L[i + 1, k] * L[j, k]
            L[i, j], L[i + 1, j] = s * L[j, j], t * L[j, j]
    return True


@kernel_inlined
def forward_substitute(L: Array, x: Array, first: int, end: int) -> None:
    """Overwrite x (n,) with L⁻¹x."""
    for i in range(first, end):
        s = x[i]
        for k in range(first, i):
            s -= L[i, k] * x[k]
        x[i] = s * L[i, i]


@kernel_inlined
def forward_substitute_three(L: Array, X: Array, at: int, first: int, end: int) -> None:
    """Overwrite the rows at, at + 1 and at + 2 of X (m, n) with L⁻¹ of them."""
    for i in range(first, end):
        s0, s1, s2 = X[at, i], X[at + 1, i], X[at + 2, i]
        for k in range(first, i):
            s0 -= L[i, k] * X[at, k]
            s1 -= L[i, k] * X[at + 1, k]
            s2 -= L[i, k] * X[at + 2, k]
        X[at, i], X[at + 1, i], X[at + 2, i] = s0 * L[i, i], s1 * L[i, i], s2 * L[i, i]


@kernel_inlined
def back_substitute(L: Array, x: Array, first: int, end: int) -> None:
    """Overwrite x (n,) with L⁻ᵀx."""
    for i in range(end - 1, first - 1, -1):
        s = x[i]
        for k in range(i + 1, end):
            s -= L[k, i] * x[k]
        x[i] = s * L[i, i]
