"""The robot as the oracle sees it: a kinematic tree of one-degree-of-freedom joints, as plain arrays.

A `Tree` is what is left of a robot when all rigidly connected links have been merged: one body a moving
joint, numbered so that a parent comes before its children (λ(i) < i), exactly the column order of the
Jacobians. `build_tree` makes it from links and joints as a robot description lists them.

From a URDF text to a `Tree`, with yourdfpy as the parser and nothing else of it.

yourdfpy is used because it shares no code with Pinocchio's parser. What it does silently, and what is done about it:

- a missing ``mass`` value becomes 0, a missing ``ixx``, ``iyy`` or ``izz`` becomes **1** kg m²: refused here;
- malformed XML is parsed a second time in a mode that forgives: refused here by a strict pass before it;
- an axis is handed over as written, neither normalised nor refused at zero length: `build_tree` does both;
- ``origin`` comes as a 4×4 matrix (absent: None), so the rpy convention is yourdfpy's: tested against
  `rotation_from_rpy`.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np

from validation.oracle.spatial import Array, inertia_to_base, skew, spatial_inertia

GROUND = -1
"""Index that stands for the base, which does not move."""

MOVING = ("revolute", "continuous", "prismatic")


class UnsupportedModel(ValueError):
    """The robot description holds something that the oracle does not compute; the text says what."""


@dataclass(frozen=True)
class Link:
    """A link as a description lists it.

    mass [kg]; centre (3,) of mass in the link frame [m]; inertia (3, 3) about the centre of mass, along the
    axes of the link frame [kg m²].
    """

    name: str
    mass: float = 0.0
    centre: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True)
class Joint:
    """A joint as a description lists it: the child's frame is the joint's frame.

    rotation (3, 3) and translation (3,) [m] place the joint frame in the parent link's frame at q = 0; axis
    (3,) is in the joint frame and need not be normalised.
    """

    name: str
    kind: str
    parent: str
    child: str
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))
    axis: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))


@dataclass(frozen=True)
class Frame:
    """Where a link's frame sits: rotation (3, 3) and translation (3,) [m] in the frame of body `body`."""

    body: int
    rotation: Array
    translation: Array


