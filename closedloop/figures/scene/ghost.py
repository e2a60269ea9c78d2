"""A second body beside those of a run, which a drawing shows through: a measured one, or that of another run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from closedloop.base.arrays import Array
from closedloop.figures.scene.shapes import Shape

#: Red, green, blue from 0 to 1: of Okabe and Ito's palette, and how much of what is behind a ghost it hides.
COLOUR, OPACITY = (0.90, 0.62, 0.0), 0.35


@dataclass(frozen=True)
class Ghost:
    """A body that moves by itself, and its motion.

    Attributes
    ----------
    name : str
        What it is called in a legend.
    shapes : tuple of Shape
        In the body's frame. Their `joint` and colour count for nothing.
    time : (K,) array
        s, increasing.
    quaternions : (K, 4) array
        Orientation of the body's frame, w x y z.
    origins : (K, 3) array
        Origin of the body's frame, m, base frame.
    """

    name: str
    shapes: tuple[Shape, ...]
    time: Array
    quaternions: Array
    origins: Array

    def place(self, t: float) -> tuple[Array, Array]:
        """Return the axes (3, 3) and the origin (3,), m, at an instant: between two rows, along the shortest turn."""
        later = int(np.clip(np.searchsorted(self.time, t), 1, len(self.time) - 1))
        share = float(np.clip((t - self.time[later - 1]) / (self.time[later] - self.time[later - 1]), 0.0, 1.0))
        a, b = (pin.Quaternion(*map(float, self.quaternions[k])) for k in (later - 1, later))
        origin: Array = (1.0 - share) * self.origins[later - 1] + share * self.origins[later]
        return np.array(a.slerp(share, b).matrix()), origin
