"""The harness: the simulator's quantities against engines that share nothing with it.

import validation
report = validation.crosscheck("wam4", states=1000, seed=0)
report.passed, report.worst
report.show()
"""

from __future__ import annotations

import closedloop as _closedloop  # noqa: F401  # before anything else: it looks after the current folder

from collections.abc import Sequence  # isort: skip
from typing import TYPE_CHECKING, Any  # isort: skip

if TYPE_CHECKING:
    from validation.engines import Engine
    from validation.report import Report

__all__ = ["crosscheck"]


def crosscheck(
    robot: Any, tip: str | None = None, *, states: int = 1000, seed: int = 0, engines: Sequence[type[Engine]] = ()
) -> Report:
    """Compare every installed engine on one robot; see `validation.comparison.compare` for the parameters.

    Returns
    -------
    Report
        `passed`, `worst` (the cell that uses most of its tolerance), `to_json()`, `to_markdown()`, `to_html()` and
        `show()`.

    Raises
    ------
    ModelError
        If the robot cannot be loaded or has no such tip.
    """
    from validation.report import Report
    from validation.suite import compare_with_truth, load_robot

    model = load_robot(robot) if isinstance(robot, str) else robot
    label = robot if isinstance(robot, str) else model.name
    found = compare_with_truth(model, tip, states, seed, engines, label)
    return Report(found, command=f"validation.crosscheck({robot!r}, states={states}, seed={seed})")
