"""A robot model as the arrays of `Tree`, with frames and inertial parameters that minimise the kernels' work.

Links get new frames: z is the joint axis, and x is perpendicular to it and to the axis of the next joint on the link,
so that one joint's frame follows from the other's by one twist and one angle. Origins are the model's.

Inertial parameters are regrouped towards the base (M. Gautier and W. Khalil, IEEE Trans. Robotics and Automation 6,
1990): mass on a revolute joint's axis is not moved by the joint, so a link's mass, its first moment and its second
moment along the axis are added to the parent; a prismatic joint does not rotate its link, so all second moments about
the centre of mass are added to the parent, and with the origin there the link is a point mass. H, C and the energy are
unchanged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.layout import CONSTANTS, HEAD, LANES, SCRATCHES, Tree
from robot_models import RobotModel

# What turns x, y, z into y, z, x: columns.
_ONWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


def tree_of(model: RobotModel, tip: str) -> Tree:
    """Return the arrays of a robot with a tip.

    Parameters
    ----------
    model : RobotModel
        From `robot_models.load`; it is Pinocchio's model of it that is read, so both engines simulate one robot.
    tip : str
        Frame whose origin touches the surface.

    Raises
    ------
    ModelError
        If the robot has no such frame, or a joint that is not revolute, continuous, prismatic or a ball joint.
    """
    pin: Any = model.pinocchio_model()
    frame = pin.frames[pin.getFrameId(model.require_frame(tip))]
    n = pin.nv
    kinds, axes, parents = np.zeros(n, dtype=np.int64), np.zeros((n, 3)), np.zeros(n, dtype=np.int64)
    placed: list[Any] = []  # where each stands in what carries it
    for joint in range(1, pin.njoints):
        for i in range(pin.idx_vs[joint], pin.idx_vs[joint] + pin.nvs[joint]):
            kinds[i], axes[i] = _joint(model, pin, joint, i)
            first = i == pin.idx_vs[joint]
            parents[i] = last_velocity(pin, int(pin.parents[joint])) if first else i - 1
            placed.append(pin.jointPlacements[joint] if first else None)
    rotations = [np.eye(3) if place is None else np.array(place.rotation) for place in placed]
    bases = [_link_axes(i, axes, parents, rotations) for i in range(n)]
    for i in np.flatnonzero(kinds == at.BALL).tolist():
        bases[i], bases[i + 1] = _ONWARD, _ONWARD @ _ONWARD
    # Each joint in its parent's frame at q = 0, and each link's mass; entry −1 is the base.
    places = np.zeros((n, 4, 4))
    masses = np.zeros((n + 1, 4, 4))
    for i in range(n):
        place = placed[i]
        if place is None:  # the axes of a ball joint are where its first one is
            continue
        # The axes of a ball joint's link are those of the joint, but for an angle about the third
        own = np.eye(3) if kinds[i] == at.BALL else bases[i]
        place = _transform(rotations[i] @ own, np.array(place.translation))
        turn = bases[parents[i]].T if parents[i] >= 0 else np.eye(3)
        places[i] = _transform(turn, np.zeros(3)) @ place
    for joint in range(1, pin.njoints):
        i = last_velocity(pin, joint)
        back = _transform(bases[i].T, np.zeros(3))
        masses[i] = back @ _second_moments(pin.inertias[joint]) @ back.T
    carrier = last_velocity(pin, frame.parentJoint)
    offset = np.array(frame.placement.translation)
    if carrier >= 0:
        offset = bases[carrier].T @ offset
    carried = _move_to_base(places, masses, parents, kinds, carrier, offset)
    run, support = _chains(parents, carrier)
    ends = group_ends(parents)
    block, lane = np.divmod(np.arange(n), LANES)
    links = np.stack([parents, HEAD + block * CONSTANTS + lane, block * SCRATCHES + lane, kinds, support, run, ends])
    blocks = int(block[-1]) + 1
    constants = np.concatenate([np.zeros(HEAD + blocks * CONSTANTS), model.springs.ravel()])
    constants[at.GRAVITY : at.GRAVITY + 3] = pin.gravity.linear
    constants[at.TIP : at.TIP + 3] = offset
    constants[at.RESTING : at.RESTING + 3] = masses[-1, :3, 3]
    for i in range(n):
        aligned = bool(parents[i] == i - 1)
        if kinds[i] < at.BALL:
            rows = _rows(places[i], masses[i], parents[i], aligned)
        else:
            rows = _ball_rows(i, kinds, places, masses, bases)
        rows |= {at.KIND: float(kinds[i] != at.SLIDES), at.CARRIED: carried[i], at.ARMATURE: pin.armature[i]}
        for row, value in rows.items():
            constants[links[at.CONSTANT, i] + row] = value
    serial = int(np.all(parents == np.arange(n) - 1))
    balls = int(np.count_nonzero(kinds == at.BALL))
    return Tree(n, blocks, 1, int(carrier), serial, links.astype(np.int64).ravel(), constants, balls)


def last_velocity(pin: Any, joint: int) -> int:
    """Return the last velocity of a joint of Pinocchio's model, which its link has as its index; −1 for the base."""
    return int(pin.idx_vs[joint] + pin.nvs[joint] - 1) if joint > 0 else -1


