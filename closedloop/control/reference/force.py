"""The desired contact force f_des(t): law.force, or a profile over time that starts from it."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import FORCE, Instant, Number, Positive, Section, Size, usual
from closedloop.control.reference.lists import Forces, Instants

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
    """Return f_des (N,), N, at times t (N,), s; at a jump the right limit.

    Parameters
    ----------
    base : float
        law.force, N.

    Raises
    ------
    ScenarioError
        If a profile of waypoints has not as many forces as instants.
    """
    t = np.asarray(t, dtype=np.float64)
    later = t + ROUNDING * np.maximum(1.0, np.abs(t))
    if isinstance(section, StepForceSection):
        return np.where(later >= section.at, section.to, base)
    if isinstance(section, SineForceSection):
        since = np.maximum(t - section.start, 0.0)
        return base + section.amplitude * np.sin(2.0 * np.pi * section.frequency * since)
    if isinstance(section, WaypointForceSection):
        if len(section.times) != len(section.forces):
            raise ScenarioError(
                f"force_profile.forces has {len(section.forces)} entries: must have one for each of the "
                f"{len(section.times)} force_profile.times"
            )
        return np.where(later >= section.times[0], np.interp(t, section.times, section.forces), base)
    return np.full(t.shape, base)
