"""The verdict of the control of a run of a batch, from its rows, or from what the lanes keep of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE
from closedloop.engines.lanes import LaneRuns
from closedloop.engines.problem import Problem
from closedloop.events.table import IMPACT, TOUCHDOWN, EventRow
from closedloop.report.control_signals import limited_joints, signals_of
from closedloop.report.control_verdict import judge_control
from closedloop.report.measured import Values
from closedloop.report.verdict import names_of
from closedloop.scenario.scenario import Scenario
from closedloop.step.record_row import recorded

Array = NDArray[np.float64]


def control_in_lanes(runs: LaneRuns, lane: int, scenario: Scenario) -> str:
    """Return "good", or what is wrong with the control of a run in a lane, all of whose rows are in contact."""
    own, wanted, tip = runs.signals(lane)
    path = own[:, 1:4], own[:, 4], tip
    touching = np.ones(len(own), dtype=bool)
    signals = signals_of(scenario, runs.kind.h, np.ascontiguousarray(own[:, 0]), wanted, touching, path, np.empty(0))
    return names_of(judge_control(signals, {})[0])


def control_of_rows(problem: Problem, rows: Array, events: Array, values: Any, stopped: str | None) -> str:
    """Return the same of a run by itself, of its rows, its events, and its values (Values.count(n),)."""
    n, count = problem.robot.n, len(rows)
    if not count:
        return names_of(judge_control(None, {}, stopped)[0])
    normal, error = recorded(rows, n, "surface_normal"), recorded(rows, n, "closure_error")
    table = problem.table[:: problem.nodes][:count]
    tip = table[:, 2 * n : 2 * n + 3]
    off = recorded(rows, n, "position") - tip
    out = np.einsum("ij,ij->i", off, normal)
    path = off - out[:, None] * normal, error - out, tip
    began = np.isin(events[:, EventRow.place("kind")], (IMPACT, TOUCHDOWN))
    signals = signals_of(
        problem.scenario, problem.h, recorded(rows, n, "contact_force"), table[:, 2 * n + 9],
        recorded(rows, n, "mode") != FREE, path, events[began, EventRow.place("time")],
    )  # fmt: skip
    found = Values(values, n)
    names = problem.robot.model.joint_names
    limited = limited_joints(names, found.torque_limited_share, found.torque_limited_at)
    return names_of(judge_control(signals, limited, stopped)[0])
