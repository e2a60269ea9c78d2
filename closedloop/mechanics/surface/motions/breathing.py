"""[surface_motion] kind = "breathing": to and fro along a direction, A (1 − cos 2πft)/2 from where it starts."""

import math
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from closedloop.base.sections import PLACE, Direction, Number, Positive, Size
from closedloop.mechanics.surface.motion import SurfaceMotion, moving
from closedloop.mechanics.surface.placed import unit

FREQUENCY = Size(1e6, "Hz", "no arm follows it", 1e-9, "no run lasts long enough to show it")


class Breathing(SurfaceMotion):
    """To and fro, as the chest of a patient who breathes; the default is that of quiet breath."""

    direction: Direction = Field(
        (0.0, 0.0, 1.0), description="direction of the motion, base frame; any length but zero"
    )
    amplitude: Annotated[Number, PLACE, AfterValidator(moving)] = Field(
        0.01, description="distance between the two ends, m; negative starts the other way"
    )
    frequency: Annotated[Positive, FREQUENCY] = Field(0.25, description="frequency, Hz")

    def resolved(self) -> dict[str, Any]:
        """Return the unit vector of the direction."""
        return {"direction": np.asarray(unit(self.direction, "surface_motion.direction"))}

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the shift at t, s."""
        w, half = 2.0 * math.pi * par.frequency, 0.5 * par.amplitude
        for i in range(3):
            m.shift[i] = half * (1.0 - math.cos(w * t)) * par.direction[i]
            m.shift_rate[i] = half * w * math.sin(w * t) * par.direction[i]
            m.shift_acceleration[i] = half * w * w * math.cos(w * t) * par.direction[i]
