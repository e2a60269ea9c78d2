"""Everything that a class of one's own needs, to be imported from here: this place does not move.

    from closedloop.plugins import ControlLaw, Field, Positive, RATE, gain_in

Base classes: `ControlLaw`, `Path`, `Integrator`, `SurfaceFriction`, `JointFriction`, `Restitution`, `Surface`,
`SurfaceMotion`, `Compliance`. Types of keys: `Number`, `Positive`, `NotNegative`, `Gain`, `Instant`, `Flag`,
`Direction`. Bounds with units, for ``Annotated[Positive, RATE]``: `RATE`, `LENGTH`, `PLACE`, `ANGLE`, `SPEED`, `FORCE`,
`TORQUE`, `INERTIA`, `PERIOD`, `CURVATURE`, and `gain_in`, `stiffness_in`, `viscous_in` with a unit of one's own.
"""

from typing import Annotated

from pydantic import Field

from closedloop.base.sections import (
    ANGLE,
    FORCE,
    INERTIA,
    LENGTH,
    PERIOD,
    PLACE,
    RATE,
    SPEED,
    TORQUE,
    Direction,
    Flag,
    Gain,
    Instant,
    NotNegative,
    Number,
    Positive,
    gain_in,
    stiffness_in,
    viscous_in,
)
from closedloop.control.law import ControlLaw, LawInput
from closedloop.control.reference.path import Path
from closedloop.control.reference.tip_path import Segment, TipPath, minimum_jerk
from closedloop.mechanics.friction.law import JointFriction, SurfaceFriction
from closedloop.mechanics.impact.single import Restitution
from closedloop.mechanics.integrators import Integrator
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.placed import contact_frame
from closedloop.mechanics.surface.surface import CURVATURE, Compliance, Surface

__all__ = [
    "ANGLE", "CURVATURE", "FORCE", "INERTIA", "LENGTH", "PERIOD", "PLACE", "RATE", "SPEED", "TORQUE",
    "Annotated", "Compliance", "ControlLaw", "Direction", "Field", "Flag", "Gain", "Instant", "Integrator",
    "JointFriction", "LawInput", "NotNegative", "Number", "Path", "Positive", "Restitution", "Segment", "Surface",
    "SurfaceFriction", "SurfaceMotion", "TipPath", "contact_frame", "gain_in", "minimum_jerk", "stiffness_in",
    "viscous_in",
]  # fmt: skip
