"""Closing the loop: Eqs. 1–3, 6–7, 9–11 and 19–24 of the paper, for any loop joint and for the plane.

A loop joint lets the tip move freely in some directions and forbids others. The columns of R (6, m) are unit
force vectors along the forbidden ones, the contact force space: the motion obeys Rᵀ (vₙ − v₀) = 0 (Eq. 2), and
the closure force is R f. The plane is the smallest case: one column, the force along n through the tip. Sign of f,
everywhere: positive is the force of the surface *on the robot* along +n [N].

Eqs. 1–10 are the general loop joint, Eqs. 11–12 put the plane in its place, Eqs. 19–24 differentiate its error,
stabilise it and solve. Two misprints of the paper are put right here: Eq. 12 has Jᵣ for Jᵣᵀ, and Eq. 23 counts
nᵀ[ṙ×ᵀ 0] J q̇ beside nᵀJ̇ᵣq̇, which contains it by Eq. 18 (and names the tip k there).
"""

from dataclasses import dataclass, field

import numpy as np

from validation.oracle import kinematics
from validation.oracle.kinematics import Pose
from validation.oracle.spatial import Array, skew
from validation.oracle.tree import GROUND, Tree


@dataclass(frozen=True)
class LoopJoint:
    """What ties a tip to the ground, or to another link of the same robot.

    tip : link whose origin is the tip
    normals : (k, 3) unit directions in which the tip cannot move, in the frame of `base`
    offsets : (k,) d of each closure n·r = d, with r taken in the frame of `base` [m]
    base : link on the other side; None is the ground
    rotation : (3, 3) orientation in which the tip is held in the frame of `base`; None leaves it free to turn
    """

    tip: str
    normals: Array
    offsets: Array
    base: str | None = None
    rotation: Array | None = field(default=None)

    @property
    def size(self) -> int:
        """Number of closure forces, m."""
        return len(self.normals) + (0 if self.rotation is None else 3)


@dataclass(frozen=True)
class Rows:
    """A loop joint at one state: A q̈ + drift is the second rate of the error e.

    A (m, n); drift Ȧq̇ (m,); error e (m,) [m] or [rad]; rate ė (m,)
    """

    A: Array
    drift: Array
    error: Array
    rate: Array


def point_on_plane(tip: str, normal: Array, offset: float, base: str | None = None) -> LoopJoint:
    """Return the tip held on the plane n·r = d (Eq. 11); m = 1."""
    return LoopJoint(tip, _unit(normal)[None, :], np.array([offset]), base)


def point_on_line(tip: str, point: Array, direction: Array, base: str | None = None) -> LoopJoint:
    """Return the tip held on a line through `point` (3,) along `direction` (3,); m = 2."""
    along = _unit(direction)
    first = _unit(np.cross(along, np.eye(3)[np.argmin(np.abs(along))]))
    normals = np.stack([first, np.cross(along, first)])
    return LoopJoint(tip, normals, normals @ np.asarray(point), base)


def point_fixed(tip: str, point: Array, base: str | None = None) -> LoopJoint:
    """Return the tip held at `point` (3,) [m], free to turn about it; m = 3."""
    return LoopJoint(tip, np.eye(3), np.array(point, dtype=float), base)


def weld(tip: str, point: Array, rotation: Array, base: str | None = None) -> LoopJoint:
    """Return the tip's frame held at `point` (3,) [m] with axes `rotation` (3, 3); m = 6, forces first."""
    return LoopJoint(tip, np.eye(3), np.array(point, dtype=float), base, np.array(rotation, dtype=float))


def constraint_matrix(normals: Array, r: Array, *, couples: bool = False) -> Array:
    """Return R (6, k) of Eq. 2, whose columns (r×n, n) span the force that the loop joint can bear, at O.

    The motion is restricted to Rᵀ (vₙ − v₀) = 0, and the force that this takes is R f. The forces are through the tip
    r (3,) along normals (k, 3); `couples` adds three columns of pure couple, which stop the tip from turning.
    """
    forces = np.concatenate([normals @ skew(r).T, normals], axis=1).T
    return np.concatenate([forces, np.eye(6)[:, :3]], axis=1) if couples else np.asarray(forces)


def constraint_matrix_rate(normals: Array, r: Array, r_dot: Array, omega: Array, *, couples: bool = False) -> Array:
    """Return Ṙ of `constraint_matrix` as the tip moves at ṙ (3,) and the normals turn at ω (3,): Ṙ of Eq. 3.

    The three couples along the base axes do not turn.
    """
    turning = normals @ skew(omega).T
    forces = np.concatenate([normals @ skew(r_dot).T + turning @ skew(r).T, turning], axis=1).T
    return np.concatenate([forces, np.zeros((6, 3))], axis=1) if couples else np.asarray(forces)


def closure_torque(R: Array, J: Array, f: Array) -> Array:
    """Return Jᵀ R f (n,), what the closure force f (m,) adds to Q in H q̈ + C = Q + Jᵀ R f (Eq. 7; T_equ of Eq. 1)."""
    return np.asarray(J.T @ (R @ f))


