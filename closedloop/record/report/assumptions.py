"""The paper's five assumptions, watched in every run.

An assumption is reported as held only if it was checked at every row; the value that decides stands beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.record.columns.record import Record
from closedloop.record.report.row_sample import NAMES, assumptions_met
from closedloop.record.report.run_values import contact_faults
from closedloop.record.report.verdict import outside_by_the_run, outside_by_the_scenario


def assumptions(run: Record, measures: Mapping[str, float | None]) -> dict[str, dict[str, Any]]:
    """Return, for each of the paper's assumptions, whether it held, when it first failed (s), and what decided.

    ``expected`` says whether it should hold: False where the scenario itself gives it up, see
    `closedloop.record.report.verdict.outside_by_the_scenario`, or the run left it in a determined way. `measures` are
    the run's, see `closedloop.record.report.measures.MEASURES`.

    - ``one_loop``: Eq. 24 has a single closure row, and its solution obeys it.
    - ``single_point``: the surface acts on the arm at the tip alone: the equation of motion is met with Jᵣᵀn f and no
      moment beside it.
    - ``contact_kept``: the surface never has to pull: f > 0, and a tip that may leave never does.
    - ``frictionless``: the surface acts along its normal alone and the joints turn freely: no friction of either, and
      the same residual.
    - ``nonsingular``: the tip can move along the normal (`NEAR_SINGULAR`).
    """
    outside = outside_by_the_scenario(run.scenario, run.model)
    if len(run) == 0:
        missing = {"held": None, "first_failed": 0.0, "measured": "no row could be computed"}
        return {name: missing | {"expected": name not in outside} for name in NAMES}
    motion = float(np.max(run.residual_motion))
    stiffest = _stiffest(run)
    friction = np.linalg.norm(run.friction_force, axis=1)
    in_joints = np.max(np.abs(run.joint_friction), axis=1)
    only_contact = f"other forces ≤ {motion:.0e}"
    measured = (
        _rows_of_the_closure(run),
        only_contact,
        _contact(run),
        _friction(friction, in_joints) or only_contact,
        f"mobility ≥ {run.normal_mobility[stiffest]:.2g}, cond. ≤ {np.max(run.kkt_condition):.2g}",
    )
    met = interpreted(assumptions_met)(run, friction, in_joints)
    report = {name: _judge(run, *verdict) for name, *verdict in zip(NAMES, met, measured, strict=True)}
    if run.stopped and "singular" in run.stopped:
        verdict = report["nonsingular"]
        if verdict["held"]:  # no row was near it: the step after the last was
            verdict |= {"held": False, "first_failed": float(run.time[-1]) + run.scenario.time.step}
    if run.model.loops:
        rows = sum(loop.rows for loop in run.model.loops)
        count = len(run.model.loops)
        said = f"{measured[0]}; {_counted(rows, 'row')} in {_counted(count, 'loop')} of the mechanism"
        report["one_loop"] = {"held": False, "first_failed": 0.0, "measured": said}
        outside |= {"one_loop"}
    if found := contact_faults(run):
        cone, product = np.max(found.cone), np.max(found.complementarity)
        said = (
            f"{_counted(len(found.names), 'contact')} besides: cone to {cone:.0e} N, force times gap {product:.0e} N m"
        )
        report["single_point"] = {"held": False, "first_failed": 0.0, "measured": said}
        outside |= {"single_point"}
        friction = np.hypot(run.link_frictions[:, ::2], run.link_frictions[:, 1::2])
        if np.any(friction):
            before = report["frictionless"]
            first = float(run.time[np.argmax(np.any(friction > 0.0, axis=1))])
            first = first if before["first_failed"] is None else min(first, before["first_failed"])
            said = f"friction at the contacts ≤ {np.max(friction):.3g} N"
            said = said if before["held"] else f"{before['measured']}; {said}"
            report["frictionless"] = {"held": False, "first_failed": first, "measured": said}
            outside |= {"frictionless"}
    if passed := outside_by_the_run(measures, run.stopped):
        verdict = report["nonsingular"]
        verdict["measured"] = f"passed at t = {run.time[stiffest]:.4g} s; {verdict['measured']}"
        outside |= passed
    for name, verdict in report.items():
        verdict["expected"] = name not in outside
    return report


def _stiffest(run: Record) -> int:
    """Return the row at which the tip moves least along the normal; the middle of those of a pose that it passes."""
    first = int(np.argmin(run.normal_mobility))
    alike = np.cumprod(run.normal_mobility[first:] == run.normal_mobility[first])
    return first + int(np.sum(alike)) // 2


def _judge(run: Record, held: NDArray[np.bool_], measured: str) -> dict[str, Any]:
    failed = np.flatnonzero(~held)
    first = float(run.time[failed[0]]) if failed.size else None
    return {"held": not failed.size, "first_failed": first, "measured": measured}


def _friction(at_tip: NDArray[np.float64], in_joints: NDArray[np.float64]) -> str:
    """Return how much friction there was, N and N m, or an empty string."""
    parts = [(at_tip, "N"), (in_joints, "N m in joints")]
    return ", ".join(f"friction ≤ {np.max(size):.3g} {unit}" for size, unit in parts if np.any(size))


def _rows_of_the_closure(run: Record) -> str:
    if np.all(run.mode == FREE):
        return "no row: the tip is free" if run.scenario.has_surface else "no row: there is no surface"
    if np.any(run.mode == STUCK):
        return "three rows while the tip sticks"
    return f"one row, met to {np.max(run.residual_closure):.0e}"


def _contact(run: Record) -> str:
    """Return what decides whether contact was kept: how long the tip was off the surface, else the lowest force."""
    touching = run.mode != FREE
    if not np.any(touching):
        return "free from start to end" if run.scenario.has_surface else "there is no surface"
    held = np.where(touching, run.contact_force, np.inf)
    lowest = int(np.argmin(held))
    if np.all(touching) or not held[lowest] > 0.0:
        return f"f ≥ {held[lowest]:.4g} N, at {run.time[lowest]:.4g} s"
    free = run.scenario.time.step * np.count_nonzero(~touching[:-1])
    return f"free for {free:.4g} of {run.time[-1]:g} s"


def _counted(count: int, what: str) -> str:
    """Return how many there are of something, in words."""
    return f"{count} {what}" + ("s" if count != 1 else "")
