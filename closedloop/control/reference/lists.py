"""Lists of instants, of points and of forces in a section, checked entry by entry."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BeforeValidator

from closedloop.base.sections import PLACE, Unit
from robot_models.errors import shown


def _numbers(value: Any, what: str) -> tuple[float, ...]:
    if not isinstance(value, (list, tuple)) or not value:
        raise ValueError(f"must be a list of {what}")
    for index, entry in enumerate(value):
        if isinstance(entry, bool) or not isinstance(entry, (int, float)):
            raise ValueError(f"entry {index} is {shown(entry)}: must be a number")
        try:
            number = float(entry)
        except OverflowError:
            raise ValueError(f"entry {index} must be a number below 1e308") from None
        if not math.isfinite(number):
            raise ValueError(f"entry {index} is {number}: must be finite, not NaN or infinite")
    return tuple(float(entry) for entry in value)


def _instants(value: Any) -> tuple[float, ...]:
    times = _numbers(value, "instants, s")
    if times[0] < 0.0:
        raise ValueError(f"entry 0 is {times[0]:g}: must not be negative")
    for index in range(1, len(times)):
        if not times[index] > times[index - 1]:
            raise ValueError(
                f"entry {index} is {times[index]:g}: must be later than entry {index - 1}, {times[index - 1]:g}"
            )
    return times


def _at_least_two(times: tuple[float, ...]) -> tuple[float, ...]:
    if len(times) < 2:
        raise ValueError("must have at least two entries")
    return times


def _points(value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, (list, tuple)):
        raise ValueError("must be a list of points, each three numbers")
    points = []
    for index, entry in enumerate(value):
        try:
            point = _numbers(entry, "three numbers")
        except ValueError as error:
            raise ValueError(f"point {index}: {error}") from None
        if len(point) != 3:
            raise ValueError(f"point {index} has {len(point)} numbers: must be three numbers")
        points.append(point)
    return tuple(points)


Forces = Annotated[tuple[float, ...], BeforeValidator(lambda value: _numbers(value, "forces, N"))]
Instants = Annotated[tuple[float, ...], BeforeValidator(_instants), Unit("s")]
MotionInstants = Annotated[tuple[float, ...], BeforeValidator(lambda value: _at_least_two(_instants(value))), Unit("s")]
Points = Annotated[tuple[Annotated[tuple[float, float, float], PLACE], ...], BeforeValidator(_points)]
