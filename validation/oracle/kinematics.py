"""Kinematics of the tree and of its tip: Eqs. 4–5, 13–18 and 25–32 of the paper.

All spatial vectors are in base coordinates at the base origin O (see `spatial`), where the paper's recursions
carry no transforms.

q, v and what follows from them may be float, complex or object (mpmath) arrays.
"""

from dataclasses import dataclass

import numpy as np

from validation.oracle.spatial import Array, cos_sin, cross_motion, inertia_to_base, motion_to_base, skew
from validation.oracle.tree import GROUND, Tree


@dataclass(frozen=True)
class Pose:
    """The tree at one q, in base coordinates.

    rotation : (n, 3, 3) axes of body i
    position : (n, 3) origin of body i [m]
    axes : (n, 6) joint axes s_i as motion vectors at O
    inertia : (n, 6, 6) spatial inertia of body i about O
    """

    rotation: Array
    position: Array
    axes: Array
    inertia: Array


def forward_kinematics(tree: Tree, q: Array) -> Pose:
    """Place every body at q (n,), rad or m: from the base outwards, R_i = R_λ R_tree R_joint(q_i)."""
    q = np.asarray(q)
    n, dtype = tree.size, np.result_type(q, np.float64)
    cos, sin = cos_sin(q)
    fixed, turn, turn_twice = tree.joint_matrices
    rotation, position = np.zeros((n, 3, 3), dtype=dtype), np.zeros((n, 3), dtype=dtype)
    for i, above in enumerate(tree.parent):
        if tree.kinds[i] == "prismatic":
            local, offset = fixed[i], tree.translation[i] + fixed[i] @ tree.axis[i] * q[i]
        else:
            local = fixed[i] + sin[i] * turn[i] + (1.0 - cos[i]) * turn_twice[i]
            offset = tree.translation[i]
        if above == GROUND:
            rotation[i], position[i] = local, offset
        else:
            rotation[i] = rotation[above] @ local
            position[i] = position[above] + rotation[above] @ offset
    return Pose(
        rotation=rotation,
        position=position,
        axes=joint_axes(tree, rotation, position),
        inertia=inertia_to_base(rotation, position, tree.inertia),
    )


def joint_axes(tree: Tree, rotation: Array, position: Array) -> Array:
    """Return the joint axes s_i (n, 6): (e, p × e) of a turning joint, (0, e) of a sliding one."""
    own = np.zeros((tree.size, 6, 1))
    for i, kind in enumerate(tree.kinds):
        start = 3 if kind == "prismatic" else 0
        own[i, start : start + 3, 0] = tree.axis[i]
    return np.asarray((motion_to_base(rotation, position) @ own)[..., 0])


def body_velocities(tree: Tree, pose: Pose, v: Array) -> Array:
    """Return the spatial velocities (n, 6) of bodies at q̇ (n,), v_i = v_λ(i) + s_i q̇_i, v_0 = 0: J q̇ of Eq. 4."""
    out = pose.axes * np.asarray(v)[:, None]
    for i, above in enumerate(tree.parent):
        if above != GROUND:
            out[i] += out[above]
    return np.asarray(out)


def axis_rates(pose: Pose, velocities: Array) -> Array:
    """Return ṡ_i = v_i × s_i (n, 6), the rates of joint axes carried along by their bodies at v (n, 6) (in Eq. 28)."""
    return np.asarray((cross_motion(velocities) @ pose.axes[..., None])[..., 0])


def bias_accelerations(tree: Tree, pose: Pose, v: Array) -> Array:
    """Return all bodies' accelerations (n, 6) at q̈ = 0, a_i = a_λ(i) + v_i × s_i q̇_i, a_0 = 0 (Eq. 31, Eq. 32)."""
    return accelerations(tree, axis_rates(pose, body_velocities(tree, pose, v)) * np.asarray(v)[:, None])


def accelerations(tree: Tree, own: Array) -> Array:
    """Return the sums from the base outwards, a_i = a_λ(i) + own_i with a_0 = 0, of (n, 6) vectors.

    With own_i = s_i q̈_i + ṡ_i q̇_i these are the accelerations of the bodies (Eq. 28).
    """
    out = np.array(own)
    for i, above in enumerate(tree.parent):
        if above != GROUND:
            out[i] += out[above]
    return out


