"""How well a solution of Eq. 24 meets it."""

from __future__ import annotations

from typing import Any

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import select


@kernel_inlined
def residuals(
    H: Array, torque: Array, C: Array, qdd: Array, tip: Any, rows: tuple[int, int], ends: IntArray
) -> tuple[float, float]:
    """Return the relative residuals of the equation of motion, and of the closure rows `rows`[0] .. `rows`[1] − 1.

    Each is the largest |left − right| over the largest sum of the magnitudes of the terms. In a closure row these
    include the free acceleration `a` and S F, which cancel: an arm at rest in contact has q̈ = 0, and rounding is
    relative to the two terms. So 1e-16 is the limit of the arithmetic. The first residual shows that no force but Q, C
    and F acts on the arm; the second that the tip's acceleration is that of the closure, b (3,), m/s².

    Parameters
    ----------
    H : (n, n) array
        Mass matrix; the upper triangle is read.
    torque, C : (n,) arrays
        N m (N).
    qdd : (n,) array
        Acceleration, rad/s² (m/s²).
    tip : closedloop.loop.step.records.TipContact or the like
        A (3, n), S (3, 3), `drift_c`, b, a and F (3,), as `factorise`, `free_acceleration` and `pressed_force` left
        them.
    rows : (int, int)
        See above.
    ends : (n,) array
        Where the blocks of H end, see `closedloop.mechanics.robot.tree.group_ends`.
    """
    A, S, drift_c, b, a, F = tip.A, tip.S, tip.drift_c, tip.b, tip.a, tip.F
    n = torque.shape[0]
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
    motion = worst / select(scale > 0.0, scale, 1.0)
    worst, scale = 0.0, 0.0
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
    return motion, worst / select(scale > 0.0, scale, 1.0)
