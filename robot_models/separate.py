"""Free joints of a Pinocchio model as three sliding joints and a ball joint, see `robot_models.coordinates`."""

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np

from robot_models.coordinates import PLACES

if TYPE_CHECKING:
    import pinocchio as pin


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
