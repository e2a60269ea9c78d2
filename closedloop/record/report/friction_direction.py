"""By how much the friction of a slow tip points away from its slip, and up to which speed: what no step resolves.

Where friction would turn the slip within a step it points to where the slip will be
(`closedloop.loop.step.tip_friction`).
"""

from __future__ import annotations

import numpy as np

from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.friction.quantities import AT_REST
from closedloop.record.columns.record import Record

# Smaller angles than this, degrees, are those between the states of a row and of the stages beside it.
LEAST_ANGLE = 1.0


def friction_off_slip(run: Record) -> dict[str, float] | None:
    """Return the largest angle between −F_t and the slip, degrees, when, s, and the fastest slip at which there is one.

    None where friction is along the slip, to `LEAST_ANGLE`, at every row that slips; laws with elastic bristles have a
    direction of their own, and none is meant.
    """
    if run.scenario.friction.kind == "none" or run.scenario.friction.sticks != "rigid" or not len(run):
        return None
    slip, friction = run.slip_velocity, -run.friction_force
    speed, size = np.linalg.norm(slip, axis=1), np.linalg.norm(friction, axis=1)
    slips = (run.mode == PRESSED) & (speed > AT_REST) & (size > 0.0)
    cosine = np.einsum("ij,ij->i", slip, friction)[slips] / (speed * size)[slips]
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if not np.any(angle > LEAST_ANGLE):
        return None
    return {
        "max_angle": float(np.max(angle)),
        "at": float(run.time[slips][np.argmax(angle)]),
        "below_speed": float(np.max(speed[slips][angle > LEAST_ANGLE])),
    }
