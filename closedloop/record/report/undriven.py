"""Joints without a drive: of how many motions of the mechanism what the law asks for is lost."""

from __future__ import annotations

import numpy as np

from closedloop.mechanics.loops.drives import torque_of_drives
from closedloop.record.columns.record import Record
from closedloop.scenario.arm import robot_of


def motions_without_drive(run: Record) -> int:
    """Return how many independent motions at the first row no drive takes part in, see
    `closedloop.mechanics.loops.drives`."""
    model = run.model
    if not len(run) or all(model.driven):
        return 0
    if not model.loops:
        return int(model.n - np.count_nonzero(model.driven))
    return torque_of_drives(robot_of(run.scenario, model), np.array(run.q[0]), np.zeros(model.n))[1]
