"""Contact of the tip with the surface: its frame, its modes, and the contact force of Eq. 24 in each mode.

Everything is written in the contact frame, whose axes are the normal n and two tangents t1, t2 of the surface. With
A = [nᵀ; t1ᵀ; t2ᵀ] Jᵣ the tip's velocity is u = A q̇ and its acceleration

    u̇ = A H⁻¹(Q − C) + Ȧq̇ + S F,      S = A H⁻¹Aᵀ

where F = (f, F_t) is the force of the surface on the tip. Eq. 24 is the first of these three lines solved for f; a tip
that sticks needs all three; a tip that slides has F_t = −c f − w, with c and w from the law of friction, so that the
first line reads (S_nn − S_nt c) f = b_s − a_n + S_nt w and is solved at once, without iteration or delay.
"""

from typing import Any

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import every, select
from closedloop.mechanics.closure.solve import (
    NOT_POSITIVE_DEFINITE,
    OK,
    PAINLEVE,
    SINGULAR,
    SINGULAR_MOBILITY,
    back_substitute,
    cholesky,
    forward_substitute,
    forward_substitute_three,
)

# Contact modes: values of the run's column `mode`.
FREE, PRESSED, STUCK = 0, 1, 2

# Q and C are sums of dozens of products: relative rounding error of a force computed from their difference.
LOAD_ROUNDING = 2e-14

# Below this share of the trace of S the tip cannot move along a tangent (a planar arm, sideways): the force there is
# zero.
IMMOBILE = 1e-10


@kernel_inlined
def into_contact_frame(arm: Any, tip: Any) -> None:
    """Write A = N Jᵣ, p = N r, u = A q̇ and N J̇ᵣq̇ for the contact frame N (rows n, t1, t2).

    `arm`: `J` (3, n), `r` (3,), m, and `drift` (3,), J̇ᵣq̇, m/s², in base axes; `v` (n,), q̇.
    `tip`: in: `frame`, N (3, 3). Written: `A` (3, n), `p`, `u` and `drift_c` (3,).
    """
    frame, J, r, drift, v = tip.frame, arm.J, arm.r, arm.drift, arm.v
    A, p, u, drift_c = tip.A, tip.p, tip.u, tip.drift_c
    for k in range(3):
        n0, n1, n2 = frame[k, 0], frame[k, 1], frame[k, 2]
        speed = 0.0
        for j in range(v.shape[0]):
            a = n0 * J[0, j] + n1 * J[1, j] + n2 * J[2, j]
            A[k, j] = a
            speed += a * v[j]
        u[k] = speed
        p[k] = n0 * r[0] + n1 * r[1] + n2 * r[2]
        drift_c[k] = n0 * drift[0] + n1 * drift[1] + n2 * drift[2]


@kernel_inlined
def factorise(H: Array, A: Array, L: Array, X: Array, S: Array, reach: float, ends: IntArray) -> int:
    """Write the Cholesky factor L of H, the rows X = L⁻¹Aᵀ and the tip's mobility S = A H⁻¹Aᵀ = X Xᵀ, 1/kg.

    Returns OK or NOT_POSITIVE_DEFINITE.

    `H` (n, n): mass matrix; the upper triangle is read.
    `A` (3, n): rows n, t1, t2.
    `L`, `X`, `S`, (n, n), (3, n), (3, 3) arrays: written; L's diagonal holds reciprocals, see
        `closedloop.mechanics.closure.solve.cholesky`. S_nn is zero where no joint has a lever along n: |A_n|² is no
        more than SINGULAR_MOBILITY of the arm's reach squared. (A share of the tip's own mobility would fail where the
        whole of Jᵣ is rounding, as of a tip on the only axis.)
    `reach`: of the arm, squared, m², see `Robot.reach`.
    `ends` (n,): where the blocks of H end, see `closedloop.mechanics.robot.tree.group_ends`.
    """
    n, first = H.shape[0], 0
    while first < n:
        end = ends[first]
        if not cholesky(H, L, first, end):
            return NOT_POSITIVE_DEFINITE
        for i in range(first, end):
            X[0, i], X[1, i], X[2, i] = A[0, i], A[1, i], A[2, i]
        forward_substitute_three(L, X, 0, first, end)
        first = end
    s00 = s01 = s02 = s11 = s12 = s22 = lever = 0.0
    for j in range(n):
        x0, x1, x2 = X[0, j], X[1, j], X[2, j]
        s00, s01, s02 = s00 + x0 * x0, s01 + x1 * x0, s02 + x2 * x0
        s11, s12, s22 = s11 + x1 * x1, s12 + x2 * x1, s22 + x2 * x2
        lever += A[0, j] * A[0, j]
    S[0, 0], S[0, 1], S[0, 2] = s00, s01, s02
    S[1, 0], S[1, 1], S[1, 2] = s01, s11, s12
    S[2, 0], S[2, 1], S[2, 2] = s02, s12, s22
    S[0, 0] = select(lever > SINGULAR_MOBILITY * reach, S[0, 0], 0.0)
    return OK