@dataclass(frozen=True)
class Tree:
    """A kinematic tree of n moving bodies; all constants are in the frame of the body they belong to.

    names, kinds : (n,) the joints in column order, and "revolute", "continuous" or "prismatic"
    parent : (n,) λ(i), `GROUND` for a child of the base
    axis : (n, 3) unit axis of joint i in its own frame
    rotation, translation : (n, 3, 3), (n, 3) [m] frame of joint i at q = 0 in the frame of body λ(i)
    inertia : (n, 6, 6) spatial inertia of body i, rigidly attached links included, about its frame's origin
    armature : (n,) reflected inertia of the drives, [kg m²] or [kg]
    gravity : (3,) acceleration of free fall, base frame [m/s²]
    frames : every link of the description, merged ones included, by name
    supports : (n, n) bool; supports[j, i] says that joint j is on the path from the base to body i
    joint_matrices : (3, n, 3, 3) the A, B, D of rotation(q) = A + sin(q) B + (1 − cos q) D
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    parent: tuple[int, ...]
    axis: Array
    rotation: Array
    translation: Array
    inertia: Array
    armature: Array
    gravity: Array
    frames: Mapping[str, Frame]
    supports: Array = field(init=False, repr=False)
    joint_matrices: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.names)
        supports = np.eye(n, dtype=bool)
        for i, above in enumerate(self.parent):
            if above >= i:
                raise ValueError(f"joint {self.names[i]!r} comes before the joint that carries it")
            if above != GROUND:
                supports[:, i] |= supports[:, above]
        turn = skew(self.axis)
        matrices = np.stack([self.rotation, self.rotation @ turn, self.rotation @ turn @ turn])
        object.__setattr__(self, "supports", supports)
        object.__setattr__(self, "joint_matrices", matrices)
        for array in (self.axis, self.rotation, self.translation, self.inertia, self.armature, self.gravity):
            array.setflags(write=False)

    @property
    def size(self) -> int:
        """Number of moving joints, n."""
        return len(self.names)

    def frame(self, link: str) -> Frame:
        """Return where the frame of a link sits, fixed links included."""
        if link not in self.frames:
            raise KeyError(f"no link named {link!r}; the links are {', '.join(sorted(self.frames))}")
        return self.frames[link]


def build_tree(
    links: Sequence[Link], joints: Sequence[Joint], *, joint_names: Sequence[str], armature: Array | None = None,
    gravity: Sequence[float] | Array = (0.0, 0.0, -9.81), locked: Mapping[str, float] | None = None,
) -> Tree:  # fmt: skip
    """Merge rigidly connected links and number the moving joints as `joint_names` orders them.

    links, joints: the description, in any order; the one link that is no joint's child is the base
    joint_names: (n,) the moving joints in column order, a parent before its children
    armature: (n,) drive inertia [kg m²] or [kg]; none by default
    gravity: (3,) base frame [m/s²]
    """
    locked = dict(locked or {})
    column = {name: i for i, name in enumerate(joint_names)}
    by_link = {link.name: link for link in links}
    _check(by_link, links, joints, column, locked)
    children = {name: [joint for joint in joints if joint.parent == name] for name in by_link}
    (root,) = set(by_link) - {joint.child for joint in joints}

    n = len(column)
    parent, kinds, axis = [GROUND] * n, [""] * n, np.zeros((n, 3))
    rotation, translation, inertia = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 6, 6))
    frames: dict[str, Frame] = {}
    to_do = [(root, Frame(GROUND, np.eye(3), np.zeros(3)))]
    while to_do:
        name, here = to_do.pop()
        frames[name] = here
        link = by_link[name]
        if here.body != GROUND:
            own = spatial_inertia(link.mass, link.centre, link.inertia)
            inertia[here.body] += inertia_to_base(here.rotation, here.translation, own)
        for joint in children[name]:
            turned, moved = _beyond(joint, here, locked)
            if joint.name in column:
                i = column[joint.name]
                parent[i], kinds[i], axis[i] = here.body, joint.kind, _unit(joint)
                rotation[i], translation[i] = turned, moved
                to_do.append((joint.child, Frame(i, np.eye(3), np.zeros(3))))
            else:
                to_do.append((joint.child, Frame(here.body, turned, moved)))
    return Tree(
        names=tuple(joint_names), kinds=tuple(kinds), parent=tuple(parent), axis=axis, rotation=rotation,
        translation=translation, inertia=inertia,
        armature=np.zeros(n) if armature is None else np.array(armature, dtype=float).reshape(n),
        gravity=np.array(gravity, dtype=float).reshape(3), frames=frames,
    )  # fmt: skip


def _beyond(joint: Joint, here: Frame, locked: Mapping[str, float]) -> tuple[Array, Array]:
    """Return rotation and place, m, of the frame beyond a joint of the link at `here`; what moves stands at zero."""
    turned = here.rotation @ joint.rotation
    moved = here.translation + here.rotation @ joint.translation
    if joint.kind in MOVING and joint.name in locked:  # held rigid
        turn, slide = joint_motion(joint.kind, _unit(joint), locked[joint.name])
        return turned @ turn, moved + turned @ slide
    return turned, moved


def joint_motion(kind: str, axis: Array, value: float) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and translation (3,) of a joint at `value`, in its own frame (Rodrigues)."""
    if kind == "prismatic":
        return np.eye(3), axis * value
    turn = skew(axis)
    return np.eye(3) + np.sin(value) * turn + (1.0 - np.cos(value)) * turn @ turn, np.zeros(3)


def _unit(joint: Joint) -> Array:
    """Return the joint's axis at length one."""
    axis = np.asarray(joint.axis, dtype=float)
    length = float(np.linalg.norm(axis))
    if not np.isfinite(length) or length < 1e-12:
        raise UnsupportedModel(f"joint {joint.name!r}: axis {axis.tolist()} has no direction")
    return axis / length


def _check(
    by_link: Mapping[str, Link], links: Sequence[Link], joints: Sequence[Joint], column: Mapping[str, int],
    locked: Mapping[str, float],
) -> None:  # fmt: skip
    """Refuse a description that is not one tree of known joints with finite, non-negative masses."""
    if len(by_link) != len(links) or len({joint.name for joint in joints}) != len(joints):
        raise UnsupportedModel("two links or two joints have the same name")
    for link in links:
        numbers = np.concatenate([[link.mass], link.centre, np.ravel(link.inertia)])
        if not np.all(np.isfinite(numbers)) or link.mass < 0.0:
            raise UnsupportedModel(f"link {link.name!r}: mass {link.mass}, inertia {link.inertia} are not physical")
    known = {joint.name for joint in joints}
    for name in [*column, *locked]:
        if name not in known:
            raise UnsupportedModel(f"no joint named {name!r} in the description")
    for joint in joints:
        if joint.kind not in (*MOVING, "fixed"):
            raise UnsupportedModel(f"joint {joint.name!r}: kind {joint.kind!r} is not one of {MOVING} or fixed")
        if joint.parent not in by_link or joint.child not in by_link:
            raise UnsupportedModel(f"joint {joint.name!r} names a link that does not exist")
        if joint.kind in MOVING and (joint.name in column) == (joint.name in locked):
            raise UnsupportedModel(f"joint {joint.name!r} must be either a column or locked")
        if joint.kind == "fixed" and joint.name in column:
            raise UnsupportedModel(f"joint {joint.name!r} is fixed and cannot be a column")
    roots = set(by_link) - {joint.child for joint in joints}
    if len(roots) != 1 or len(joints) != len(links) - 1:
        raise UnsupportedModel(f"the links do not form one tree: roots {sorted(roots)}, {len(joints)} joints")


