"""Eqs. 1–10 for the loop joints of a mechanism: R of every type by hand, and the motion that they leave.

The columns of R (6, m) are the forces and couples that a loop joint can bear, of its second side on its first. Of a
joint whose freedoms are fixed to the second side they turn with that side and go along with the joint's point on the
first; a universal joint's couple stands on the axes of both sides, and a rod's force lies along it. With the two links'
velocities and accelerations at the base origin O

    Rᵀ (v_a − v_b) = 0,      Ṙᵀ (v_a − v_b) + Rᵀ (a_a − a_b) = 0.

Rows that depend on each other are solved with all others in one system, by singular values: the shortest solution is
the reaction of least norm.

A loop joint as its type, its two sides and what it bears there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from validation.oracle import kinematics
from validation.oracle.closure import constraint_matrix
from validation.oracle.dynamics import bias, mass_matrix
from validation.oracle.engine import Oracle
from validation.oracle.kinematics import Pose
from validation.oracle.spatial import Array, skew
from validation.oracle.tree import GROUND

# Along which of the joint's axes x, y, z (the last is the joint's own) it bears forces, and about which couples.
FORCES = {"point": "xyz", "hinge": "xyz", "slider": "xy", "cylinder": "xy", "universal": "xyz", "planar": "z",
          "weld": "xyz"}  # fmt: skip
COUPLES = {"point": "", "hinge": "xy", "slider": "xyz", "cylinder": "xy", "universal": "", "planar": "xy",
           "weld": "xyz"}  # fmt: skip


WORLD = "world"
"""What stands for the base as a frame of a loop joint."""


class LoopJoint(Protocol):
    """What is read of a loop joint: lengths in m, directions of length one, the first of a pair in the first frame."""

    @property
    def type(self) -> str:
        """Of `FORCES`, or ``"distance"`` or ``"gear"``."""

    @property
    def frames(self) -> Sequence[str]:
        """Names of the two frames, of which the second may be `WORLD`."""

    @property
    def points(self) -> Sequence[Sequence[float]]:
        """A point in either frame."""

    @property
    def axes(self) -> Sequence[Sequence[float]]:
        """An axis in either frame."""

    @property
    def turn(self) -> Sequence[Sequence[float]]:
        """The first frame's axes in the second frame when closed: a rotation, row by row."""

    @property
    def length(self) -> float:
        """Of a distance."""

    @property
    def joints(self) -> Sequence[str]:
        """Names of the joints of a gear; one alone is held at c0."""

    @property
    def coefficients(self) -> Sequence[Sequence[float]]:
        """Of a gear between sums of joints, the coefficients of its joints in either."""

    @property
    def polynomial(self) -> Sequence[float]:
        """c0 ... c4 of q1 = c0 + c1 q2 + ... of a gear."""


def joint_axes(joint: LoopJoint, k: int) -> Array:
    """Return the axes of a loop joint, columns, in the frame of its side k; those of both agree where it is closed.

    Of a type that is free to turn about its axis z alone, z does.
    """
    z = np.array(joint.axes[0])
    x = np.cross(z, [0.6, 0.0, 0.8]) if abs(z @ [0.6, 0.0, 0.8]) < 0.9 else np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    first = np.column_stack([x, np.cross(z, x), z])
    if k == 0:
        return first
    if joint.type in ("slider", "weld"):
        return np.asarray(np.array(joint.turn) @ first)
    other = np.array(joint.axes[1])
    y = np.cross(other, np.eye(3)[int(np.argmin(np.abs(other)))])
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, other), y, other])


STEP = 1e-30
"""Of complex steps, which have no truncation."""
DEPENDENT = 1e-10
"""Singular values of the whole system below this share of the largest are those of rows that depend on others."""
NO_ROW = 1e-11
"""A row shorter than the longest by this factor is rounding: no joint moves what it binds."""


@dataclass(frozen=True)
class LoopRows:
    """The rows of one loop joint at a state: A q̈ + drift = 0.

    A (m, n); drift (m,); forces : how many of the rows are forces, N, which come first; the others are couples, N m
    """

    A: Array
    drift: Array
    forces: int


@dataclass(frozen=True)
class Motion:
    """What a mechanism does at a state.

    acceleration : q̈ (n,)
    pulls : (k, n) torque of each loop joint on the joints, Gᵀλ of its rows, N m (N)
    force, couple : (k,) sizes of the force and of the couple that each loop joint bears, N and N m
    contact : f of the surface on the tip, N
    """

    acceleration: Array
    pulls: Array
    force: Array
    couple: Array
    contact: float


