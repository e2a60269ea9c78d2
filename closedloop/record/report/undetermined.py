"""What the equations of a run do not determine: forces at rest, where friction of a slow tip points, lost torques."""

from __future__ import annotations

import numpy as np

from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.friction.contact import joint_contacts
from closedloop.mechanics.friction.quantities import AT_REST
from closedloop.mechanics.loops.drives import torque_of_drives
from closedloop.record.columns.record import Record
from closedloop.scenario.arm import joint_friction_of, robot_of


def not_determined_from(run: Record) -> float | None:
    """Return the first row's instant, s, at which f is the one of least friction, see `step.share_friction`; or None.

    There all joints rest, each with dry friction, and the tip is held along the surface by friction or not at all.
    """
    scenario = run.scenario
    law = joint_friction_of(scenario, run.model)
    if law.kind == "none" or law.sticks != "rigid" or scenario.contact or run.loops is not None or not len(run):
        return None
    if not all(each.stick_limit > 0.0 for each in joint_contacts(law, run.model.n)):
        return None
    if scenario.friction.kind == "none":
        if scenario.compliance.kind != "none":
            return None
        touching = run.mode == PRESSED
    else:
        touching = (run.mode == STUCK) & (scenario.friction.sticks == "rigid")
    after = run.v + scenario.time.step * run.acceleration
    rests = np.all((np.abs(run.v) <= AT_REST) & (np.abs(after) <= AT_REST), axis=1) & touching
    return float(run.time[np.argmax(rests)]) if np.any(rests) else None


def motions_without_drive(run: Record) -> int:
    """Return how many independent motions at the first row no drive takes part in, see
    `closedloop.mechanics.loops.drives`."""
    model = run.model
    if not len(run) or all(model.driven):
        return 0
    if not model.loops:
        return int(model.n - np.count_nonzero(model.driven))
    return torque_of_drives(robot_of(run.scenario, model), np.array(run.q[0]), np.zeros(model.n))[1]


# Smaller angles than this, degrees, are those between the states of a row and of the stages beside it.
LEAST_ANGLE = 1.0


def friction_off_slip(run: Record) -> dict[str, float] | None:
    """Return the largest angle between −F_t and the slip, degrees, when, s, and the fastest slip at which there is one.

    Where friction would turn the slip within a step it points to where the slip will be
    (`closedloop.loop.step.tip_friction`): no step resolves it.

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
