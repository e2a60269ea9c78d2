"""Dynamics of the open tree: H, C and the energies of Eq. 8, H q̈ = Q − C.

H by the composite-rigid-body algorithm, C and the inverse dynamics by recursive Newton–Euler, both in base
coordinates at O (see `spatial`). C holds Coriolis, centrifugal *and* gravity terms. Functions that solve no
linear system take float, complex or object (mpmath) arrays; those that do take float or complex.
"""

import numpy as np

from validation.oracle.kinematics import Pose, accelerations, axis_rates, body_velocities
from validation.oracle.spatial import Array, cross_force, cross_motion, cross_swapped
from validation.oracle.tree import GROUND, Tree


def mass_matrix(tree: Tree, pose: Pose) -> Array:
    """Return H (n, n) of Eq. 8: H_ji = s_j · I_i^c s_i with j on the path to i; armature on the diagonal.

    I_i^c is the inertia of body i and of all that it carries, taken as one rigid body (composite-rigid-body
    algorithm).
    """
    composite = sum_over_carried(tree, pose.inertia)
    momenta = (composite @ pose.axes[..., None])[..., 0]
    upper = np.where(tree.supports, pose.axes @ momenta.T, 0.0)
    diagonal = np.diag(upper)
    return np.asarray(upper + upper.T + np.diag(tree.armature - diagonal))


def mass_matrix_by_newton_euler(tree: Tree, pose: Pose) -> Array:
    """Return H (n, n) of Eq. 8, a column a Newton–Euler pass: the torque of q̈_j = 1 alone, at rest, without weight.

    The method of Walker and Orin (1982), which the paper calls easy to implement but costly beside the composite
    bodies of `mass_matrix`: n passes over n bodies are O(n²), with the whole of a pass for each.
    """
    still, free = np.zeros(tree.size), np.zeros(3)
    return np.stack([inverse_dynamics(tree, pose, still, unit, gravity=free) for unit in np.eye(tree.size)], axis=1)


def inverse_dynamics(
    tree: Tree, pose: Pose, v: Array, a: Array, *, push: Array | None = None, gravity: Array | None = None
) -> Array:
    """Return Q = H q̈ + C − (what `push` does) (n,) of Eq. 8 at q̇, q̈ (n,), by recursive Newton–Euler.

    push: (n, 6) force vectors at O that the surroundings exert on the bodies; none by default
    gravity: (3,), another than the tree's
    """
    v, a = np.asarray(v), np.asarray(a)
    velocity = body_velocities(tree, pose, v)
    own = pose.axes * a[:, None] + axis_rates(pose, velocity) * v[:, None]
    acceleration = accelerations(tree, own)
    # Weight is the force that would accelerate the bodies upwards in free space: a_0 = −g.
    acceleration[:, 3:] = acceleration[:, 3:] - (tree.gravity if gravity is None else gravity)
    momentum = pose.inertia @ velocity[..., None]
    force = (pose.inertia @ acceleration[..., None] + cross_force(velocity) @ momentum)[..., 0]
    carried = sum_over_carried(tree, force if push is None else force - push)
    return np.asarray(np.sum(pose.axes * carried, axis=1) + tree.armature * a)


def sum_over_carried(tree: Tree, own: Array) -> Array:
    """Return, for each body, the sum of `own` (n, ...) over itself and all bodies that it carries."""
    out = np.array(own)
    for i in reversed(range(tree.size)):
        if tree.parent[i] != GROUND:
            out[tree.parent[i]] += out[i]
    return out


def bias(tree: Tree, pose: Pose, v: Array) -> Array:
    """Return C (n,) of Eq. 8: the torque of inverse dynamics at q̈ = 0; Coriolis, centrifugal and gravity."""
    return inverse_dynamics(tree, pose, v, np.zeros(tree.size))


def gravity_term(tree: Tree, pose: Pose) -> Array:
    """Return the part of C that gravity makes, (n,): the torque that holds the arm at rest."""
    nothing = np.zeros(tree.size)
    return inverse_dynamics(tree, pose, nothing, nothing)


def forward_dynamics(tree: Tree, pose: Pose, v: Array, torque: Array) -> Array:
    """Return q̈ = H⁻¹ (Q − C), Eq. 8 for the arm that touches nothing, (n,)."""
    return np.asarray(np.linalg.solve(mass_matrix(tree, pose), torque - bias(tree, pose, v)))


def coriolis_matrix(tree: Tree, pose: Pose, v: Array) -> Array:
    """Return the matrix (n, n) with C = (matrix) q̇ + gravity term that makes Ḣ − 2 (matrix) skew-symmetric.

    It is Σ_i J_iᵀ (I_i J̇_i + B_i J_i) with B_i = ½ [ v_i×* I_i − I_i v_i× + (I_i v_i)×̄* ]: that B_i v_i =
    v_i×* I_i v_i and B_i + B_iᵀ = İ_i give the two properties (Echeandia and Wensing, 2021: these are the
    Christoffel symbols).
    """
    velocity = body_velocities(tree, pose, v)
    rates = axis_rates(pose, velocity)
    out = np.zeros((tree.size, tree.size), dtype=np.result_type(pose.axes, velocity))
    for i in range(tree.size):
        carries = tree.supports[:, i, None]
        jacobian, jacobian_dot = (pose.axes * carries).T, (rates * carries).T
        inertia, vi = pose.inertia[i], velocity[i]
        half = cross_force(vi) @ inertia - inertia @ cross_motion(vi) + cross_swapped(inertia @ vi)
        out += jacobian.T @ (inertia @ jacobian_dot + half @ jacobian / 2)
    return out


def kinetic_energy(tree: Tree, pose: Pose, v: Array) -> Array:
    """Return T [J], body by body: Σ ½ v_i · I_i v_i, plus ½ armature q̇² of the drives."""
    v = np.asarray(v)
    velocity = body_velocities(tree, pose, v)
    momentum = (pose.inertia @ velocity[..., None])[..., 0]
    return np.asarray((np.sum(velocity * momentum) + np.sum(tree.armature * v * v)) / 2)


def potential_energy(tree: Tree, pose: Pose) -> Array:
    """Return U = −Σ m g·c [J] of the moving bodies, zero with all mass at the base origin.

    m c is read from the spatial inertia about O, whose upper right block is m c×.
    """
    block = pose.inertia[:, :3, 3:]
    moment = np.stack([block[:, 2, 1], block[:, 0, 2], block[:, 1, 0]], axis=-1)
    return np.asarray(-np.sum(moment @ tree.gravity))
