"""[reference] kind = "figure_eight"."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.reference.checks import direction_along, interval
from closedloop.reference.curves import Eight
from closedloop.reference.sections import FigureEightSection
from closedloop.reference.timing import minimum_jerk
from closedloop.reference.tip_path import Piece, TipPath

Array = NDArray[np.float64]


def figure_eight(section: FigureEightSection, origin: Array, normal: Array) -> TipPath:
    """Return the eight that crosses itself at `origin` (3,), m, in the surface with this unit normal (3,), base frame.

    It is the Lissajous figure x = (width/2) sin φ along `direction`, y = (height/2) sin 2φ along n × direction.

    Raises
    ------
    ScenarioError
        If the direction is not along the surface or `stop` is not after `start`.
    """
    direction = direction_along(section.direction, normal)
    start, stop = interval(section)
    across = np.cross(normal, direction)
    rate = 2 * math.pi * section.turns / (stop - start)
    curve = Eight(0.5 * section.width * direction, 0.5 * section.height * across, rate)
    length = section.turns * _length(section.width, section.height)
    piece = Piece(start, stop, origin, curve, minimum_jerk, length)
    return TipPath(origin, (piece,), ("reference.width", "reference.height", "reference.turns"))


def _length(width: float, height: float) -> float:
    """Return the length of one turn, m: the trapezium rule, which a periodic smooth integrand makes exact quickly."""
    angles = 2 * math.pi / 256 * np.arange(256)
    speed = np.hypot(0.5 * width * np.cos(angles), height * np.cos(2 * angles))
    return 2 * math.pi * float(np.mean(speed))
