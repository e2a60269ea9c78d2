"""A loop joint as its type, its two sides and what it bears there."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from validation.oracle.spatial import Array

# Along which of the joint's axes x, y, z (the last is the joint's own) it bears forces, and about which couples.
FORCES = {"point": "xyz", "hinge": "xyz", "slider": "xy", "cylinder": "xy", "universal": "xyz", "planar": "z",
          "weld": "xyz"}  # fmt: skip
COUPLES = {"point": "", "hinge": "xy", "slider": "xyz", "cylinder": "xy", "universal": "", "planar": "xy",
           "weld": "xyz"}  # fmt: skip


WORLD = "world"
"""What stands for the base as a frame of a loop joint."""


class LoopJoint(Protocol):
    """What is read of a loop joint: lengths in m, directions of length one, the first of a pair in the first frame."""

    @property
    def type(self) -> str:
        """Of `FORCES`, or ``"distance"`` or ``"gear"``."""

    @property
    def frames(self) -> Sequence[str]:
        """Names of the two frames, of which the second may be `WORLD`."""

    @property
    def points(self) -> Sequence[Sequence[float]]:
        """A point in either frame."""

    @property
    def axes(self) -> Sequence[Sequence[float]]:
        """An axis in either frame."""

    @property
    def turn(self) -> Sequence[Sequence[float]]:
        """The first frame's axes in the second frame when closed: a rotation, row by row."""

    @property
    def length(self) -> float:
        """Of a distance."""

    @property
    def joints(self) -> Sequence[str]:
        """Names of the joints of a gear; one alone is held at c0."""

    @property
    def coefficients(self) -> Sequence[Sequence[float]]:
        """Of a gear between sums of joints, the coefficients of its joints in either."""

    @property
    def polynomial(self) -> Sequence[float]:
        """c0 ... c4 of q1 = c0 + c1 q2 + ... of a gear."""


def joint_axes(joint: LoopJoint, k: int) -> Array:
    """Return the axes of a loop joint, columns, in the frame of its side k; those of both agree where it is closed.

    Of a type that is free to turn about its axis z alone, z does.
    """
    z = np.array(joint.axes[0])
    x = np.cross(z, [0.6, 0.0, 0.8]) if abs(z @ [0.6, 0.0, 0.8]) < 0.9 else np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    first = np.column_stack([x, np.cross(z, x), z])
    if k == 0:
        return first
    if joint.type in ("slider", "weld"):
        return np.asarray(np.array(joint.turn) @ first)
    other = np.array(joint.axes[1])
    y = np.cross(other, np.eye(3)[int(np.argmin(np.abs(other)))])
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, other), y, other])