def spatial_jacobian(tree: Tree, pose: Pose, body: int) -> Array:
    """Return J (6, n) of a body: column i is s_i if joint i carries it, else zero; v_body = J q̇ (Eq. 25, Eq. 4)."""
    if body == GROUND:
        return np.zeros((6, tree.size), dtype=pose.axes.dtype)
    return np.asarray((pose.axes * tree.supports[:, body, None]).T)


def toolbox_jacobians(jacobian: Array, r: Array, rotation: Array) -> tuple[Array, Array]:
    """Return J₀ and Jₙ (6, n) of the Robotics Toolbox, angular rows first, from J at O (Eq. 26, Eq. 27).

    Both are of the point r (3,), along the base axes and along the axes of the tip's frame, `rotation` (3, 3) in base
    axes; its transpose is the paper's E.
    """
    at_tip = np.concatenate([jacobian[:3], translational_jacobian(jacobian, r)])
    own = rotation.T
    return at_tip, np.concatenate([own @ at_tip[:3], own @ at_tip[3:]])


def loop_jacobians(tree: Tree, pose: Pose, tip: str, base: str | None = None) -> tuple[Array, Array]:
    """Return the Jacobians (6, n) of the two links that the loop joint connects, link 0 and link n (Eq. 4).

    The velocity across the loop joint is their difference times q̇. With the surface at rest the first is zero.
    `base` is the link on the side that is not the tip's; None is the ground.
    """
    other = GROUND if base is None else tree.frame(base).body
    return spatial_jacobian(tree, pose, other), spatial_jacobian(tree, pose, tree.frame(tip).body)


def spatial_drift(tree: Tree, pose: Pose, v: Array, body: int) -> Array:
    """Return J̇q̇ (6,) of a body, by the recursion: the acceleration that its velocity alone gives it.

    It is a_n^vp of Eq. 30, the last term of Eq. 5 and of Eq. 29.
    """
    if body == GROUND:
        return np.zeros(6, dtype=np.result_type(pose.axes, v))
    return np.asarray(bias_accelerations(tree, pose, v)[body])


def tip_position(tree: Tree, pose: Pose, tip: str) -> Array:
    """Return the tip's position r (3,), base frame [m]: k_r of Eq. 15."""
    frame = tree.frame(tip)
    if frame.body == GROUND:
        return np.array(frame.translation)
    return np.asarray(pose.position[frame.body] + pose.rotation[frame.body] @ frame.translation)


def tip_rotation(tree: Tree, pose: Pose, tip: str) -> Array:
    """Return the axes of the tip's frame (3, 3), base frame."""
    frame = tree.frame(tip)
    if frame.body == GROUND:
        return np.array(frame.rotation)
    return np.asarray(pose.rotation[frame.body] @ frame.rotation)


def point_velocity(velocity: Array, r: Array) -> Array:
    """Return ṙ = v_O + ω × r (3,), m/s, of the body-fixed point at r (3,), from the body's velocity (6,) (Eq. 16)."""
    return np.asarray(velocity[3:] + skew(velocity[:3]) @ r)


def translational_jacobian(jacobian: Array, r: Array) -> Array:
    """Return Jᵣ = J_lin − r×J_ang (3, n) of the point r (3,), so that ṙ = Jᵣ q̇ (Eq. 13, with r× of Eq. 14)."""
    return np.asarray(jacobian[3:] - skew(r) @ jacobian[:3])


def point_acceleration(acceleration: Array, velocity: Array, r: Array) -> Array:
    """Return r̈ = a_O + ω̇ × r + ω × ṙ (3,), m/s², of the body-fixed point at r (3,) (Eq. 17).

    With the spatial bias acceleration J̇q̇ as `acceleration`, this is the drift J̇ᵣq̇: Eq. 18. Acceleration (ω̇, a_O)
    and velocity (6,) are spatial, at O; a_O is not a point's acceleration.
    """
    r_dot = point_velocity(velocity, r)
    return np.asarray(acceleration[3:] + skew(acceleration[:3]) @ r + skew(velocity[:3]) @ r_dot)
