"""From a URDF text to a `Tree`, with yourdfpy as the parser and nothing else of it.

yourdfpy is used because it shares no code with Pinocchio's parser. What it does silently, and what is done
about it:

- a missing ``mass`` value becomes 0, a missing ``ixx``, ``iyy`` or ``izz`` becomes **1** kg m²: refused here;
- malformed XML is parsed a second time in a mode that forgives: refused here by a strict pass before it;
- an axis is handed over as written, neither normalised nor refused at zero length: `build_tree` does both;
- ``origin`` comes as a 4×4 matrix (absent: None), so the rpy convention is yourdfpy's: tested against
  `rotation_from_rpy`.
"""

import io
from collections.abc import Mapping
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np

from validation.oracle.spatial import Array
from validation.oracle.tree import Joint, Link, Tree, UnsupportedModel, build_tree


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
        links,
        joints,
        joint_names=model.joint_names,
        armature=np.asarray(model.armature),
        gravity=np.asarray(model.gravity),
        locked=model.locked,
    )


def parse_urdf(text: str) -> tuple[list[Link], list[Joint]]:
    """Return the links and joints that a URDF text lists, inertia tensors turned to the link's axes."""
    _refuse_what_would_be_defaulted(text)
    import yourdfpy  # imports trimesh, which takes a second

    robot = yourdfpy.URDF.load(
        io.BytesIO(text.encode()),
        build_scene_graph=False,
        build_collision_scene_graph=False,
        load_meshes=False,
        load_collision_meshes=False,
    ).robot
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
