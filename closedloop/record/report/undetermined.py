"""Where rigid bodies do not determine the contact force: an arm at rest whose joints hold it beside its tip."""

from __future__ import annotations

import numpy as np

from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.friction.contact import joint_contacts
from closedloop.mechanics.friction.quantities import AT_REST
from closedloop.record.columns.record import Record
from closedloop.scenario.arm import joint_friction_of


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
