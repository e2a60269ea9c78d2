"""[reference] kind = "line"."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.reference.checks import direction_along, interval
from closedloop.reference.curves import Straight
from closedloop.reference.sections import LineSection
from closedloop.reference.timing import constant, minimum_jerk
from closedloop.reference.tip_path import Piece, TipPath

Array = NDArray[np.float64]


def line(section: LineSection, origin: Array, normal: Array) -> TipPath:
    """Return the path straight from `origin` (3,), m, along the surface with this unit normal (3,), base frame.

    Its length is speed · (stop − start) for either timing; with minimum jerk the highest speed is 1.875 times `speed`.

    Raises
    ------
    ScenarioError
        If the direction is not along the surface or `stop` is not after `start`.
    """
    direction = direction_along(section.direction, normal)
    start, stop = interval(section)
    curve = Straight(section.speed * direction)
    timing = constant if section.timing == "constant" else minimum_jerk
    piece = Piece(start, stop, origin, curve, timing, abs(section.speed) * (stop - start))
    return TipPath(origin, (piece,), ("reference.stop", "reference.speed"))
