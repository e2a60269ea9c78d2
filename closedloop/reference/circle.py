"""[reference] kind = "circle"."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.reference.checks import direction_along, interval, not_zero
from closedloop.reference.curves import Ellipse
from closedloop.reference.sections import CircleSection
from closedloop.reference.timing import minimum_jerk
from closedloop.reference.tip_path import Piece, TipPath

Array = NDArray[np.float64]


def circle(section: CircleSection, origin: Array, normal: Array) -> TipPath:
    """Return the circle through `origin` (3,), m, in the surface with this unit normal (3,), base frame.

    Positive turns go counter-clockwise seen from off the surface: by the right-hand rule about the normal.

    Raises
    ------
    ScenarioError
        If the direction is not along the surface, `stop` is not after `start`, or there are no turns.
    """
    direction = direction_along(section.direction, normal)
    start, stop = interval(section)
    angle = 2 * math.pi * not_zero(section.turns, "reference.turns")
    across = np.cross(normal, direction)
    curve = Ellipse(section.radius * direction, -section.radius * across, angle / (stop - start))
    piece = Piece(start, stop, origin, curve, minimum_jerk, section.radius * abs(angle))
    return TipPath(origin, (piece,), ("reference.radius", "reference.turns"))
