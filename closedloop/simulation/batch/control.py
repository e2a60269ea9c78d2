"""The verdict of the control of a run of a batch, from its rows, or from what the lanes keep of them."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.loop.events.table import IMPACT, TOUCHDOWN, EventRow
from closedloop.record.report.control_verdict import (
    MEAN_SHARE,
    PATH_FLOOR,
    RELEASE,
    judge_control,
    judge_force,
    limited_joints,
    negative_gain,
    signals_of,
    told,
)
from closedloop.record.report.measured import Values
from closedloop.record.report.verdict import GOOD
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.lanes import LaneRuns
from closedloop.simulation.engines.problem import Problem


def control_in_lanes(runs: LaneRuns, lane: int, scenario: Scenario) -> str:
    """Return "good", or what is wrong with the control of a run in a lane.

    Where nothing can happen to a run, all its rows are in contact. If contact is commanded in all of them and no error
    ever reaches what a bound is about, the worst of them decides; most runs of a sweep end here, for which the rows are
    not gone over.
    """
    if runs.kind.many:
        problem, found, events = runs.by_itself(lane)
        return control_of_rows(problem, found, events, runs.values(lane), None)
    worst, count = runs.worst(lane), runs.kind.steps + 1
    scale = math.sqrt(worst.wanted_squared / count)
    on_path = 4.0 * worst.off_squared <= PATH_FLOOR**2
    if on_path and worst.least > 0.0 and worst.rise <= RELEASE and not negative_gain(scenario):
        if worst.miss <= MEAN_SHARE * scale:
            return GOOD
        unknown: list[str] = []
        return _told((judge_force(runs.miss(lane), scale, runs.kind.h, _rows(count), unknown), unknown))
    wanted, force, along, tip = runs.signals(lane)
    # In contact from the start, only by how much the path rises off the surface counts.
    path = along, tip @ runs.normal(lane), tip
    signals = signals_of(scenario, runs.kind.h, force, wanted, np.ones(count, dtype=bool), path, np.empty(0))
    return _told(judge_control(signals, {}))


@lru_cache(maxsize=8)
def _rows(count: int) -> NDArray[np.int64]:
    return np.arange(count)


def control_of_rows(problem: Problem, found: Array, events: Array, values: Any, stopped: str | None) -> str:
    """Return the same of a run by itself.

    It is judged by what `closedloop.record.report.measured.write_control` wrote of its rows, its events, and its values
    (Values.count(n),).
    """
    n = problem.robot.n
    if not found.shape[1]:
        return _told(judge_control(None, {}, stopped))
    kinds = events[:, EventRow.place("kind")]
    began = (kinds == IMPACT) | (kinds == TOUCHDOWN)
    signals = signals_of(
        problem.scenario, problem.h, found[0], found[1], found[2] != 0.0, (found[4:7].T, found[3], found[7:].T),
        events[began, EventRow.place("time")],
    )  # fmt: skip
    measured = Values(values, n)
    names = problem.robot.model.joint_names
    limited = limited_joints(names, measured.torque_limited_share, measured.torque_limited_at)
    return _told(judge_control(signals, limited, stopped))


def _told(judged: tuple[list[dict[str, Any]], list[str]]) -> str:
    """Return the text of the column, with what is not known where nothing else is wrong."""
    problems, unknown = judged
    return told({"control_verdict": {"problems": problems, "not_known": unknown}})