def loop_rows(tree: Tree, pose: Pose, v: Array, joint: LoopJoint) -> Rows:
    """Return the rows A = RᵀJ of Eq. 6 with their drift −b of Eq. 10, their error c(q) of Eq. 1 and its rate.

    J is the Jacobian across the loop joint, that of link n less that of link 0 (Eq. 4 for both; the paper's link 0
    is the base, at rest). The drift is Ṙᵀ (vₙ − v₀) + Rᵀ (aₙ − a₀) at q̈ = 0 (Eq. 3, Eq. 5). The error of an
    orientation is the rotation vector to first order, ½ vee(E − Eᵀ) with E = R_tip R_heldᵀ; its rate is exact only
    where that error is zero.
    """
    v = np.asarray(v)
    r = kinematics.tip_position(tree, pose, joint.tip)
    other = GROUND if joint.base is None else tree.frame(joint.base).body
    body = tree.frame(joint.tip).body
    ground = np.zeros(6, dtype=np.result_type(pose.axes, v))
    velocities = kinematics.body_velocities(tree, pose, v)
    v_n, v_0 = (ground if i == GROUND else velocities[i] for i in (body, other))
    origin, axes = (
        (np.zeros(3), np.eye(3))
        if joint.base is None
        else (kinematics.tip_position(tree, pose, joint.base), kinematics.tip_rotation(tree, pose, joint.base))
    )
    normals = joint.normals @ axes.T
    couples = joint.rotation is not None
    R = constraint_matrix(normals, r, couples=couples)
    R_dot = constraint_matrix_rate(normals, r, kinematics.point_velocity(v_n, r), v_0[:3], couples=couples)
    J_0, J_n = kinematics.loop_jacobians(tree, pose, joint.tip, joint.base)
    A = R.T @ (J_n - J_0)
    drift = R_dot.T @ (v_n - v_0) + R.T @ (
        kinematics.spatial_drift(tree, pose, v, body) - kinematics.spatial_drift(tree, pose, v, other)
    )
    error = normals @ (r - origin) - joint.offsets
    if joint.rotation is not None:
        turned = kinematics.tip_rotation(tree, pose, joint.tip) @ (axes @ joint.rotation).T
        twice = turned - turned.T
        error = np.concatenate([error, np.array([twice[2, 1], twice[0, 2], twice[1, 0]]) / 2])
    return Rows(A, np.asarray(drift), np.asarray(error), np.asarray(A @ v))


def closure_error(normal: Array, offset: float, r: Array) -> Array:
    """Return e = n·r − d [m], zero on the plane and positive off the surface (Eq. 19)."""
    return np.asarray(normal @ r - offset)


def closure_rate(normal: Array, jacobian: Array, v: Array) -> Array:
    """Return ė = nᵀJᵣ q̇ [m/s], the closure error differentiated once (Eq. 20)."""
    return np.asarray(normal @ (jacobian @ v))


def closure_acceleration(normal: Array, jacobian: Array, drift: Array, a: Array) -> Array:
    """Return ë = nᵀ (Jᵣ q̈ + J̇ᵣq̇) [m/s²], the closure error differentiated twice (Eq. 21)."""
    return np.asarray(normal @ (jacobian @ a + drift))


def stabiliser_gains(damping_ratio: float, time_constant: float) -> tuple[float, float]:
    """Return s_v = 2ζ/T [1/s] and s_p = 1/T² [1/s²] of ë + s_v ė + s_p e = 0 (Eq. 22)."""
    return 2.0 * damping_ratio / time_constant, 1.0 / time_constant**2


def stabilised_drift(drift: Array, error: Array, rate: Array, gains: tuple[float, float]) -> Array:
    """Return b_s = −nᵀJ̇ᵣq̇ − s_v ė − s_p e, the ë + s_v ė + s_p e = 0 that Eq. 24 solves for (Eq. 23).

    nᵀJ̇ᵣq̇, e and ė are scalars, or (m,); gains s_v, 1/s, and s_p, 1/s², of zero are no stabiliser.
    """
    s_v, s_p = gains
    return np.asarray(-drift - s_v * rate - s_p * error)


def solve_bordered(H: Array, forcing: Array, A: Array, b: Array) -> tuple[Array, Array]:
    """Solve [[H, Aᵀ], [A, 0]] [q̈; −f] = [Q − C; b_s] as one dense system: Eq. 24, and Eq. 9 for any loop joint.

    H: (n, n); forcing: (n,) Q − C; A: (m, n) closure rows; b: (m,)
    Returns q̈ (n,) and f (m,), the force of the surface on the robot, positive along +n.
    """
    A, b = np.atleast_2d(A), np.atleast_1d(b)
    m, n = A.shape
    matrix = np.zeros((n + m, n + m), dtype=np.result_type(H, A))
    matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = H, A.T, A
    solution = np.linalg.solve(matrix, np.concatenate([forcing, b]))
    return solution[:n], -solution[n:]


def impulse(H: Array, v: Array, A: Array, restitution: float = 0.0) -> tuple[Array, Array]:
    """Solve [[H, Aᵀ], [A, 0]] [v⁺; −p] = [H v⁻; −ε A v⁻], Eq. 24 integrated over an instant.

    H: (n, n); v: (n,) rates v⁻ before; A: (m, n); restitution: ε, 0 plastic to 1 elastic
    Returns v⁺ (n,) and p (m,) [N s], the impulse of the surface on the robot, positive along +n: H (v⁺ − v⁻) = Aᵀ p.
    """
    A = np.atleast_2d(A)
    return solve_bordered(H, H @ v, A, -restitution * (A @ v))


def _unit(vector: Array) -> Array:
    """Return a direction (3,) at length one."""
    vector = np.asarray(vector, dtype=float)
    length = float(np.linalg.norm(vector))
    if not np.isfinite(length) or length == 0.0:
        raise ValueError(f"{vector.tolist()} has no direction")
    return vector / length
