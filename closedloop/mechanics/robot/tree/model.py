"""A robot model as the arrays of `Tree`, with frames and inertial parameters that minimise the kernels' work.

Links get new frames: z is the joint axis, and x is perpendicular to it and to the axis of the next joint on the link,
so that one joint's frame follows from the other's by one twist and one angle. Origins are the model's.

Inertial parameters are regrouped towards the base (M. Gautier and W. Khalil, IEEE Trans. Robotics and Automation 6,
1990): mass on a revolute joint's axis is not moved by the joint, so a link's mass, its first moment and its second
moment along the axis are added to the parent; a prismatic joint does not rotate its link, so all second moments about
the centre of mass are added to the parent, and with the origin there the link is a point mass. H, C and the energy are
unchanged.
"""

from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.base.errors import ModelError
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.layout import CONSTANTS, HEAD, LANES, SCRATCHES, Tree
from robot_models import RobotModel

# What turns x, y, z into y, z, x: columns.
_ONWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


def tree_of(model: RobotModel, tip: str, built: Any = None) -> Tree:
    """Return the arrays of a robot with a tip.

    `model`: from `robot_models.load`; it is Pinocchio's model of it that is read, so both engines simulate one robot.
    `tip`: frame whose origin touches the surface.
    `built`: what the model's `pinocchio_model` returns, if it is there.
    Raises ModelError if the robot has no such frame, or a joint that is not revolute, continuous, prismatic or a ball
        joint.
    """
    pin: Any = model.pinocchio_model() if built is None else built
    frame = pin.frames[pin.getFrameId(model.require_frame(tip))]
    if "fixed" not in model.known:
        model.known["fixed"] = _fixed(tuple(_placed(model, pin, joint) for joint in range(1, pin.njoints)))
    fixed: _Fixed = model.known["fixed"]
    kinds, parents = fixed.kinds, fixed.parents
    n, places, masses = len(parents), fixed.places.copy(), np.zeros((len(parents) + 1, 4, 4))  # entry −1 is the base
    for last, moments in zip(fixed.lasts, _moments(model, pin, fixed.backs), strict=True):
        masses[last] = moments
    carrier = last_velocity(pin, frame.parentJoint)
    offset = np.array(frame.placement.translation)
    if carrier >= 0:
        offset = fixed.bases[carrier].T @ offset
    carried = _move_to_base(places, masses, parents, kinds, carrier, offset)
    links = fixed.links.copy()
    links[at.SUPPORT] = _support(parents, carrier)
    constants = np.concatenate([fixed.constants, model.springs.ravel()])
    constants[at.GRAVITY : at.GRAVITY + 3] = pin.gravity.linear
    constants[at.TIP : at.TIP + 3] = offset
    constants[at.RESTING : at.RESTING + 3] = masses[-1, :3, 3]
    begins = links[at.CONSTANT]
    constants[begins[:, None] + (at.T0, at.T1, at.T2)] = places[:, :3, 3]
    constants[begins[:, None] + _INERTIA] = masses[:-1, _ROW, _COLUMN] * _SHARE
    constants[begins + at.CARRIED], constants[begins + at.ARMATURE] = carried, pin.armature
    for i in np.flatnonzero(kinds == at.BALL).tolist():  # its first entry has what the last has no row for
        constants[begins[i] + at.HY], constants[begins[i] + at.HALF_YY] = masses[i + 2, 2, 3], masses[i + 2, 2, 2] / 2
    serial = int(np.all(parents == np.arange(n) - 1))
    balls = int(np.count_nonzero(kinds == at.BALL))
    return Tree(n, fixed.blocks, 1, int(carrier), serial, links.ravel(), constants, balls)


class _Fixed(NamedTuple):
    """What of a tree depends neither on its masses nor on its tip."""

    # (n,), see `Tree.links`
    kinds: IntArray
    parents: IntArray
    lasts: IntArray  # (j,) the last velocity of each joint, whose link has the mass
    bases: list[Array]  # the axes of each link as the columns of a matrix in the joint's own frame
    backs: Array  # (j, 4, 4) from a joint's frame to the axes of its link
    places: Array  # (n, 4, 4) each joint in its parent's frame at q = 0
    blocks: int
    links: IntArray  # (LINK_ROWS, n)
    constants: Array  # but for the springs


