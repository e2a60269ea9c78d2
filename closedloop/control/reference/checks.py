"""Checks of several fields together, shared by several kinds of reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Size
from closedloop.mechanics.surface.placed import unit

TURNS = Size(1e6, "", "no path goes round so often", 1e-9)

# Sine of the angle by which a direction may point out of the surface: 1e-9 of the way, a nanometre in a metre.
OUT_OF_SURFACE = 1e-9


class Between(Protocol):
    """A section that has a start and a stop, s."""

    @property
    def start(self) -> float: ...  # noqa: D102
    @property
    def stop(self) -> float: ...  # noqa: D102


def direction_along(direction: Sequence[float], normal: Array) -> Array:
    """Return the unit vector (3,) of reference.direction, which must be along the surface with this unit normal (3,).

    Raises
    ------
    ScenarioError
        If it has no direction, or points out of the surface; names the nearest that does not.
    """
    along = unit(direction, "reference.direction")
    out = float(normal @ along)
    if abs(out) > OUT_OF_SURFACE:
        inside = along - out * normal
        size = float(np.linalg.norm(inside))
        near = (inside / size).round(12) + 0.0 if size > 1e-9 else None
        hint = "" if near is None else f"; the nearest direction along it is {near.tolist()}"
        raise ScenarioError(f"reference.direction = {list(direction)}: must lie in the surface{hint}")
    return along


def interval(section: Between) -> tuple[float, float]:
    """Return reference.start and reference.stop, s."""
    if not section.stop > section.start:
        raise ScenarioError(
            f"reference.stop = {section.stop:g}: must be later than reference.start = {section.start:g}"
        )
    return section.start, section.stop


def not_zero(value: float, key: str) -> float:
    """Return the value; refuse zero."""
    if value == 0.0:
        raise ScenarioError(f"{key} = 0: must not be zero")
    return value
