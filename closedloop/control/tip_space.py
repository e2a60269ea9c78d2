"""Control in operational space: pseudo-inverses, motion errors, and the joint torque of a tip motion and force."""

import math
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.sections import (
    ACCELERATION_GAIN,
    RATE,
    SPEED,
    Gain,
    NotNegative,
    Positive,
    Section,
    gains_not_negative,
)
from closedloop.control.law import ControlLaw, LawInput
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import matrix_of
from closedloop.jit.dual8 import has_derivatives, settled, sought
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import IMMOBILE

# Jacobi's sweeps converge quadratically: a 3 x 3 matrix is diagonal to rounding after four or five.
MOST_SWEEPS = 10
DIAGONAL = 1e-36  # of the squared trace


GainNotNegative = Annotated[Gain, AfterValidator(gains_not_negative)]


class Approach(ControlLaw):
    """Parameters of a law that approaches the surface at a given speed."""

    approach_speed: Annotated[Positive, SPEED] = Field(
        0.05,
        description="largest speed along the normal off the surface, m/s: at it a tip comes down to press (force > 0); "
        "with force = 0 it follows the path, with force < 0 it leaves and stays away",
    )


class Posture(Section):
    """Parameters of the null-space motion of a redundant arm."""

    posture_stiffness: Annotated[GainNotNegative, ACCELERATION_GAIN] = Field(
        25.0, description="pull of free joint motion to the reference's, 1/s², one per joint or one for all"
    )
    posture_damping: Annotated[GainNotNegative, RATE] = Field(
        10.0, description="damping of free joint motion, 1/s, one per joint or one for all"
    )


class TipMotion(Posture):
    """Parameters of a law that linearises the tip's motion: ë + K_v ė + K_p e = 0.

    Gains of the tip's motion are accelerations per error, 1/s² and 1/s, so the same values serve any arm: K_p = ω², K_v
    = 2 ζ ω gives the tip the natural frequency ω and the damping ratio ζ.
    """

    motion_stiffness: Annotated[NotNegative, ACCELERATION_GAIN] = Field(
        400.0, description="K_p of the tip's motion along the surface, 1/s²"
    )
    motion_damping: Annotated[Positive, RATE] = Field(
        40.0, description="K_v of the tip's motion along the surface, 1/s"
    )


class TipScratch(Block, sizes=("n",)):
    """Intermediate results of a law in operational space, in `LawInput.scratch`."""

    inverse: Annotated[Array, 3, 3]
    eigen: Annotated[Array, 36]
    wanted: Annotated[Array, 3]  # acceleration of the tip, m/s²
    force: Annotated[Array, 3]
    rest: Annotated[Array, 3]
    joints: Annotated[Array, Count.of("n")]


@kernel
def pseudo_inverse(M: Array, scratch: Array, P: Array) -> int:
    """Write the pseudo-inverse of a symmetric positive semi-definite matrix, by Jacobi's rotations.

    Returns how many eigenvalues counted: the rank.

    `M` (3, 3): symmetric.
    `scratch` (36,).
    `P` (3, 3): written (it may be M itself): the sum of x xᵀ/λ over the eigenvectors x whose eigenvalue λ is above
        `IMMOBILE` of the trace. Along the others (a planar arm, sideways) the arm cannot move the tip.
    """
    W, V, given = matrix_of(scratch, 3, 3), matrix_of(scratch[9:18], 3, 3), matrix_of(scratch[18:27], 3, 3)
    trace = M[0, 0] + M[1, 1] + M[2, 2]
    for i in range(3):
        for j in range(3):
            W[i, j] = M[i, j]
            V[i, j] = 1.0 if i == j else 0.0
            if has_derivatives(trace):
                given[i, j] = M[i, j]
            P[i, j] = 0.0
    for _ in range(MOST_SWEEPS):
        if W[0, 1] * W[0, 1] + W[0, 2] * W[0, 2] + W[1, 2] * W[1, 2] <= DIAGONAL * trace * trace:
            break
        for pair in range(3):
            i, j = (0, 1) if pair == 0 else ((0, 2) if pair == 1 else (1, 2))
            if W[i, j] == 0.0:
                continue
            # tan of the angle that makes W[i, j] vanish, the smaller root
            half = (W[j, j] - W[i, i]) / (2.0 * W[i, j])
            tan = math.copysign(1.0, half) / (abs(half) + math.hypot(half, 1.0))
            c = 1.0 / math.sqrt(1.0 + tan * tan)
            s = tan * c
            for k in range(3):
                a, b = W[k, i], W[k, j]
                W[k, i], W[k, j] = c * a - s * b, s * a + c * b
            for k in range(3):
                a, b = W[i, k], W[j, k]
                W[i, k], W[j, k] = c * a - s * b, s * a + c * b
                a, b = V[k, i], V[k, j]
                V[k, i], V[k, j] = c * a - s * b, s * a + c * b
    rank = 0
    for k in range(3):
        if W[k, k] > IMMOBILE * trace:
            rank += 1
            for i in range(3):
                for j in range(3):
                    P[i, j] += V[i, k] * V[j, k] / W[k, k]
    if has_derivatives(trace):  # a matrix that is diagonal is not rotated, and its derivatives are not diagonal
        differentiate(given, P, W, V, matrix_of(scratch[27:36], 3, 3))
    return rank


