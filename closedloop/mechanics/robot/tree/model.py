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

from closedloop.base.errors import ModelError
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.layout import CONSTANTS, HEAD, LANES, SCRATCHES, Array, Tree
from robot_models import RobotModel

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
        If the robot has no such frame, or a joint that is not revolute, continuous or prismatic.
    """
    pin: Any = model.pinocchio_model()
    frame = pin.frames[pin.getFrameId(model.require_frame(tip))]
    n = pin.nv
    revolute, axes = np.zeros(n, dtype=bool), np.zeros((n, 3))
    for i in range(n):
        revolute[i], axes[i] = _joint(model, pin, i)
    parents = np.array([pin.parents[i + 1] - 1 for i in range(n)])
    rotations = [np.array(pin.jointPlacements[i + 1].rotation) for i in range(n)]
    bases = [_link_axes(i, axes, parents, rotations) for i in range(n)]
    # Each joint in its parent's frame at q = 0, and each link's mass; entry −1 is the base.
    places = np.zeros((n, 4, 4))
    masses = np.zeros((n + 1, 4, 4))
    for i in range(n):
        place = _transform(rotations[i] @ bases[i], np.array(pin.jointPlacements[i + 1].translation))
        turn = bases[parents[i]].T if parents[i] >= 0 else np.eye(3)
        places[i] = _transform(turn, np.zeros(3)) @ place
        back = _transform(bases[i].T, np.zeros(3))
        masses[i] = back @ _second_moments(pin.inertias[i + 1]) @ back.T
    carrier = frame.parentJoint - 1
    offset = np.array(frame.placement.translation)
    if carrier >= 0:
        offset = bases[carrier].T @ offset
    carried = _move_to_base(places, masses, parents, revolute, carrier, offset)
    run, support = _chains(parents, carrier)
    block, lane = np.divmod(np.arange(n), LANES)
    links = np.stack([parents, HEAD + block * CONSTANTS + lane, block * SCRATCHES + lane, revolute, support, run])
    blocks = int(block[-1]) + 1
    constants = np.zeros(HEAD + blocks * CONSTANTS)
    constants[at.GRAVITY : at.GRAVITY + 3] = pin.gravity.linear
    constants[at.TIP : at.TIP + 3] = offset
    constants[at.RESTING : at.RESTING + 3] = masses[-1, :3, 3]
    for i in range(n):
        aligned = bool(parents[i] == i - 1)
        rows = _rows(places[i], masses[i], parents[i], aligned)
        rows |= {at.KIND: float(revolute[i]), at.CARRIED: carried[i], at.ARMATURE: pin.armature[i]}
        for row, value in rows.items():
            constants[links[at.CONSTANT, i] + row] = value
    serial = int(np.all(parents == np.arange(n) - 1))
    return Tree(n, blocks, 1, int(carrier), serial, links.astype(np.int64).ravel(), constants)


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


def _joint(model: RobotModel, pin: Any, i: int) -> tuple[bool, Array]:
    """Return whether joint i is revolute, and its axis, a unit vector in the joint's frame."""
    joint = pin.joints[i + 1]
    kind = joint.shortname().removeprefix("JointModel")
    if kind in ("RevoluteUnaligned", "PrismaticUnaligned"):
        axis = np.array(joint.extract().axis, dtype=np.float64)
        return kind == "RevoluteUnaligned", axis / np.linalg.norm(axis)
    if len(kind) == 2 and kind[0] in "RP" and kind[1] in _AXES:
        return kind[0] == "R", np.array(_AXES[kind[1]])
    raise ModelError(
        f"{model.name}: joint {pin.names[i + 1]!r} is of Pinocchio's kind {kind}: "
        "only revolute, continuous and prismatic joints are simulated"
    )


def _link_axes(i: int, axes: Array, parents: Array, rotations: list[Array]) -> Array:
    """Return the axes of link i as the columns of a matrix in the joint's own frame."""
    z = axes[i]
    x = np.zeros(3)
    if i + 1 < len(axes) and parents[i + 1] == i:
        x = np.cross(z, rotations[i + 1] @ axes[i + 1])
    if np.linalg.norm(x) < 1e-14:  # the next axis is the same, or there is none: any x will do
        x = np.eye(3)[np.argmin(np.abs(z))]
    for _ in range(2):  # once is not enough where the axes are nearly parallel and x is mostly rounding
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _move_to_base(places: Array, masses: Array, parents: Array, revolute: Array, carrier: int, offset: Array) -> Array:
    """Move inertia towards the base, in place, and return the mass (n,) that each joint then carries."""
    n = len(places)
    carried = np.zeros(n + 1)
    for i in range(n - 1, -1, -1):
        place, moved = places[i], np.zeros((4, 4))
        if revolute[i]:
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
    rows |= {at.HALF_XX: mass[0, 0] / 2, at.XY: mass[0, 1], at.XZ: mass[0, 2], at.HALF_YY: mass[1, 1] / 2}
    return rows | {at.YZ: mass[1, 2], at.HX: mass[0, 3], at.HY: mass[1, 3], at.MASS: mass[3, 3]}


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
