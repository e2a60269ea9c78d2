"""Straight segments through points, used by several paths."""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.curves import Straight
from closedloop.control.reference.timing import Timing
from closedloop.control.reference.tip_path import Segment


def through(times: Array, points: Array, origin: Array, timing: Timing) -> tuple[Segment, ...]:
    """Return straight segments from point to point, displacements (K, 3), m, from `origin`, at the instants (K,), s."""
    segments = []
    for t0, t1, from_, to in zip(times[:-1], times[1:], points[:-1], points[1:], strict=True):
        velocity = (to - from_) / (t1 - t0)
        length = float(np.linalg.norm(to - from_))
        segments.append(Segment(float(t0), float(t1), origin + from_, Straight(velocity), timing, length))
    return tuple(segments)