@kernel
def differentiate(M: Array, P: Array, X: Array, Y: Array, N: Array) -> None:
    """Write the derivatives of P (3, 3), the pseudo-inverse of a symmetric M (3, 3); X, Y and N are scratch.

    dP = −P dM P + P² dM N + N dM P², N = I − M P (G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10, 1973)
    """
    for i in range(3):
        for j in range(3):
            P[i, j] = sought(P[i, j])
    multiply(M, P, X)
    for i in range(3):
        for j in range(3):
            N[i, j] = (1.0 if i == j else 0.0) - sought(X[i, j])
    multiply(M, N, Y)
    multiply(P, Y, N)
    multiply(P, N, Y)  # P² M N
    multiply(P, X, N)  # P M P
    for i in range(3):
        for j in range(3):
            P[i, j] = settled(P[i, j], N[i, j] - Y[i, j] - Y[j, i], 1.0)


@kernel
def multiply(A: Array, B: Array, C: Array) -> None:
    """Write C = A B, all (3, 3)."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@kernel
def invert_gram(A: Array, first: int, scratch: Array, P: Array) -> None:
    """Write P (3, 3) = (A Aᵀ)⁺ of the rows from `first` on, zero elsewhere; of the scratch see `pseudo_inverse`."""
    for i in range(3):
        for k in range(3):
            s = 0.0
            if i >= first and k >= first:
                for j in range(A.shape[1]):
                    s += A[i, j] * A[k, j]
            P[i, k] = s
    pseudo_inverse(P, scratch, P)


@kernel
def surface_mobility(S: Array, pressed: float, i: int, k: int) -> float:
    """Return entry (i, k), tangents counted 1 and 2, of the tip's mobility along the surface, 1/kg.

    S_tt − S_tn S_nt/S_nn in contact, where a force along the surface causes a reaction along n; S_tt in free motion.
    """
    if pressed == 0.0:
        return float(S[i, k])
    return float(S[i, k] - S[i, 0] * S[0, k] / S[0, 0])


@kernel
def motion_along_surface(x: LawInput, par: Any, wanted: Array) -> None:
    """Write ü_des + K_v (u_des − u) + K_p (p_des − p) along t1 and t2 into `wanted` (3,), m/s²."""
    for i in range(1, 3):
        wanted[i] = (
            x.a_des[i] + par.motion_damping * (x.u_des[i] - x.u[i]) + par.motion_stiffness * (x.p_des[i] - x.p[i])
        )


@kernel
def motion_along_normal(x: LawInput, f: float, stiffness: float, damping: float, speed: float) -> float:
    """Return the commanded acceleration along n, m/s²: zero in contact, where the force is controlled instead.

    In free motion it depends on the sign of f_des. f_des > 0: the tip approaches the surface at `speed`, from any
    height. f_des = 0: it follows p_des. f_des < 0: it retreats with −S_nn f over `damping`, follows p_des upwards too,
    and never approaches. The speed is limited to `speed`.

    The acceleration towards the surface is at most that due to f, the f_c of free motion in N. So no law lifts off in
    contact and presses in free motion at one and the same state, which would chatter.
    """
    if x.pressed != 0.0:
        return 0.0
    push = x.S[0, 0] * f
    if x.f_des > 0.0:
        return float(max(damping * (-speed - x.u[0]), -push - damping * max(x.u[0], 0.0)))
    towards = x.u_des[0] + stiffness / damping * (x.p_des[0] - x.p[0])
    if x.f_des < 0.0:
        towards = max(towards, 0.0) - push / damping
    return float(damping * (min(max(towards, -speed), speed) - x.u[0]))


@kernel
def wanted_acceleration(x: LawInput, par: Any, f: float, wanted: Array) -> None:
    """Write the tip acceleration (3,), m/s², commanded by the motion law in all three directions."""
    wanted[0] = motion_along_normal(x, f, par.motion_stiffness, par.motion_damping, par.approach_speed)
    motion_along_surface(x, par, wanted)


@kernel
def posture(x: LawInput, par: Any, a: Array) -> None:
    """Write q̈_des + K_d (q̇_des − q̇) + K_p (q_des − q), rad/s², into `a` (n,): the null-space motion."""
    for j in range(x.q.shape[0]):
        a[j] = par.posture_stiffness[j] * (x.q_des[j] - x.q[j]) + par.posture_damping[j] * (x.v_des[j] - x.v[j])
        a[j] += x.qdd_des[j]


@kernel
def rest_of(x: LawInput, wanted: Array, a: Array, rest: Array) -> None:
    """Write wanted − Ȧq̇ − A a (3,), m/s²: the remaining tip acceleration if the joints accelerate with `a` (n,)."""
    for i in range(3):
        s = wanted[i] - x.drift[i]
        for j in range(a.shape[0]):
            s -= x.A[i, j] * a[j]
        rest[i] = s


@kernel
def add_mass_times(H: Array, a: Array, sign: float, torque: Array) -> None:
    """Add ±H a to the torque, reading H's upper triangle."""
    n = a.shape[0]
    for i in range(n):
        s = H[i, i] * a[i]
        for j in range(i):
            s += H[j, i] * a[j]
        for j in range(i + 1, n):
            s += H[i, j] * a[j]
        torque[i] += sign * s