@kernel_inlined
def free_acceleration(
    L: Array, X: Array, drift_c: Array, torque: Array, C: Array, y: Array, a: Array, ends: IntArray
) -> None:
    """Write y = L⁻¹(Q − C) and the tip's acceleration without contact, a = X y + Ȧq̇ (3,), m/s²."""
    n = torque.shape[0]
    for j in range(n):
        y[j] = torque[j] - C[j]
    first = 0
    while first < n:
        end = ends[first]
        forward_substitute(L, y, first, end)
        first = end
    a0, a1, a2 = drift_c[0], drift_c[1], drift_c[2]
    for j in range(n):
        a0, a1, a2 = a0 + X[0, j] * y[j], a1 + X[1, j] * y[j], a2 + X[2, j] * y[j]
    a[0], a[1], a[2] = a0, a1, a2


@kernel
def normal_rounding(C: Array, w: Any) -> float:
    """Return a bound of the rounding error in the tip's free acceleration along n, m/s².

    Q and C are each known to rounding, and a_n = gᵀ(Q − C) + ... with g = H⁻¹Aᵀn = L⁻ᵀX_n, which is written to the
    scratch of the `Work`.
    """
    n, g = C.shape[0], w.scratch.column
    for j in range(n):
        g[j] = w.tip.X[0, j]
    back_substitute(w.L, g, 0, n)
    total: float = abs(w.tip.drift_c[0])
    for j in range(n):
        total += abs(g[j]) * (abs(w.torque[j]) + abs(w.joint_friction.torque[j]) + abs(w.external[j]) + abs(C[j]))
    return LOAD_ROUNDING * total


@kernel
def baumgarte_acceleration(s_v: float, s_p: float, rate: float, error: float) -> float:
    """Return −s_v ė − s_p e, what the stabiliser adds to b_s (Eq. 23), m/s²."""
    return -s_v * rate - s_p * error


@kernel_inlined
def pressed_force(S: Array, a: Array, b_stabiliser: float, c: Array, w: Array, F: Array) -> tuple[int, float]:
    """Write the force on a tip that is held on the surface and slides: F_t = −c f − w.

    Parameters
    ----------
    S, a : (3, 3), (3,) arrays
        Mobility, 1/kg, and free acceleration, m/s².
    b_stabiliser : float
        −s_v ė − s_p e, m/s².
    c, w : (2,) arrays
        Friction: c without unit, w in N.
    F : (3,) array
        Written, N.

    Returns
    -------
    status : int
        OK, SINGULAR (the tip cannot move along the normal) or PAINLEVE (with friction a larger f accelerates the tip
        into the surface: no force, or more than one, solves Eq. 24).
    stabiliser_force : float
        The part of f due to the stabiliser, N.
    """
    if not every(S[0, 0] > SINGULAR_MOBILITY * (S[0, 0] + S[1, 1] + S[2, 2])):
        return SINGULAR, 0.0
    mobility = S[0, 0] - S[0, 1] * c[0] - S[0, 2] * c[1]
    if not every(mobility > SINGULAR_MOBILITY * (S[0, 0] + S[1, 1] + S[2, 2])):
        return PAINLEVE, 0.0
    rigid = (-a[0] + S[0, 1] * w[0] + S[0, 2] * w[1]) / mobility
    stabiliser_force = b_stabiliser / mobility
    F[0] = rigid + stabiliser_force
    F[1] = -c[0] * F[0] - w[0]
    F[2] = -c[1] * F[0] - w[1]
    return OK, stabiliser_force