class LoopOracle:
    """A mechanism by the paper's own equations.

    loops: what closes it
    drives: names of the joints that have a drive; all of them if empty
    """

    def __init__(self, oracle: Oracle, loops: Sequence[LoopJoint], drives: Sequence[str] = ()) -> None:
        self.oracle, self.loops = oracle, tuple(loops)
        names = oracle.tree.names
        self.driven = np.array([not drives or name in drives for name in names])

    def constraint_rate(self, normals: Array, r: Array, r_dot: Array, omega: Array) -> Array:
        """Return Ṙ (6, k) of forces through r (3,) along normals (k, 3) that turn at ω (3,)."""
        turning = normals @ skew(omega).T
        return np.concatenate([normals @ skew(r_dot).T + turning @ skew(r).T, turning], axis=1).T

    def rod_rate(self, along: Array, apart_rate: Array, length: float) -> Array:
        """Return the rate (3,) of a rod's direction, of what its ends part with (3,), m/s."""
        return np.asarray((apart_rate - along * (along @ apart_rate)) / length)

    def ratio(self, joint: LoopJoint, x: complex) -> complex:
        """Return dP/dx₂ of a gear, by a complex step where x is real."""
        return complex(sum(k * c * x ** (k - 1) for k, c in enumerate(joint.polynomial) if k))

    def curvature(self, joint: LoopJoint, x: float) -> float:
        """Return d²P/dx₂² of a gear, a complex step of its ratio."""
        return float(np.imag(self.ratio(joint, x + 1j * STEP)) / STEP)

    def rows(self, joint: LoopJoint, pose: Pose, q: Array, v: Array) -> LoopRows:
        """Return the rows of a loop joint, where it is closed."""
        if joint.type == "gear":
            return self._gear(joint, q, v)
        tree = self.oracle.tree
        velocities = kinematics.body_velocities(tree, pose, v)
        (a, r_a, axes_a), (b, r_b, axes_b) = (self._side(joint, pose, k) for k in range(2))
        v_a, v_b = (np.zeros(6) if body == GROUND else velocities[body] for body in (a, b))
        r_dot = kinematics.point_velocity(v_a, r_a)
        if joint.type == "distance":
            along = (r_a - r_b) / joint.length
            turning = self.rod_rate(along, r_dot - kinematics.point_velocity(v_b, r_b), joint.length)
            R = constraint_matrix(along[None, :], r_a)
            rate = np.concatenate([np.cross(r_dot, along) + np.cross(r_a, turning), turning])[:, None]
            forces = 1
        else:
            normals = axes_b.T[["xyz".index(x) for x in FORCES[joint.type]]]
            forces = len(normals)
            R = constraint_matrix(normals, r_a)
            rate = self.constraint_rate(normals, r_a, r_dot, v_b[:3])
            couples, turning = self._couples(joint, axes_a, axes_b, v_a[:3], v_b[:3])
            still = np.zeros((3, len(couples)))
            R = np.concatenate([R, np.concatenate([couples.T, still])], axis=1)
            rate = np.concatenate([rate, np.concatenate([turning.T, still])], axis=1)
        A = R.T @ (kinematics.spatial_jacobian(tree, pose, a) - kinematics.spatial_jacobian(tree, pose, b))
        a_a, a_b = (kinematics.spatial_drift(tree, pose, v, body) for body in (a, b))
        return LoopRows(A, rate.T @ (v_a - v_b) + R.T @ (a_a - a_b), forces)

    def _gear(self, joint: LoopJoint, q: Array, v: Array) -> LoopRows:
        first, second = self._sums(joint)
        x = float(second @ q)
        A = first - self.ratio(joint, x).real * second
        return LoopRows(A[None, :], np.array([-self.curvature(joint, x) * float(second @ v) ** 2]), 0)

    def _sums(self, joint: LoopJoint) -> Array:
        """Return the coefficients of all joints in the two sides of a gear (2, n)."""
        made = np.zeros((2, len(self.oracle.tree.names)))
        for row, given in zip(made, joint.coefficients or np.eye(2)[:, : len(joint.joints)], strict=True):
            row[[self.oracle.tree.names.index(name) for name in joint.joints]] = given
        return made

    def _side(self, joint: LoopJoint, pose: Pose, k: int) -> tuple[int, Array, Array]:
        """Return a side's body, the joint's point, m, and the joint's axes there, columns, base frame."""
        tree, frame = self.oracle.tree, joint.frames[k]
        if frame == WORLD:
            body, at, axes = GROUND, np.zeros(3), np.eye(3)
        else:
            body, at, axes = (
                tree.frame(frame).body,
                kinematics.tip_position(tree, pose, frame),
                kinematics.tip_rotation(tree, pose, frame),
            )
        return body, at + axes @ np.array(joint.points[k]), axes @ joint_axes(joint, k)

    def _couples(self, joint: LoopJoint, axes_a: Array, axes_b: Array, w_a: Array, w_b: Array) -> tuple[Array, Array]:
        """Return the couples (k, 3) and their rates."""
        if joint.type != "universal":
            couples = axes_b.T[["xyz".index(x) for x in COUPLES[joint.type]]]
            return couples, couples @ skew(w_b).T
        z_a, z_b = axes_a[:, 2], axes_b[:, 2]
        rate = np.cross(np.cross(w_a, z_a), z_b) + np.cross(z_a, np.cross(w_b, z_b))
        return np.cross(z_a, z_b)[None, :], rate[None, :]

    def apart(self, q: Array) -> float:
        """Return by how much the loop joints are open at q, m: points that do not meet along a force that is borne."""
        pose, found = self.oracle.pose(q), [0.0]
        for joint in self.loops:
            if joint.type == "gear":
                one, other = self._sums(joint) @ q
                found.append(abs(float(one - np.polynomial.Polynomial(joint.polynomial)(other))))
                continue
            (_, r_a, _), (_, r_b, axes_b) = (self._side(joint, pose, k) for k in range(2))
            if joint.type == "distance":
                found.append(abs(float(np.linalg.norm(r_a - r_b)) - joint.length))
            else:
                along = axes_b.T @ (r_a - r_b)
                found += [abs(float(along["xyz".index(x)])) for x in FORCES[joint.type]]
        return max(found)

    def all_rows(self, q: Array, v: Array) -> list[LoopRows]:
        """Return the rows of every loop joint."""
        pose = self.oracle.pose(q)
        return [self.rows(joint, pose, q, v) for joint in self.loops]

    def through_drives(self, torque: Array, G: Array) -> Array:
        """Return the torque (n,) of the drives alone that moves the mechanism as `torque` would.

        Raises `LinAlgError` if the drives cannot give it.
        """
        free = ~self.driven
        force = np.linalg.lstsq(G[:, free].T, torque[free], rcond=DEPENDENT)[0]
        given = torque - G.T @ force
        if not np.allclose(given[free], 0.0, atol=1e-9 * (1.0 + float(np.max(np.abs(torque), initial=0.0)))):
            raise np.linalg.LinAlgError("the drives cannot give this torque")
        return np.where(free, 0.0, given)

    def answer(self, q: Array, v: Array, torque: Array, normal: Array | None = None, slope: float = 0.0) -> Motion:
        """Return the motion under a torque of all joints, and the reactions of the torque that the drives give for it.

        q, v, torque: (n,)
        normal: (3,) of a plane on which the tip is held; None: it is free
        slope: Coulomb's μ of a tip that slides on it
        """
        tree, pose = self.oracle.tree, self.oracle.pose(q)
        found = self.all_rows(q, v)
        G, gamma = np.concatenate([rows.A for rows in found]), np.concatenate([rows.drift for rows in found])
        H, C = mass_matrix(tree, pose), bias(tree, pose, v)
        forcing = self.through_drives(torque, G) - C
        if normal is None:
            acceleration, forces = least_norm(H, forcing, G, G, -gamma)
        else:
            J, b = self.oracle.jacobian(q), np.append(-gamma, -(normal @ self.oracle.drift(q, v)))
            along = J @ v - normal * (normal @ J @ v)
            for sign in (1.0, -1.0):  # friction acts against slip, whether the closure pushes or pulls
                push = normal - sign * slope * along / np.linalg.norm(along) if slope else normal
                acceleration, forces = least_norm(H, forcing, np.vstack([G, normal @ J]), np.vstack([G, push @ J]), b)
                if forces[-1] * sign >= 0.0:
                    break
        pulls, force, couple, at = [], [], [], 0
        for rows in found:
            own = self.reaction(forces[at : at + len(rows.A)])
            pulls.append(rows.A.T @ own)
            force.append(np.linalg.norm(own[: rows.forces]))
            couple.append(np.linalg.norm(own[rows.forces :]))
            at += len(rows.A)
        contact = float(forces[at]) if normal is not None else 0.0
        return Motion(acceleration, np.array(pulls), np.array(force), np.array(couple), contact)

    def reaction(self, forces: Array) -> Array:
        """Return the reaction (m,) of the second side on the first of the multipliers (m,)."""
        return forces


def least_norm(H: Array, forcing: Array, G: Array, acts: Array, b: Array) -> tuple[Array, Array]:
    """Solve H q̈ = forcing + actsᵀ λ, G q̈ = b for q̈ (n,) and the shortest λ (m,); Eq. 9 with rows of any rank."""
    D = 1.0 / np.sqrt(np.diag(H))
    n, m = len(H), len(G)
    size = np.linalg.norm(G * D, axis=1)
    real = size > NO_ROW * np.max(size)
    weight = np.divide(1.0, size, out=np.zeros(m), where=real)  # of equations: their order of size is no matter
    scale = float(np.median(size[real])) if np.any(real) else 1.0
    K = np.zeros((n + m, n + m))
    K[:n, :n], K[:n, n:] = H * np.outer(D, D), -(acts * D).T / scale
    K[n:, :n] = weight[:, None] * G * D
    right = np.concatenate([D * forcing, weight * b])
    solution, *_ = np.linalg.lstsq(K, right, rcond=DEPENDENT)
    return D * solution[:n], solution[n:] / scale
