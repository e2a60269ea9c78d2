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

from closedloop.closure.contact_force import FREE
from closedloop.columns.record import Record
from closedloop.integrators import ADAPTIVE, scheme_of

Array = NDArray[np.float64]

# The share of the largest force asked for that the step may cost. Shipped scenarios state 0.35 at most.
LARGEST_SHARE = 0.5


def step_error(run: Record) -> dict[str, Any]:
    """Return ``contact_force``, N, and ``position``, m, and ``why_not``: why they are None, or None.

    They are the largest difference from a run at a much shorter step, over the rows that are not beside a change of the
    mode of contact.
    """
    why = _why_not(run)
    if why:
        return {"contact_force": None, "position": None, "why_not": why}
    miss = np.where(run.mode != FREE, run.contact_force - run.reference_force, 0.0)
    signals = np.column_stack([miss, run.position - run.reference_tip])
    period = run.scenario.law.sample_period
    held = max(1, round(period / run.scenario.time.step)) if period else 1
    total = np.zeros(signals.shape[1])
    ends = [0, *(np.flatnonzero(np.diff(run.mode)) + 1), len(run)]
    for begin, end in pairwise(ends):
        total += variation(signals[-(-begin // held) * held : end : held]) / held
    total = np.minimum(total, np.ptp(signals, axis=0))
    return {"contact_force": float(total[0]), "position": float(np.linalg.norm(total[1:])), "why_not": None}


def variation(signals: Array) -> Array:
    """Return half of the total variation of the first difference of each column (N, k), isolated jumps left out, (k,).

    Of fewer than four rows it is half of their range: nothing is known of what they resolve.
    """
    if signals.shape[0] < 4:
        return 0.5 * np.ptp(signals, axis=0) if signals.shape[0] else np.zeros(signals.shape[1])
    steps = np.diff(signals, axis=0)
    size = np.abs(steps)
    beside = np.zeros_like(size)
    beside[1:] = size[:-1]
    beside[:-1] = np.maximum(beside[:-1], size[1:])
    clipped = np.sign(steps) * np.minimum(size, beside)
    half: Array = 0.5 * np.sum(np.abs(np.diff(clipped, axis=0)), axis=0)
    return half


def _why_not(run: Record) -> str:
    name = run.scenario.time.integrator
    if len(run) == 0:
        return "no row could be computed"
    if name in ADAPTIVE:
        return f"{name} chooses its steps: its error is set by time.tolerance"
    scheme = scheme_of(name)
    if scheme is None or scheme.order != 1:
        return f"not estimated with {name}, of order two and more"
    if run.model.loops:
        return "not estimated for mechanisms with loops"
    return ""


def step_problem(run: Record, found: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the problem of a force that the step leaves uncertain, in a list; empty if there is none."""
    error = found["contact_force"]
    asked = float(np.max(np.abs(run.reference_force))) if len(run) else 0.0
    if error is None or not asked > 0.0 or error <= LARGEST_SHARE * asked:
        return []
    text = (
        f"f is within ±{error:.3g} N only of a run at a shorter step, where at most {asked:.3g} N are asked for: take "
        f"a shorter time.step than {run.scenario.time.step:g} s, or time.integrator = 'rk4'"
    )
    return [{"name": "step", "at": None, "text": text}]


def step_rows(found: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows of the table of errors, see `closedloop.report.report_rows`."""
    if found["contact_force"] is None:
        return [("error of the step", "not known", "", f"{found['why_not']}; run it at half the step too")]
    beside = "estimate, of a run at a shorter step"
    return [
        ("f is within", f"±{found['contact_force']:.2g}", "N", beside),
        ("tip is within", f"±{found['position']:.2g}", "m", beside),
    ]
