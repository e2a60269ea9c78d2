"""Restitution and friction of single corners, from the rows before and after the first impact of each toss.

One corner strikes while the others are clear of the board. Parabolas through rows before and after give its rate along
the normal, e = −v⁺/v⁻, and the change of the centre's velocity, the impulse over the mass, μ = |Δv_t|/Δv_n, if the
corner slides throughout. Neither needs an engine, nor the inertia of the cube.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from validation.measured.cubes.comparing import interval
from validation.measured.cubes.engine import corners
from validation.measured.cubes.flight import SIDE, flight, rotations
from validation.measured.cubes.tosses import RATE, Toss

# Rows before and after an impact, those in which the corner may be lowest, and how high all others have to be, m.
BEFORE, AFTER, ABOUT, CLEAR = 7, 5, (-2, 4), 0.012


@dataclass(frozen=True)
class Corner:
    """What one corner did: rates along the normal, m/s, before and after; and |Δv_t|/Δv_n of the centre."""

    before: float
    after: float
    ratio: float


def corner_impacts(tosses: Sequence[Toss]) -> list[Corner]:
    """Return the first impacts of those tosses in which a single corner strikes."""
    at = np.array(corners(SIDE, 0.0))
    found = []
    for toss in tosses:
        first, place = flight(toss), toss.states[:, 4:7]
        if first < BEFORE + 2 or first + AFTER + ABOUT[1] > len(place):
            continue
        axes = rotations(toss.states).as_matrix()
        heights = place[:, 2, None] + (axes @ at.T)[:, 2, :]
        corner = int(heights[first].argmin())
        if np.delete(heights[first - 1 : first + AFTER], corner, axis=1).min() < CLEAR:
            continue
        low = first + ABOUT[0] + int(heights[first + ABOUT[0] : first + ABOUT[1], corner].argmin())
        path = place + axes @ at[corner]
        left, right = np.arange(low - BEFORE, low), np.arange(low + 1, low + 1 + AFTER)
        before, after = (_rate(path, rows, low)[2] for rows in (left, right))
        change = _rate(place, right, low) - _rate(place, left, low)
        found.append(Corner(float(before), float(after), float(np.hypot(*change[:2]) / change[2])))
    return found


def _rate(path: Array, rows: NDArray[np.int64], at: int) -> Array:
    """Return the velocity (3,) at a row of a parabola through others, m/s."""
    t = (rows - at) / RATE
    return np.linalg.lstsq(np.stack([t**p for p in range(3)], axis=1), path[rows], rcond=None)[0][1]


def impact_lines(tosses: Sequence[Toss]) -> list[str]:
    """Return what the impacts say, in words."""
    impacts = corner_impacts(tosses)
    v, w, ratio = (np.array([getattr(x, name) for x in impacts]) for name in ("before", "after", "ratio"))
    e = -w / v
    fast = -v > np.median(-v)
    lines = [f"{len(e)} first impacts of single corners, at {-v.max():.2f} to {-v.min():.2f} m/s"]
    for name, x in (("restitution", e), ("friction, if they slide", ratio)):
        low, high = interval(x)
        lines.append(
            f"  {name:24} {x.mean():.3f} ({low:.3f} to {high:.3f}), one impact ± {x.std():.3f}; slower half "
            f"{x[~fast].mean():.3f}, faster half {x[fast].mean():.3f}"
        )
    return lines
