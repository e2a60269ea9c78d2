"""The verdict of a run of which there are but the values: a row of a batch's table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.report.measured import EVENTS_AT, FAILED_AT, WIDTH
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES, absent_measures
from closedloop.record.report.row_assumptions import NAMES
from closedloop.record.report.verdict import Facts, judge, names_of, outside_by_the_run, outside_by_the_scenario
from closedloop.scenario.gains import gains_fault
from closedloop.scenario.scenario import Scenario

_AT = {name: at for at, name in enumerate(MEASURES)}


def verdict_of(
    scenario: Scenario,
    robot: Robot,
    values: Array,
    steps: int,
    stopped: str | None = None,
    swings: Sequence[str] = (),
    own_law: bool = False,
) -> str:
    """Return "good", or the names of what is wrong with a run, as `closedloop.record.report.verdict` judges its values.

    `swings` are what `closedloop.scenario.modes.unresolved` and `unresolved_feedback` say.
    """
    numbers, n = values.tolist(), robot.n
    measures = dict(zip(MEASURES, numbers[:EVENTS_AT], strict=True))
    outside = outside_by_the_scenario(scenario, robot.model) | outside_by_the_run(measures, stopped)
    failed = {
        name: (at, "")
        for name, at in zip(NAMES, numbers[FAILED_AT:WIDTH], strict=True)
        if not math.isnan(at) and name not in outside
    }
    facts = Facts(
        scenario, robot.model, stopped, steps, measures,
        0 if steps < 0 else int(sum(numbers[EVENTS_AT:FAILED_AT])), failed,
        {name: numbers[WIDTH + n * m : WIDTH + n * (m + 1)] for m, name in enumerate(JOINT_MEASURES)},
        swings, passive=scenario.is_passive and not own_law,
    )  # fmt: skip
    return names_of(judge(facts, lambda: gains_fault(scenario, robot)))


def forget_absent(scenario: Scenario, values: Array, own_law: bool = False) -> None:
    """Write NaN for the measures that do not exist."""
    for name in absent_measures(scenario, own_law):
        values[_AT[name]] = math.nan
