"""The plane n·p = d as the contact surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError


def unit(vector: ArrayLike, key: str) -> Array:
    """Return the (3,) unit vector along `vector`; `key` names it in messages.

    Raises
    ------
    ScenarioError
        If it is not three finite numbers, or has no direction.
    """
    v = np.array(vector, dtype=np.float64)
    if v.shape != (3,) or not np.all(np.isfinite(v)):
        raise ScenarioError(f"{key} = {vector!r}: must be three finite numbers")
    # Scaling by the largest entry first keeps tiny and huge vectors from under- or overflowing.
    largest = float(np.max(np.abs(v)))
    if largest == 0.0:
        raise ScenarioError(f"{key} = [0, 0, 0]: has no direction; give a vector such as [0, 0, 1]")
    v /= largest
    return v / np.linalg.norm(v)


def contact_frame(normal: ArrayLike) -> Array:
    """Return the (3, 3) contact frame of a unit normal (3,): rows n, t1, t2, right-handed, base axes.

    The tangents are +x and +y turned by the least rotation that takes +z to n. So a level surface has (t1, t2) =
    (x, y), and the frame changes smoothly with n except at n = −z, where many rotations are the least: there it is half
    a turn about x. (Any choice of tangents must jump somewhere.)
    """
    n = np.array(normal, dtype=np.float64)
    x, y, z = n
    across = math.hypot(x, y)
    if across < 1e-290 and z < 0.0:
        return np.array([n, [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    c, s = (x / across, y / across) if across > 1e-290 else (1.0, 0.0)
    turned = 1.0 - z
    t1 = [1.0 - turned * c * c, -turned * c * s, -x]
    t2 = [-turned * c * s, 1.0 - turned * s * s, -y]
    return np.array([n, t1, t2]) + 0.0  # no entry is −0


@dataclass(frozen=True)
@fields_checked
class Plane:
    """The plane n·p = d in the base frame (Eq. 11).

    Attributes
    ----------
    normal : (3,) array
        Unit normal n in the base frame; it points out of the surface, to the side where the robot is.
    offset : float
        Distance d of the plane from the base origin along n, m.
    """

    normal: Array
    offset: float

    @classmethod
    def of(cls, normal: ArrayLike, offset: float) -> Plane:
        """Make a plane from any non-zero normal, which is normalised; `offset` refers to the unit normal.

        Raises
        ------
        ScenarioError
            If the normal is not three finite numbers or has no direction, or the offset is not finite.
        """
        n = unit(normal, "surface.normal")
        if not np.isfinite(offset):
            raise ScenarioError(f'surface.offset = {offset}: must be a finite number of metres, or "start"')
        n.setflags(write=False)
        return cls(n, float(offset))

    @classmethod
    def through(cls, point: ArrayLike, normal: ArrayLike) -> Plane:
        """Make the plane with this normal through `point` (3,), m, base frame."""
        plane = cls.of(normal, 0.0)
        return cls(plane.normal, float(plane.normal @ np.asarray(point, dtype=np.float64)))

    def gap(self, point: ArrayLike) -> float:
        """Closure error e = n·p − d of a point (3,), m; positive off the surface."""
        return float(self.normal @ np.asarray(point, dtype=np.float64) - self.offset)