def _chains(parents: NDArray[Any], carrier: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the first joint of the unbranched chain of each (n,), and which joints are between base and tip (n,)."""
    n = len(parents)
    run = np.arange(n)
    for i in range(1, n):
        run[i] = run[i - 1] if parents[i] == i - 1 else i
    support = np.zeros(n, dtype=bool)
    joint = carrier
    while joint >= 0:
        support[joint] = True
        joint = parents[joint]
    return run, support


def group_ends(parents: NDArray[Any]) -> NDArray[np.int64]:
    """Return for each joint (n,) one more than the last joint of its group.

    No joint of a group moves what a joint of another moves: H is block-diagonal, a block for each group. The joints of
    a group are consecutive.
    """
    n, ends, first = len(parents), np.zeros(len(parents), dtype=np.int64), np.zeros(len(parents), dtype=int)
    for i in range(n):
        first[i] = i if parents[i] < 0 else first[parents[i]]
    end = begins = n
    for i in range(n - 1, -1, -1):
        ends[i], begins = end, min(begins, first[i])
        if begins == i:
            end = begins = i
    return ends


def _joint(model: RobotModel, pin: Any, number: int, i: int) -> tuple[int, Array]:
    """Return what velocity i of a joint is, and its axis, a unit vector in the joint's frame."""
    joint = pin.joints[number]
    kind = joint.shortname().removeprefix("JointModel")
    if kind == "Spherical":
        return (at.BALL if i == joint.idx_v else at.BALL_AXIS), np.eye(3)[i - joint.idx_v]
    if kind in ("RevoluteUnaligned", "PrismaticUnaligned"):
        axis = np.array(joint.extract().axis, dtype=np.float64)
        return (at.TURNS if kind == "RevoluteUnaligned" else at.SLIDES), axis / np.linalg.norm(axis)
    if len(kind) == 2 and kind[0] in "RP" and kind[1] in _AXES:
        return (at.TURNS if kind[0] == "R" else at.SLIDES), np.array(_AXES[kind[1]])
    raise ModelError(
        f"{model.name}: joint {pin.names[number]!r} is of Pinocchio's kind {kind}: "
        "only revolute, continuous, prismatic, ball and free joints are simulated"
    )


def _link_axes(i: int, axes: Array, parents: Array, rotations: list[Array]) -> Array:
    """Return the axes of link i as the columns of a matrix in the joint's own frame."""
    z = axes[i]
    x = np.zeros(3)
    if i + 1 < len(axes) and parents[i + 1] == i:
        x = _cross(z, rotations[i + 1] @ axes[i + 1])
    if np.linalg.norm(x) < 1e-14:  # the next axis is the same, or there is none: any x will do
        x = np.eye(3)[np.argmin(np.abs(z))]
    for _ in range(2):  # once is not enough where the axes are nearly parallel and x is mostly rounding
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
    return np.array([x, _cross(z, x), z]).T.copy()


def _cross(a: Array, b: Array) -> Array:
    """Return a × b, as `numpy.cross` in a tenth of its time."""
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


def _move_to_base(places: Array, masses: Array, parents: Array, kinds: Array, carrier: int, offset: Array) -> Array:
    """Move inertia towards the base, in place, and return the mass (n,) that each joint then carries."""
    n = len(places)
    carried = np.zeros(n + 1)
    for i in range(n - 1, -1, -1):
        place, moved = places[i], np.zeros((4, 4))
        if kinds[i] >= at.BALL:
            pass  # only its mass is not moved by it
        elif kinds[i] == at.TURNS:
            moved[2:, 2:] = masses[i, 2:, 2:]
            masses[i] -= moved
        else:
            mass = masses[i, 3, 3]
            centre = masses[i, :3, 3] / mass if mass > 0.0 else np.zeros(3)
            moved[:3, :3] = masses[i, :3, :3] - mass * np.outer(centre, centre)
            masses[i] = 0.0
            masses[i, 3, 3] = mass
            place[:3, 3] += place[:3, :3] @ centre
            places[np.flatnonzero(parents == i), :3, 3] -= centre
            if carrier == i:
                offset -= centre
        # What is moved from a prismatic joint has no mass, so it goes without the joint's place.
        masses[parents[i]] += place @ moved @ place.T
        carried[i] += masses[i, 3, 3]
        carried[parents[i]] += carried[i]
    return carried[:-1]


def _rows(place: Array, mass: Array, parent: int, aligned: bool) -> dict[int, float]:
    """Return the constants of one joint by row."""
    names = (at.R00, at.R01, at.R02, at.R10, at.R11, at.R12, at.R20, at.R21, at.R22)
    R = place[:3, :3]
    rows = dict(zip((at.T0, at.T1, at.T2), place[:3, 3], strict=True))
    if parent < 0:
        rows |= dict(zip(names, R.ravel(), strict=True))
    else:
        # R = R_z(turn) R_x(twist) R_z(angle); the parent's x was chosen such that an aligned joint has no turn
        turn = 0.0 if aligned or np.hypot(R[0, 2], R[1, 2]) < 1e-14 else np.arctan2(R[0, 2], -R[1, 2])
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
        sine, cosine = -R[1, 2], R[2, 2]
        length = np.hypot(sine, cosine)
        rows |= {at.COS_TURN: c, at.SIN_TURN: s, at.COS_TWIST: cosine / length, at.SIN_TWIST: sine / length}
        rows[at.ANGLE] = np.arctan2(-R[0, 1], R[0, 0])
    return rows | _inertia_rows(mass)


def _inertia_rows(mass: Array) -> dict[int, float]:
    """Return the constants of a link's inertia by row."""
    rows = {at.HALF_XX: mass[0, 0] / 2, at.XY: mass[0, 1], at.XZ: mass[0, 2], at.HALF_YY: mass[1, 1] / 2}
    return rows | {at.YZ: mass[1, 2], at.HX: mass[0, 3], at.HY: mass[1, 3], at.MASS: mass[3, 3]}


def _ball_rows(i: int, kinds: Array, places: Array, masses: Array, bases: list[Array]) -> dict[int, float]:
    """Return the constants of one of the three entries of a ball joint by row; see `layout.BALL`."""
    if kinds[i] == at.BALL:
        place, mass = places[i], masses[i + 2]
        names = (at.R00, at.R01, at.R02, at.R10, at.R11, at.R12, at.R20, at.R21, at.R22)
        rows = dict(zip(names, place[:3, :3].ravel(), strict=True))
        rows |= dict(zip((at.T0, at.T1, at.T2), place[:3, 3], strict=True))
        return rows | {at.HY: mass[2, 3], at.HALF_YY: mass[2, 2] / 2}
    angle = np.arctan2(bases[i][1, 0], bases[i][0, 0]) if kinds[i - 1] == at.BALL_AXIS else 0.0
    return _inertia_rows(masses[i]) | {at.ANGLE: angle}


def _transform(R: Array, p: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _second_moments(inertia: Any) -> Array:
    """Return ∫ [s; 1][s; 1]ᵀ dm (4, 4) of a Pinocchio inertia, with s from the frame's origin."""
    mass, centre, tensor = inertia.mass, np.array(inertia.lever), np.array(inertia.inertia)
    moments = np.zeros((4, 4))
    moments[:3, :3] = np.trace(tensor) / 2 * np.eye(3) - tensor + mass * np.outer(centre, centre)
    moments[:3, 3] = moments[3, :3] = mass * centre
    moments[3, 3] = mass
    return moments