class RobotModel(Protocol):
    """What the reader wants to know of a robot."""

    @property
    def format(self) -> str:
        """Say "urdf" or "mjcf"."""

    @property
    def text(self) -> str:
        """Hold the whole description."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Name the moving joints in column order."""

    @property
    def armature(self) -> Array:
        """Give the drive inertia (n,), [kg m²] or [kg]."""

    @property
    def tip(self) -> str | None:
        """Name the link that touches the surface, if the robot has one of its own."""

    @property
    def locked(self) -> Mapping[str, float]:
        """Give the joints held rigid, and where [rad] or [m]."""

    @property
    def gravity(self) -> Array:
        """Give the acceleration of free fall (3,), base frame [m/s²]."""


def read_urdf(model: RobotModel) -> Tree:
    """Return the tree of a robot that is described in URDF.

    A joint of `model.joint_names` moves on its own, whatever a ``mimic`` tag says of it: a column is a
    column.
    """
    if model.format != "urdf":
        raise UnsupportedModel(f"the oracle reads URDF only, this robot is {model.format!r}")
    links, joints = parse_urdf(model.text)
    return build_tree(
        links, joints, joint_names=model.joint_names, armature=np.asarray(model.armature),
        gravity=np.asarray(model.gravity), locked=model.locked,
    )  # fmt: skip


def parse_urdf(text: str) -> tuple[list[Link], list[Joint]]:
    """Return the links and joints that a URDF text lists, inertia tensors turned to the link's axes."""
    _refuse_what_would_be_defaulted(text)
    import yourdfpy  # imports trimesh, which takes a second

    robot = yourdfpy.URDF.load(
        io.BytesIO(text.encode()), build_scene_graph=False, build_collision_scene_graph=False, load_meshes=False,
        load_collision_meshes=False,
    ).robot  # fmt: skip
    return [_link(link) for link in robot.links], [_joint(joint) for joint in robot.joints]


def _link(link: Any) -> Link:
    """Turn the inertia tensor of ``<inertial>`` from the axes of its own origin to those of the link."""
    if link.inertial is None:
        return Link(link.name)
    rotation, centre = _placement(link.inertial.origin)
    tensor = rotation @ link.inertial.inertia @ rotation.T
    return Link(link.name, float(link.inertial.mass), centre, tensor)


def _joint(joint: Any) -> Joint:
    """Copy a joint; its placement is the child's frame in the parent's."""
    rotation, translation = _placement(joint.origin)
    axis = np.asarray(joint.axis, dtype=float)
    return Joint(joint.name, joint.type, joint.parent, joint.child, rotation, translation, axis)


def _placement(origin: Array | None) -> tuple[Array, Array]:
    """Split a homogeneous matrix (None: the identity) into rotation (3, 3) and translation (3,) [m]."""
    if origin is None:
        return np.eye(3), np.zeros(3)
    return np.array(origin[:3, :3]), np.array(origin[:3, 3])


def _refuse_what_would_be_defaulted(text: str) -> None:
    """Refuse malformed XML and incomplete inertial data, which yourdfpy would fill in without a word."""
    try:
        root = ElementTree.fromstring(text.encode())
    except ElementTree.ParseError as error:
        raise UnsupportedModel(f"the description is not XML: {error}") from error
    if root.tag != "robot":
        raise UnsupportedModel(f"the description is a <{root.tag}>, not a URDF <robot>")
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        for tag, wanted in (("mass", {"value"}), ("inertia", {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"})):
            element = inertial.find(tag)
            missing = wanted if element is None else wanted - set(element.keys())
            if missing:
                lacking = ", ".join(sorted(missing))
                raise UnsupportedModel(f"link {link.get('name')!r}: <{tag}> lacks {lacking}")
