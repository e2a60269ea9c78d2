"""The desired contact force over time, and lists of instants, points and forces in a section."""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import FORCE, PLACE, Instant, Number, Positive, Section, Size, Unit, usual
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


# i·h and the instant of a jump may differ by rounding: earlier by this share of the instant counts as the instant.
ROUNDING = 1e-12

FREQUENCY = Size(1e6, "Hz", "no step resolves more", 1e-12)


class ConstantForceSection(Section):
    """[force_profile] kind = "constant": law.force, always."""

    kind: Literal["constant"] = "constant"


class StepForceSection(Section):
    """[force_profile] kind = "step": law.force, and another force from an instant on."""

    kind: Literal["step"] = "step"
    to: Annotated[Number, FORCE] = Field(description="desired force after the step, N")
    at: Instant = Field(description="instant of the step, s")


class SineForceSection(Section):
    """[force_profile] kind = "sine": a sine about law.force."""

    kind: Literal["sine"] = "sine"
    amplitude: Annotated[Number, FORCE] = Field(description="amplitude of the sine, N; negative begins downwards")
    frequency: Annotated[Positive, FREQUENCY] = Field(description="frequency of the sine, Hz")
    start: Instant = Field(0.0, description="instant at which the sine begins, s; law.force before")


class WaypointForceSection(Section):
    """[force_profile] kind = "waypoints": linear in time between given forces; law.force before the first instant."""

    kind: Literal["waypoints"] = "waypoints"
    times: Instants = Field(description="instants at which the desired force is as given, s, increasing")
    forces: Annotated[Forces, FORCE] = Field(description="desired force at those instants, N; the last stays")


ForceProfile = Annotated[
    ConstantForceSection | StepForceSection | SineForceSection | WaypointForceSection,
    Field(discriminator="kind"),
    usual(ConstantForceSection),
]


def force_at(section: ForceProfile, base: float, t: Array) -> Array:
    """Return f_des (N,), N, of law.force `base` at t (N,), s; right limits. ScenarioError if forces are missing."""
    t = np.asarray(t, dtype=np.float64)
    if isinstance(section, ConstantForceSection):
        return np.full(t.shape, base)
    later = t + ROUNDING * np.maximum(1.0, np.abs(t))
    if isinstance(section, StepForceSection):
        return np.where(later >= section.at, section.to, base)
    if isinstance(section, SineForceSection):
        since = np.maximum(t - section.start, 0.0)
        return base + section.amplitude * np.sin(2.0 * np.pi * section.frequency * since)
    if len(section.times) != len(section.forces):
        raise ScenarioError(
            f"force_profile.forces has {len(section.forces)} entries: must have one for each of the "
            f"{len(section.times)} force_profile.times"
        )
    return np.where(later >= section.times[0], np.interp(t, section.times, section.forces), base)
