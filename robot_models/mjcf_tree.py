"""Pinocchio's model of a compiled MJCF, joint by joint.

Bodies that are fixed to each other share a joint's link, and each keeps its frame. Several joints of one body follow
each other, with nothing between them. A hinge's position is MuJoCo's: at its `ref` the body is as it is written.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_models.mechanism import Array
from robot_models.mjcf import JOINTS, Names
from robot_models.mjcf_coupling import rotation
from robot_models.physics import check_size

if TYPE_CHECKING:
    import pinocchio as pin


def pinocchio_model(model: Any, locked: Mapping[str, float], where: str) -> "pin.Model":
    """Return Pinocchio's model of a compiled plain text, with some joints held where they are said to be.

    Its velocities are in the order of MuJoCo's; the armature is the text's.

    Raises `ModelError` if a number is so large that products of it might be none; `where` names the text.
    """
    import pinocchio as pin

    names, out = Names(model), pin.Model()
    out.gravity.linear = np.array(model.opt.gravity)
    frames = {*names.body, *names.site}
    armature: list[float] = []
    bodies: dict[int, tuple[int, pin.SE3, int]] = {0: (0, pin.SE3.Identity(), 0)}  # joint, place in it, frame

    def add_frame(name: str, joint: int, place: "pin.SE3", above: int, kind: "pin.FrameType") -> int:
        return int(out.addFrame(pin.Frame(name, joint, above, place, kind), False))

    for b in range(model.nbody):
        if b:
            at_body = f"{where}: body {names.body[b]!r}"
            check_size("origin", model.body_pos[b], at_body)
            check_size("mass", model.body_mass[b], at_body)
            check_size("centre of mass", model.body_ipos[b], at_body)
            check_size("inertia tensor", model.body_inertia[b], at_body)
            joint, place, above = bodies[int(model.body_parentid[b])]
            place = place * _pose(model.body_pos[b], model.body_quat[b])
            first = int(model.body_jntadr[b])
            for j in range(first, first + int(model.body_jntnum[b])):
                name, kind = names.joint[j], JOINTS[model.jnt_type[j]]
                at = pin.SE3(np.eye(3), np.array(model.jnt_pos[j]))
                if kind in ("free", "ball") and name in locked:
                    continue
                if kind in ("slide", "hinge"):
                    ref = float(model.qpos0[model.jnt_qposadr[j]])
                    if name in locked:
                        place = place * at * _moved(kind, model.jnt_axis[j], locked[name] - ref) * at.inverse()
                        continue
                    at = at * _moved(kind, model.jnt_axis[j], -ref) if ref else at
                what, start = _joint(kind, np.array(model.jnt_axis[j])), pin.SE3.Identity()
                if kind != "free":
                    start, back = place * at, pin.SE3(np.eye(3), -np.array(model.jnt_pos[j]))
                joint = int(out.addJoint(joint, what, start, name, *_limits(model, j, kind)))
                place = pin.SE3.Identity() if kind == "free" else back
                v = int(model.jnt_dofadr[j])
                check_size("armature", model.dof_armature[v], f"{where}: joint {name!r}")
                armature += [float(x) for x in model.dof_armature[v : v + out.nvs[joint]]]
                shown = name if name not in frames else f"{name} joint"
                above = add_frame(shown, joint, pin.SE3.Identity(), above, pin.FrameType.JOINT)
            if model.body_mass[b] > 0.0:
                turn = rotation(model.body_iquat[b])
                tensor = turn @ np.diag(model.body_inertia[b]) @ turn.T
                inertia = pin.Inertia(float(model.body_mass[b]), np.array(model.body_ipos[b]), tensor)
                out.appendBodyToJoint(joint, inertia, place)
            bodies[b] = joint, place, add_frame(names.body[b], joint, place, above, pin.FrameType.BODY)
        joint, place, above = bodies[b]
        for s in np.flatnonzero(model.site_bodyid == b):
            there = place * _pose(model.site_pos[s], model.site_quat[s])
            add_frame(names.site[s], joint, there, above, pin.FrameType.OP_FRAME)
    out.armature = np.array(armature)
    return out


def _pose(position: Array, quaternion: Array) -> "pin.SE3":
    import pinocchio as pin

    return pin.SE3(rotation(quaternion), np.array(position))


def _moved(kind: str, axis: Array, value: float) -> "pin.SE3":
    """Return the motion of a joint by a value, rad (m), in axes that the joint does not turn."""
    import pinocchio as pin

    if kind == "slide":
        return pin.SE3(np.eye(3), value * np.array(axis))
    return pin.SE3(pin.AngleAxis(value, np.array(axis)).toRotationMatrix(), np.zeros(3))


def _joint(kind: str, axis: Array) -> Any:
    """Return Pinocchio's joint of a kind; about or along an axis of its frame it is one that need not be told it."""
    import pinocchio as pin

    if kind == "free":
        return pin.JointModelFreeFlyer()
    if kind == "ball":
        return pin.JointModelSpherical()
    for k, plain in enumerate("XYZ"):
        if np.array_equal(axis, np.eye(3)[k]):
            return getattr(pin, f"JointModel{'P' if kind == 'slide' else 'R'}{plain}")()
    return pin.JointModelPrismaticUnaligned(axis) if kind == "slide" else pin.JointModelRevoluteUnaligned(axis)


def _limits(model: Any, j: int, kind: str) -> tuple[Array, Array, Array, Array]:
    """Return effort, velocity, lower and upper limit of a joint as Pinocchio has them; infinite where there is none."""
    n, m = {"free": (6, 7), "ball": (3, 4)}.get(kind, (1, 1))
    effort, low, high = np.full(n, np.inf), np.full(m, -np.inf), np.full(m, np.inf)
    if n == 1:
        if model.jnt_limited[j]:
            low[0], high[0] = model.jnt_range[j]
        if model.jnt_actfrclimited[j]:
            effort[0] = model.jnt_actfrcrange[j][1]
    return effort, np.full(n, np.inf), low, high
