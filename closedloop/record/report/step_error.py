"""By how much the contact force and the tip's position of a run with a scheme of order one miss those of short steps.

A decaying motion a e^λt is off by ½ (hλ)² a e^λt a step of order one, which is half of what its second difference from
row to row is. What earlier steps left decays as the motion does, so the error of a row is at most the sum of what the
steps before it added: half of the total variation of the first difference. It is taken of the force less that asked for
and of the tip's distance from its reference, so that what the path itself does is no error, and anew in each mode of
contact. Where a path, a force or a law jumps at a row, the difference is an isolated one, and exact: each difference
counts with no more than the larger of its neighbours. Of a torque that is held for k steps every k-th row counts.

It is an estimate, not a bound that is proved: `tests/closedloop/test_step_error.py` compares it with runs at short
steps. It is about rows apart from those where contact begins, ends, sticks or slips: there the force jumps, at an
instant that moves with the step.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.record.columns.record import Record
from closedloop.record.report.step_variation import SPAN, Swing, Swings, cut_slope
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

Array = NDArray[np.float64]


def write_swings(run: Record, swings: Swings) -> None:
    """Write what the rows of a run, at least one, come to, see `closedloop.record.report.step_variation`."""
    miss = np.where(run.mode != FREE, run.contact_force - run.reference_force, 0.0)
    signals = np.column_stack([miss, run.position - run.reference_tip])
    held, total = held_for(run.scenario), np.zeros(signals.shape[1])
    for begin, end in pairwise([0, *(np.flatnonzero(np.diff(run.mode)) + 1), len(run)]):
        total += variation(signals[-(-begin // held) * held : end : held]) / held
    for k, error in enumerate(total):
        swing = Swing(swings.each[k])
        swing.error, swing.lowest, swing.highest = error, np.min(signals[:, k]), np.max(signals[:, k])


def held_for(scenario: Scenario) -> int:
    """Return for how many steps the law's torque is held, at least 1."""
    period = scenario.law.sample_period
    return max(1, round(period / scenario.time.step)) if period else 1


def variation(signals: Array) -> Array:
    """Return half of the total variation of the first difference of each column (N, k), isolated jumps left out, (k,).

    Of fewer than four rows it is half of their range: nothing is known of what they resolve.
    """
    if signals.shape[0] < SPAN:
        return 0.5 * np.ptp(signals, axis=0) if signals.shape[0] else np.zeros(signals.shape[1])
    steps = np.diff(signals, axis=0)
    none = np.zeros((1, signals.shape[1]))
    cut = interpreted(cut_slope)(np.vstack([none, steps[:-1]]), steps, np.vstack([steps[1:], none]))
    half: Array = 0.5 * np.sum(np.abs(np.diff(cut, axis=0)), axis=0)
    return half


def why_not_known(scenario: Scenario, model: RobotModel) -> str:
    """Return why the error of the step is not estimated, "" where it is."""
    name = scenario.time.integrator
    if name in ADAPTIVE:
        return f"{name} chooses its steps: its error is set by time.tolerance"
    scheme = scheme_of(name)
    if scheme is None or scheme.order != 1:
        return f"not estimated with {name}, of order two and more; measured with --halve"
    return "not estimated for mechanisms with loops; measured with --halve" if model.loops else ""


def step_error(run: Record, values: dict[str, Any]) -> dict[str, Any]:
    """Return the part ``step_error`` of the summary, of its values.

    ``contact_force``, N, and ``position``, m; ``measured``: whether they are the difference of the run at half the
    step, see `closedloop.record.report.halved`, and no estimate; ``why_not``: why they are None, or None.
    """
    why = None
    if values["step_error_force"] is None:
        why = why_not_known(run.scenario, run.model) if len(run) else "no row could be computed"
    return {
        "contact_force": values["step_error_force"],
        "position": values["step_error_position"],
        "measured": run.halved is not None,
        "why_not": why,
    }


def step_rows(found: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows of the table of errors, see `closedloop.record.report.report_rows`."""
    if found["contact_force"] is None or found["position"] is None:
        return [("error of the step", "not known", "", f"{found['why_not'] or 'no finite number'}")]
    beside = "measured, of the run at half the step" if found["measured"] else "estimate, of a run at a shorter step"
    return [
        ("f is within", f"±{found['contact_force']:.2g}", "N", beside),
        ("tip is within", f"±{found['position']:.2g}", "m", beside),
    ]