def _placed(model: RobotModel, pin: Any, joint: int) -> tuple[Any, ...]:
    """Return what each velocity of a joint is and its axis, what carries the joint, and its place there, as bytes."""
    first = pin.idx_vs[joint]
    each = tuple(_joint(model, pin, joint, i) for i in range(first, first + pin.nvs[joint]))
    return each, last_velocity(pin, int(pin.parents[joint])), pin.jointPlacements[joint].homogeneous.tobytes("F")


def _fixed(joints: tuple[tuple[Any, ...], ...]) -> _Fixed:
    """Return what depends on the joints alone, each as `_placed` returns it."""
    kinds = np.array([kind for each, _, _ in joints for kind, _ in each], dtype=np.int64)
    axes = np.array([axis for each, _, _ in joints for _, axis in each])
    n, lasts = len(kinds), np.cumsum([len(each) for each, _, _ in joints]) - 1
    parents, placed = np.arange(-1, n - 1, dtype=np.int64), np.tile(np.eye(4), (n, 1, 1))
    for last, (each, parent, place) in zip(lasts, joints, strict=True):
        first = last - len(each) + 1
        parents[first], placed[first] = parent, np.frombuffer(place).reshape(4, 4, order="F")
    rotations = [np.asfortranarray(place[:3, :3]) for place in placed]
    bases = [_link_axes(i, axes, parents, rotations) for i in range(n)]
    for i in np.flatnonzero(kinds == at.BALL).tolist():
        bases[i], bases[i + 1] = _ONWARD, _ONWARD @ _ONWARD
    places, (block, lane) = np.zeros((n, 4, 4)), np.divmod(np.arange(n), LANES)
    begins = HEAD + block * CONSTANTS + lane
    run, ends = _chains(parents), group_ends(parents)
    links = np.stack([parents, begins, block * SCRATCHES + lane, kinds, 0 * run, run, ends]).astype(np.int64)
    blocks = int(block[-1]) + 1
    constants = np.zeros(HEAD + blocks * CONSTANTS)
    for i in range(n):
        if kinds[i] != at.BALL_AXIS:  # those of a ball joint are where its first one is
            # The axes of a ball joint's link are those of the joint, but for an angle about the third
            own = np.eye(3) if kinds[i] == at.BALL else bases[i]
            turn = bases[parents[i]].T if parents[i] >= 0 else np.eye(3)
            place = _transform(rotations[i] @ own, placed[i, :3, 3])
            places[i] = _transform(turn, np.zeros(3)) @ place
        rows = _rows(i, kinds, places[i], parents[i], bases) | {at.KIND: float(kinds[i] != at.SLIDES)}
        constants[begins[i] + np.array(list(rows))] = list(rows.values())
    backs = np.array([_transform(bases[last].T, np.zeros(3)) for last in lasts])
    return _Fixed(kinds, parents, lasts, bases, backs, places, blocks, links, constants)


def last_velocity(pin: Any, joint: int) -> int:
    """Return the last velocity of a joint of Pinocchio's model, which its link has as its index; −1 for the base."""
    return int(pin.idx_vs[joint] + pin.nvs[joint] - 1) if joint > 0 else -1


def _chains(parents: IntArray) -> IntArray:
    """Return the first joint of the unbranched chain of each (n,)."""
    run = np.arange(len(parents))
    for i in range(1, len(parents)):
        run[i] = run[i - 1] if parents[i] == i - 1 else i
    return run


def _support(parents: IntArray, carrier: int) -> IntArray:
    """Return which joints are between base and tip (n,), 1 or 0."""
    support = np.zeros(len(parents), dtype=np.int64)
    while carrier >= 0:
        support[carrier], carrier = 1, parents[carrier]
    return support


def group_ends(parents: IntArray) -> IntArray:
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


