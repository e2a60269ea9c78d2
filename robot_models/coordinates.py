"""Coordinates of bodies that turn freely: a ball joint has three velocities and the four numbers of a quaternion.

A free joint is three sliding joints along the axes of the joint's frame (those of the world, for a body that floats in
it) and a ball joint. So its positions are x, y, z and the quaternion w, x, y, z, its velocities those of the origin in
these axes and the angular velocity in the body's own: the order of MuJoCo.

Inside a simulation a ball joint has three positions, the rotation vector θ: unit axis times angle, rad, with
q = (cos |θ|/2, θ/|θ| sin |θ|/2). Its length may be anything; θ and θ(1 - 2π/|θ|) are the same orientation.
"""

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_models.errors import ModelError

if TYPE_CHECKING:
    import pinocchio as pin

Array = NDArray[np.float64]

#: The type of each of a ball joint's three velocities.
BALL = "ball"
#: The type of each of its four positions.
QUATERNION = "quaternion"

#: Ends of the names of a free joint's coordinates, of a ball joint's velocities and of its positions.
PLACES, RATES, PARTS = ("_x", "_y", "_z"), ("_wx", "_wy", "_wz"), ("_qw", "_qx", "_qy", "_qz")

#: A quaternion shorter than this is none.
LEAST_LENGTH = 1e-10
# The rounding of a quaternion's length.
ROUNDING = 1e-15


def balls(types: Sequence[str]) -> list[int]:
    """Return the first velocity of each ball joint, by the types of all velocities."""
    found: list[int] = []
    for j, kind in enumerate(types):
        if kind == BALL and not (found and j < found[-1] + 3):
            found.append(j)
    return found


def coordinate_names(names: Sequence[str], types: Sequence[str]) -> tuple[str, ...]:
    """Return the names of all positions, by the names and types of all velocities."""
    first = balls(types)
    found: list[str] = []
    for j, name in enumerate(names):
        if j in first:
            found += [name.removesuffix(RATES[0]) + part for part in PARTS]
        elif types[j] != BALL:
            found.append(name)
    return tuple(found)


def coordinate_types(types: Sequence[str]) -> tuple[str, ...]:
    """Return the types of all positions, by those of all velocities: of a quaternion's four numbers QUATERNION."""
    first = balls(types)
    found: list[str] = []
    for j, kind in enumerate(types):
        found += [QUATERNION] * 4 if j in first else [kind] * (kind != BALL)
    return tuple(found)


def quaternions(types: Sequence[str]) -> list[int]:
    """Return the first of the four numbers of each quaternion among the positions."""
    return [j + k for k, j in enumerate(balls(types))]


def normalised(q: ArrayLike, types: Sequence[str], what: str) -> Array:
    """Return positions (nq,) with unit quaternions.

    Raises `ModelError` if a quaternion has no length; `what` names the positions in the message.
    """
    found = np.array(q, dtype=np.float64)
    for at in quaternions(types):
        largest = float(np.abs(found[at : at + 4]).max())
        length = largest * float(np.linalg.norm(found[at : at + 4] / largest)) if largest > 0.0 else 0.0
        if not LEAST_LENGTH < length < np.inf:
            raise ModelError(
                f"{what}[{at}:{at + 4}] = {found[at : at + 4].tolist()}: a quaternion w, x, y, z of length zero is no "
                "rotation; [1, 0, 0, 0] leaves the joint as it is"
            )
        if abs(length - 1.0) > ROUNDING:  # what has been normalised once stays as it is
            found[at : at + 4] /= length
    return found


def with_quaternions(q: Array, types: Sequence[str]) -> Array:
    """Return positions (..., nq) with a quaternion, w ≥ 0 up to half a turn, for each rotation vector of q (..., n)."""
    if not (first := balls(types)):
        return q
    parts, done = [], 0
    for j in first:
        theta = q[..., j : j + 3]
        half = 0.5 * np.sqrt(np.sum(theta * theta, axis=-1, keepdims=True))
        # sin(x)/x is 1 to rounding below 1e-8
        part = 0.5 * np.where(half > 1e-8, np.sin(half) / np.where(half > 1e-8, half, 1.0), 1.0) * theta
        parts += [q[..., done:j], np.cos(half), part]
        done = j + 3
    return np.concatenate([*parts, q[..., done:]], axis=-1)