@kernel
def stuck_force(S: Array, a: Array, b_stabiliser: Array, F: Array, stabiliser_force: Array) -> int:
    """Write the force that holds the tip where it is, S F = −a + b, and the stabiliser's share of it.

    Returns OK or SINGULAR.

    `S`, `a`, `b_stabiliser`, (3, 3), (3,), (3,) arrays: mobility, 1/kg; free acceleration and the stabiliser's, m/s².
    `F`, `stabiliser_force`, (3,) arrays: written, N; zero along tangents in which the tip cannot move.
    """
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    if not every(S[0, 0] > SINGULAR_MOBILITY * trace):
        return SINGULAR
    # Eliminate the normal, then the more mobile tangent, then the other; what cannot move carries no force.
    inverse = 1.0 / S[0, 0]
    s11 = S[1, 1] - S[0, 1] * S[0, 1] * inverse
    s12 = S[1, 2] - S[0, 1] * S[0, 2] * inverse
    s22 = S[2, 2] - S[0, 2] * S[0, 2] * inverse
    first = s11 >= s22
    most, least = select(first, s11, s22), select(first, s22, s11)
    moves = most > IMMOBILE * trace
    most = select(moves, most, 1.0)
    rest = least - s12 * s12 / most
    both_move = moves & (rest > IMMOBILE * trace)
    rest = select(both_move, rest, 1.0)
    for side in range(2):
        b0 = (-a[0] if side == 0 else 0.0) + b_stabiliser[0]
        b1 = (-a[1] if side == 0 else 0.0) + b_stabiliser[1] - S[0, 1] * inverse * b0
        b2 = (-a[2] if side == 0 else 0.0) + b_stabiliser[2] - S[0, 2] * inverse * b0
        b_most, b_least = select(first, b1, b2), select(first, b2, b1)
        f_least = select(both_move, (b_least - s12 / most * b_most) / rest, 0.0)
        f_most = select(moves, (b_most - s12 * f_least) / most, 0.0)
        f1, f2 = select(first, f_most, f_least), select(first, f_least, f_most)
        f0 = (b0 - S[0, 1] * f1 - S[0, 2] * f2) * inverse
        if side == 0:
            F[0], F[1], F[2] = f0, f1, f2
        else:
            stabiliser_force[0], stabiliser_force[1], stabiliser_force[2] = f0, f1, f2
    return OK


@kernel
def stuck_tangentially(S: Array, a: Array, b: Array, F: Array) -> None:
    """Write the tangential force F_t that holds the tip along the surface under a given normal force F_n.

    `S`, `a`, `b`, (3, 3), (3,), (3,) arrays: mobility, 1/kg; free acceleration and that of the tip, m/s², of which the
        tangential parts count.
    `F` (3,): N; F_n read, F_t written: zero along tangents in which the tip cannot move.
    """
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    b1, b2 = b[1] - a[1] - S[1, 0] * F[0], b[2] - a[2] - S[2, 0] * F[0]
    i, j = (1, 2) if S[1, 1] >= S[2, 2] else (2, 1)  # the more mobile tangent first
    first, second = (b1, b2) if i == 1 else (b2, b1)
    F[1], F[2] = 0.0, 0.0
    if not S[i, i] > IMMOBILE * trace:
        return
    rest = S[j, j] - S[1, 2] * S[1, 2] / S[i, i]
    if rest > IMMOBILE * trace:
        F[j] = (second - S[1, 2] / S[i, i] * first) / rest
    F[i] = (first - S[1, 2] * F[j]) / S[i, i]


@kernel_inlined
def accelerate(L: Array, X: Array, y: Array, F: Array, qdd: Array, ends: IntArray) -> None:
    """Write q̈ = L⁻ᵀ(y + Xᵀ F): the acceleration due to Q − C and the contact force."""
    for j in range(y.shape[0]):
        qdd[j] = y[j] + X[0, j] * F[0] + X[1, j] * F[1] + X[2, j] * F[2]
    first = 0
    while first < y.shape[0]:
        end = ends[first]
        back_substitute(L, qdd, first, end)
        first = end


@kernel
def answer_impulse(L: Array, X: Array, impulse: Array, column: Array) -> None:
    """Write H⁻¹Aᵀ P, the effect of an impulse P (3,), N s, on q̇, to `column` (n,)."""
    for j in range(column.shape[0]):
        column[j] = X[0, j] * impulse[0] + X[1, j] * impulse[1] + X[2, j] * impulse[2]
    back_substitute(L, column, 0, column.shape[0])


@kernel
def apply_impulse(L: Array, X: Array, impulse: Array, column: Array, v: Array) -> None:
    """Add H⁻¹Aᵀ P to q̇, the effect of an impulse P (3,), N s, on the tip; `column` (n,) is scratch."""
    answer_impulse(L, X, impulse, column)
    for j in range(v.shape[0]):
        v[j] += column[j]