def _joint(model: RobotModel, pin: Any, number: int, i: int) -> tuple[int, tuple[float, ...]]:
    """Return what velocity i of a joint is, and its axis, a unit vector in the joint's frame."""
    joint = pin.joints[number]
    kind = joint.shortname().removeprefix("JointModel")
    if kind == "Spherical":
        return (at.BALL if i == joint.idx_v else at.BALL_AXIS), (_AXES["X"], _AXES["Y"], _AXES["Z"])[i - joint.idx_v]
    if kind in ("RevoluteUnaligned", "PrismaticUnaligned"):
        axis = np.array(joint.extract().axis, dtype=np.float64)
        return (at.TURNS if kind == "RevoluteUnaligned" else at.SLIDES), tuple((axis / np.linalg.norm(axis)).tolist())
    if len(kind) == 2 and kind[0] in "RP" and kind[1] in _AXES:
        return (at.TURNS if kind[0] == "R" else at.SLIDES), _AXES[kind[1]]
    raise ModelError(
        f"{model.name}: joint {pin.names[number]!r} is of Pinocchio's kind {kind}: "
        "only revolute, continuous, prismatic, ball and free joints are simulated"
    )


def _link_axes(i: int, axes: Array, parents: IntArray, rotations: list[Array]) -> Array:
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


def _move_to_base(
    places: Array, masses: Array, parents: IntArray, kinds: IntArray, carrier: int, offset: Array
) -> Array:
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


def _rows(i: int, kinds: IntArray, place: Array, parent: int, bases: list[Array]) -> dict[int, float]:
    """Return those constants of a joint by row that turn its axes; see `layout.BALL`."""
    R = place[:3, :3]
    if kinds[i] == at.BALL or (kinds[i] < at.BALL and parent < 0):
        names = (at.R00, at.R01, at.R02, at.R10, at.R11, at.R12, at.R20, at.R21, at.R22)
        return dict(zip(names, R.ravel(), strict=True))
    if kinds[i] == at.BALL_AXIS:
        return {at.ANGLE: np.arctan2(bases[i][1, 0], bases[i][0, 0]) if kinds[i - 1] == at.BALL_AXIS else 0.0}
    # R = R_z(turn) R_x(twist) R_z(angle); the parent's x was chosen such that an aligned joint has no turn
    turn = 0.0 if parent == i - 1 or np.hypot(R[0, 2], R[1, 2]) < 1e-14 else np.arctan2(R[0, 2], -R[1, 2])
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    sine, cosine = -R[1, 2], R[2, 2]
    length = np.hypot(sine, cosine)
    rows = {at.COS_TURN: c, at.SIN_TURN: s, at.COS_TWIST: cosine / length, at.SIN_TWIST: sine / length}
    return rows | {at.ANGLE: np.arctan2(-R[0, 1], R[0, 0])}


# The constants of a link's inertia: their rows, which entries of its moments they are, and what share of them.
_INERTIA = np.array([at.HALF_XX, at.XY, at.XZ, at.HALF_YY, at.YZ, at.HX, at.HY, at.MASS])
_ROW, _COLUMN = np.array([[0, 0, 0, 1, 1, 0, 1, 3], [0, 1, 2, 1, 2, 3, 3, 3]])
_SHARE = np.array([0.5, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 1.0])


def _moments(model: RobotModel, pin: Any, backs: Array) -> list[Array]:
    """Return the second moments (4, 4) of each joint's link in the axes of the tree, see `_Fixed.backs`.

    Those of links that carry no tool are worked out once.
    """
    loaded = {pin.frames[pin.getFrameId(tool.frame)].parentJoint for tool in model.tools}
    known, found = {} if model.whole else model.known.setdefault("moments", {}), []
    for joint, back in enumerate(backs, 1):
        moments = None if joint in loaded else known.get(joint)
        if moments is None:
            moments = back @ _second_moments(pin.inertias[joint]) @ back.T
        if joint not in loaded:
            known[joint] = moments
        found.append(moments)
    return found


def _transform(R: Array, p: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _second_moments(inertia: Any) -> Array:
    """Return ∫ [s; 1][s; 1]ᵀ dm (4, 4) of one of Pinocchio's inertias, with s from the frame's origin."""
    mass, centre, tensor = inertia.mass, inertia.lever, inertia.inertia
    moments = np.empty((4, 4))
    moments[:3, :3] = tensor.trace() / 2 * np.eye(3) - tensor + mass * np.outer(centre, centre)
    moments[:3, 3] = moments[3, :3] = mass * centre
    moments[3, 3] = mass
    return moments
