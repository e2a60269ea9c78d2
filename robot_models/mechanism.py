"""What a text says of a mechanism, in numbers: its links, where each hangs, and what it weighs.

Both formats are written down here by readers of our own, so that the model that Pinocchio builds can be held against
the text (`robot_models.build`).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError

Array = NDArray[np.float64]


#: Joints that move, locked ones included. Pinocchio's workspace takes 48 n³ bytes: 0.1 GB here, 6 GB at 500 joints. The
#: largest robot of example-robot-data has 101.
MAX_JOINTS = 128

#: Links (bodies and sites). The largest robot of example-robot-data has 130; reading 2000 takes a few seconds.
MAX_LINKS = 2000


def check_count(links: int, joints: int, where: str) -> None:
    """Refuse a mechanism beyond the bounds, before anything that takes long or much memory.

    Raises `ModelError` if there are more links than `MAX_LINKS`, or more joints that move than `MAX_JOINTS`.
    """
    for count, most, what in ((links, MAX_LINKS, "links"), (joints, MAX_JOINTS, "joints that move")):
        if count > most:
            raise ModelError(f"{where} has {count} {what}: at most {most} are simulated")


@dataclass(frozen=True)
class Weight:
    """What a link weighs: nothing, unless said. All in the link's own frame."""

    #: kg
    mass: float = 0.0
    #: (3,) m
    centre: Array = field(default_factory=lambda: np.zeros(3))
    #: (3, 3) about the centre of mass, kg m²
    tensor: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True)
class Bounds:
    """The limits of a joint: rad, rad/s, N m (m, m/s, N); infinite where there is none."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf


@dataclass(frozen=True)
class Link:
    """A link (or a site, which is a frame and no more) and the joint by which it hangs."""

    name: str
    #: Position in the list of links; −1 for the root.
    parent: int
    #: The joint's name; "" where the link is welded without one.
    joint: str = ""
    #: "revolute", "prismatic", "ball", "free" or "fixed".
    kind: str = "fixed"
    #: (4, 4) the joint's frame in the parent's frame at q = 0.
    placement: Array = field(default_factory=lambda: np.eye(4))
    #: (3,) unit vector in the joint's frame.
    axis: Array = field(default_factory=lambda: np.zeros(3))
    #: (4, 4) the link's frame in the joint's frame.
    offset: Array = field(default_factory=lambda: np.eye(4))
    weight: Weight = field(default_factory=Weight)
    bounds: Bounds = field(default_factory=Bounds)
    #: Drive inertia that the text itself gives, kg m² (kg).
    armature: float = 0.0
    site: bool = False


def transform(rotation: Array, translation: Array) -> Array:
    """Return the homogeneous matrix (4, 4) of a rotation (3, 3) and a translation (3,)."""
    result = np.zeros((4, 4))  # np.eye takes three times as long
    result[:3, :3], result[:3, 3], result[3, 3] = rotation, translation, 1.0
    return result


def symmetric(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> Array:
    """Return the symmetric matrix (3, 3) of six entries."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def turned(axis: Array, angle: float) -> Array:
    """Return the rotation (3, 3) by an angle, rad, about a unit vector (3,): Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return rotation


def displaced(link: Link, value: float) -> Array:
    """Return the motion (4, 4) of a link's joint by a value, rad (m), in the joint's frame."""
    if link.kind == "prismatic":
        return transform(np.eye(3), value * link.axis)
    return transform(turned(link.axis, value), np.zeros(3))


def lumped(weights: list[Weight], poses: list[Array]) -> Weight:
    """Return the weight of links held together, of their weights and poses (4, 4), in the frame of these.

    Without mass the centre is the origin.
    """
    mass = sum(weight.mass for weight in weights)
    centres = [pose[:3, :3] @ weight.centre + pose[:3, 3] for weight, pose in zip(weights, poses, strict=True)]
    first = sum((weight.mass * centre for weight, centre in zip(weights, centres, strict=True)), np.zeros(3))
    centre = first / mass if mass != 0.0 else np.zeros(3)
    tensor = np.zeros((3, 3))
    for weight, pose, own in zip(weights, poses, centres, strict=True):
        arm = own - centre
        tensor += pose[:3, :3] @ weight.tensor @ pose[:3, :3].T
        tensor += weight.mass * ((arm @ arm) * np.eye(3) - np.outer(arm, arm))  # the parallel-axis theorem
    return Weight(mass, centre, tensor)