def with_rotation_vectors(q: Array, types: Sequence[str]) -> Array:
    """Return positions (..., n) with a rotation vector, of at most half a turn, for each unit quaternion of q."""
    if not (first := quaternions(types)):
        return q
    parts, done = [], 0
    for at in first:
        w, x = q[..., at : at + 1], q[..., at + 1 : at + 4]
        sine = np.sqrt(np.sum(x * x, axis=-1, keepdims=True))
        turn = 2.0 * np.arctan2(sine, np.abs(w)) * np.where(w < 0.0, -1.0, 1.0)
        turned = sine > 1e-8  # else w is ±1
        share = np.where(turned, turn / np.where(turned, sine, 1.0), 2.0 / np.where(turned, 1.0, w))
        parts += [q[..., done:at], share * x]
        done = at + 4
    return np.concatenate([*parts, q[..., done:]], axis=-1)


def continuous(q: Array, types: Sequence[str], start: ArrayLike) -> Array:
    """Return rows of positions (N, nq) with the sign of each quaternion that of the row before it, q and −q being one.

    That of the first row is as in `start` (nq,).
    """
    if not (first := quaternions(types)) or not len(q):
        return q
    found, begins = q.copy(), np.asarray(start, dtype=np.float64)
    for at in first:
        part = found[:, at : at + 4]
        before = np.vstack([begins[at : at + 4], part[:-1]])
        part *= np.cumprod(np.where(np.sum(part * before, axis=1) < 0.0, -1.0, 1.0))[:, None]
    return found


def in_pinocchios_order(q: Array, types: Sequence[str]) -> Array:
    """Return positions (..., nq) with quaternions x, y, z, w, as Pinocchio has them, instead of w, x, y, z."""
    if not (first := quaternions(types)):
        return q
    order = np.arange(q.shape[-1])
    for at in first:
        order[at : at + 4] = [at + 1, at + 2, at + 3, at]
    return np.ascontiguousarray(q[..., order])


def free_joints(model: "pin.Model") -> list[str]:
    """Return the names of the joints of six velocities."""
    return [model.names[j] for j in range(1, model.njoints) if model.nvs[j] == 6]


def separated(model: "pin.Model", joints: Collection[str], sliding: bool = True) -> "pin.Model":
    """Return the same mechanism with these free joints taken apart; without `sliding` their place is held.

    Pinocchio has the velocity of a free joint's origin in the body's axes. The sliding joints have it in the axes of
    the joint's frame, in which a body that is thrown keeps it.
    """
    import pinocchio as pin

    if not joints:
        return model
    out = pin.Model()
    out.name = model.name
    out.gravity = model.gravity
    moved, still = [0], pin.SE3.Identity()
    armature: list[float] = []
    for j in range(1, model.njoints):
        name, joint, parent, place = model.names[j], model.joints[j], moved[model.parents[j]], model.jointPlacements[j]
        q, v = slice(joint.idx_q, joint.idx_q + joint.nq), slice(joint.idx_v, joint.idx_v + joint.nv)
        effort, speed = model.effortLimit[v], model.velocityLimit[v]
        low, high = model.lowerPositionLimit[q], model.upperPositionLimit[q]
        turning = model.armature[v]
        if name in joints:
            sliders = (pin.JointModelPX(), pin.JointModelPY(), pin.JointModelPZ()) if sliding else ()
            for k, slider in enumerate(sliders):
                limits = effort[k : k + 1], speed[k : k + 1], np.array([-np.inf]), np.array([np.inf])
                parent = out.addJoint(parent, slider, place, name + PLACES[k], *limits)
                place = still
            turning = turning if sliding else turning[3:]
            joint, effort, speed, low, high = pin.JointModelSpherical(), effort[3:], speed[3:], low[3:], high[3:]
        moved.append(out.addJoint(parent, joint, place, name, effort, speed, low, high))
        out.appendBodyToJoint(moved[-1], model.inertias[j], still)
        armature += list(turning)
    out.armature = np.array(armature)
    frames = [0]
    for index, frame in enumerate(list(model.frames)[1:], start=1):
        above = frame.parentFrame
        if above == index:  # so Pinocchio leaves the frame of a joint that was locked
            above = model.getFrameId(model.names[frame.parentJoint]) if frame.parentJoint else 0
        apart = frame.type == pin.FrameType.JOINT and frame.name in joints  # its link may have the same name
        name, carrier = f"{frame.name} joint" if apart else frame.name, moved[frame.parentJoint]
        copy = pin.Frame(name, carrier, frames[above], frame.placement, frame.type, frame.inertia)
        frames.append(out.addFrame(copy, False))
    return out