@kernel
def add_transposed(A: Array, inverse: Array, e: Array, y: Array, joints: Array) -> None:
    """Add Aᵀ(A Aᵀ)⁺e to `joints`; `y` (3,) is scratch."""
    for i in range(3):
        y[i] = inverse[i, 0] * e[0] + inverse[i, 1] * e[1] + inverse[i, 2] * e[2]
    add_tip_force(A, y, joints)


@kernel
def add_tip_force(A: Array, F: Array, torque: Array) -> None:
    """Add AᵀF, the torque that makes the tip push with F (3,), N."""
    for j in range(torque.shape[0]):
        torque[j] += A[0, j] * F[0] + A[1, j] * F[1] + A[2, j] * F[2]


@kernel
def move_tip(x: LawInput, par: Any, f: float, torque: Array) -> None:
    """Write the torque that gives the tip the acceleration `TipScratch.wanted` and, in contact, presses with f, N.

    Q = C + H q̈₀ + Aᵀ [ Λ (a − Ȧq̇ − A q̈₀) − n f ]        Λ = (A H⁻¹Aᵀ)⁺, q̈₀ from `posture`
    """
    n = x.q.shape[0]
    s = TipScratch(x.scratch, n)
    F, a = s.force, s.joints
    pseudo_inverse(x.S, s.eigen, s.inverse)
    posture(x, par, a)
    rest_of(x, s.wanted, a, s.rest)
    for i in range(3):
        F[i] = s.inverse[i, 0] * s.rest[0] + s.inverse[i, 1] * s.rest[1] + s.inverse[i, 2] * s.rest[2]
    if x.pressed != 0.0:
        F[0] -= f
    for j in range(n):
        torque[j] = x.C[j]
    add_mass_times(x.H, a, 1.0, torque)
    add_tip_force(x.A, F, torque)
