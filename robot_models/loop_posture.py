"""Where the coordinates of loop joints are, and whose mass their links have; see `robot_models.loop_coordinate`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from robot_models.loop_joint import LoopJoint
from robot_models.mechanism import Array

if TYPE_CHECKING:
    import pinocchio as pin


def links_of(loop: LoopJoint) -> tuple[str, str]:
    """Return the names of the new links of a loop joint: of that between two coordinates, and of the one welded."""
    return f"{loop.name} turned", f"{loop.name} side"


def new_side(loop: LoopJoint) -> int:
    """Return on which side of a loop joint with coordinates the welded one of its new links is, 0 or 1."""
    return int(loop.frames[1] == links_of(loop)[-1])


def place_coordinates(model: "pin.Model", loops: Sequence[LoopJoint], q: Array) -> Array:
    """Return joint positions (n,), rad (m), with the coordinates of loop joints as the rest of the posture has them.

    loops: those without coordinates are passed over
    q: (n,), what it says of the coordinates is not read
    """
    import pinocchio as pin

    placed, data = np.array(q, dtype=np.float64), model.createData()
    for loop in loops:
        joints = [model.idx_qs[model.getJointId(name)] for name in loop.coordinates if model.existJointName(name)]
        if not joints:
            continue
        placed[joints] = 0.0
        k = new_side(loop)
        new, other = loop.frames[k], loop.frames[1 - k]
        pin.framesForwardKinematics(model, data, placed)
        there = data.oMf[model.getFrameId(other)] * pin.SE3(np.eye(3), np.array(loop.points[1 - k]))
        moved = data.oMf[model.getFrameId(new)].actInv(there)
        for j, name in zip(joints, loop.coordinates, strict=False):
            joint = model.joints[model.getJointId(name)]
            motion = np.array(joint.createData().S).ravel()
            if motion[:3].any():
                placed[j] = motion[:3] @ moved.translation
            else:
                placed[j] = _angle(moved.rotation, motion[3:], model.lowerPositionLimit[j], model.upperPositionLimit[j])
    return placed


def coordinate_rates(model: "pin.Model", loops: Sequence[LoopJoint], q: Array, v: Array) -> Array:
    """Return joint velocities (n,), rad/s (m/s), with the rates of loop joints' coordinates as the rest has them.

    model, loops: as in `place_coordinates`
    q, v: (n,), a posture in which they are placed, and velocities; what those say of the coordinates is not read
    """
    import pinocchio as pin

    rates, data = np.array(v, dtype=np.float64), model.createData()
    joints = {name: model.joints[model.getJointId(name)] for loop in loops for name in loop.coordinates}
    rates[[joint.idx_v for joint in joints.values()]] = 0.0
    pin.forwardKinematics(model, data, q, rates)
    pin.updateFramePlacements(model, data)
    for loop in loops:
        if not loop.coordinates:
            continue
        k = new_side(loop)
        new, other = (model.getFrameId(loop.frames[i]) for i in (k, 1 - k))
        moving = [data.oMf[i].act(pin.getFrameVelocity(model, data, i, pin.LOCAL)) for i in (other, new)]
        apart = data.oMf[new].actInv(moving[0] - moving[1]).vector
        for name in loop.coordinates:
            rates[joints[name].idx_v] = np.array(joints[name].createData().S).ravel() @ apart
    return rates


def give_back(model: "pin.Model", loops: Sequence[LoopJoint]) -> None:
    """Give the mass that the links of coordinates share back to the links that they are welded to.

    The mass matrix is then singular. It is for the forces between the links: those of a weld are then those of the
    loop joint that it stands for.
    """
    import pinocchio as pin

    for loop in loops:
        if not loop.coordinates:
            continue
        k = new_side(loop)
        new = model.frames[model.getFrameId(loop.frames[k])]
        old = model.frames[model.getFrameId(loop.frames[1 - k])]
        place = old.placement * pin.SE3(np.eye(3), np.array(loop.points[1 - k])) * new.placement.inverse()
        model.inertias[old.parentJoint] += place.act(model.inertias[new.parentJoint])
        model.inertias[new.parentJoint] = pin.Inertia.Zero()


def stands_for(loops: Sequence[LoopJoint]) -> set[str]:
    """Return the names of the joints and links of a tree that stand for loop joints."""
    return {name for loop in loops if loop.coordinates for name in (*loop.coordinates, *links_of(loop))}


def _angle(rotation: Array, axis: Array, low: float, high: float) -> float:
    """Return the angle of a rotation (3, 3) about an axis, rad, within limits if a turn more or less is."""
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    angle = float(np.arctan2(np.cross(axis, x) @ rotation @ x, x @ rotation @ x))
    return next((a for a in (angle, angle + 2.0 * np.pi, angle - 2.0 * np.pi) if low <= a <= high), angle)
