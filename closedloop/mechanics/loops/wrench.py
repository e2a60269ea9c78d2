"""Reactions of loop joints as wrenches in axes that a user can name, from the forces of their rows.

Of every kind between two frames: on the first side, in the axes of the second frame, about the joint's point on the
second side. The rows have axes of their own (`closedloop.mechanics.loops.bind`), which nothing outside needs to know.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.loops.bind import rotation_axes, side_axes
from closedloop.mechanics.robot.pinocchio import Robot
from robot_models import RobotModel
from robot_models.loop_joint import BINDS, LoopJoint
from robot_models.loop_posture import new_side

FORCES = tuple((f"force along {axis}", "N") for axis in "xyz")
COUPLES = tuple((f"couple about {axis}", "N m") for axis in "xyz")
PUSH = ("push between its points", "N")


def parts_of(model: RobotModel, loop: LoopJoint) -> tuple[tuple[str, str], ...]:
    """Return name and unit of each part of a loop joint's reaction."""
    if loop.type == "gear":
        types = dict(zip(model.joint_names, model.joint_types, strict=True))
        kinds = {"prismatic": ("force on", "N")}
        parts = [(name, *kinds.get(types[name], ("torque on", "N m"))) for name in loop.joints]
        return tuple((f"{what} {name}", unit) for name, what, unit in parts)
    if loop.type == "distance":
        return (*FORCES, PUSH)
    return FORCES if loop.type == "point" else FORCES + COUPLES


def labels_of(model: RobotModel) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what each part of the reactions of a mechanism is called, such as "coupler: force along x"; their units.

    No name and unit depend on a state, so what is to be shown is known before it is worked out.
    """
    parts = [(f"{loop.name}: {what}", unit) for loop in model.loops for what, unit in parts_of(model, loop)]
    return tuple(label for label, _ in parts), tuple(unit for _, unit in parts)


def named_side(robot: Robot, loop: LoopJoint) -> tuple[str, Array]:
    """Return the second frame of a loop joint as the user named it, and the joint's point there (3,), m.

    A joint with friction, a drive or stops may be welded to a new link, which hangs on the link that was named.
    """
    if loop.coordinates and new_side(loop) == 1:
        return robot.link_below(loop.coordinates[0])
    return loop.frames[1], np.array(loop.points[1])


def wrenches(robot: Robot, q: Array, rows: Array, forces: Array) -> Array:
    """Return the parts of the reactions (N, c), in the order of `labels_of`, N or N m.

    Parameters
    ----------
    robot : Robot
        With loops.
    q : (N, nq) array
    rows : (N, m, n) array
        G, see `closedloop.mechanics.loops.reactions.loop_rows`.
    forces : (N, m) array
        Of the rows, on the first side.
    """
    found, at = [], 0
    between = [loop for loop in robot.model.loops if loop.type != "gear"]
    poses = robot.poses_of({n for loop in between for n in (*loop.frames, named_side(robot, loop)[0])}, q)
    for loop in robot.model.loops:
        own = slice(at, at + loop.rows)
        at = own.stop
        if loop.type == "gear":
            joints = [robot.joint_names.index(name) for name in loop.joints]
            found.append(forces[:, own] * rows[:, own.start][:, joints])
        else:
            found.append(_wrench(robot, loop, poses, forces[:, own]))
    return np.concatenate(found, axis=1) if found else np.zeros((len(q), 0))


def _wrench(robot: Robot, loop: LoopJoint, poses: Mapping[str, tuple[Array, Array]], forces: Array) -> Array:
    """Return the parts of the reaction (N, c) of a joint between two frames, from the forces of its rows (N, k)."""
    (first, one), (second, other) = (poses[name] for name in loop.frames)
    a = one + first @ np.array(loop.points[0])
    if loop.type == "distance":
        apart = a - other - second @ np.array(loop.points[1])
        force = forces * apart / np.linalg.norm(apart, axis=1, keepdims=True)
        return np.concatenate([_turned(second, force), forces], axis=1)
    positions, rotations = BINDS[loop.type]
    force = np.einsum("kij,jr,kr->ki", second, side_axes(loop, 1)[:, list(positions)], forces[:, : len(positions)])
    couple = np.zeros_like(force)
    for k, pair in enumerate(rotations, len(positions)):
        u, w = rotation_axes(loop, pair)
        couple += forces[:, [k]] * np.cross(first @ u, second @ w)
    name, point = named_side(robot, loop)
    named, other = poses[name]
    couple += np.cross(a - other - named @ point, force)  # the force of the rows acts at the point of the first side
    parts = [force] if loop.type == "point" else [force, couple]
    return np.concatenate([_turned(named, part) for part in parts], axis=1)


def _turned(axes: Array, vector: Array) -> Array:
    """Return vectors (N, 3) of base axes in other axes (N, 3, 3), columns."""
    return np.einsum("kij,ki->kj", axes, vector)
