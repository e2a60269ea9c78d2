"""The summary of a run: verdict, the paper's five assumptions, how large every error was, and the balance of energy.

An assumption is reported as held only if it was checked at every row; the value that decides stands beside it.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, plain
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.table import KINDS
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.loops.reactions import parts_of
from closedloop.record.clearance import clearance_of
from closedloop.record.columns.record import Record
from closedloop.record.report.control_verdict import judge_control, limited_joints, run_signals
from closedloop.record.report.halved import step_error
from closedloop.record.report.measures import (
    JOINT_MEASURES,
    MEASURES,
    NAMES,
    Scale,
    absent_measures,
    assumptions_met,
    energy_left,
    torque_power,
)
from closedloop.record.report.run_values import columns_of, contact_faults, run_values
from closedloop.record.report.verdict import (
    Facts,
    friction_off_slip,
    judge,
    motions_without_drive,
    not_determined_from,
    outside_by_the_run,
    outside_by_the_scenario,
)
from closedloop.scenario import modes
from closedloop.scenario.arm import robot_of
from closedloop.scenario.user_module import lacks_members


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


def summarise(run: Record) -> dict[str, Any]:
    """Return the summary of a run: what summary.json holds, which is strict JSON.

    Quantities that do not exist (no rows) are None. So is a value that is no finite number; `not_finite` names it.
    """
    found = run_values(run) if len(run) else None
    values: dict[str, Any] = dict.fromkeys(MEASURES) if found is None else _measures(run, found)
    joints = {name: getattr(found, name, np.full(run.model.n, np.nan)) for name in JOINT_MEASURES}
    held = assumptions(run, values)
    facts = _facts(run, values, joints, held)
    problems = judge(facts, lambda: run_gains_fault(run))
    limited = limited_joints(run.model.joint_names, joints["torque_limited_share"], joints["torque_limited_at"])
    of_control, not_known = judge_control(run_signals(run), limited, run.stopped)
    return {
        "verdict": {"good": not problems, "problems": problems},
        "control_verdict": {"good": not of_control, "problems": of_control, "not_known": not_known},
        "scenario": run.scenario.name,
        "robot": run.model.name,
        "law": run.law,
        "steps": max(0, len(run) - 1),
        "end_time": float(run.time[-1]) if len(run) else None,
        "stopped": run.stopped,
        **{name: value if _exists(value) else None for name, value in values.items()},
        "not_finite": [name for name, value in values.items() if not _exists(value)],
        "step_error": step_error(run),
        "halved": None if run.halved is None else dict(run.halved),
        "wrist": _wrist(run),
        "tool": _tool(run),
        "force_not_determined_from": not_determined_from(run),
        "friction_off_slip": friction_off_slip(run),
        "motions_without_drive": motions_without_drive(run),
        "clearance": clearance_of(run),
        "events": {kind: sum(event.kind == kind for event in run.events) for kind in KINDS.values()},
        "assumptions": held,
        "joints": {
            name: {key: plain(column[j]) for key, column in joints.items()}
            for j, name in enumerate(run.model.joint_names if len(run) else ())
        },
        "loops": _loops(run),
        "wall_seconds": run.wall_seconds,
    }


def _unresolved(run: Record) -> list[str]:
    if not len(run):
        return []
    robot = robot_of(run.scenario, run.model)
    depth, own_law = -float(run.closure_error[0]), run.law != "scenario"

    def sliding() -> modes.Sliding | None:
        return modes.where_it_slides(run.q, run.surface_normal, run.contact_force, run.friction_force, run.mode)

    def pressed() -> modes.Pressed | None:
        return modes.where_they_press(run.q, run.link_forces)

    lines = modes.unresolved(run.scenario, robot, run.q[0], run.surface_normal[0], depth, sliding, own_law, pressed)
    return lines if own_law else lines + modes.unresolved_feedback(run.scenario, robot)


def _loops(run: Record) -> dict[str, dict[str, float]]:
    """Return the largest of each part of a mechanism's reactions, N or N m, and of its joint's errors, m or rad."""
    if run.loops is None or not len(run):
        return {}
    found = run.loops
    worst: dict[str, float] = {}
    for name, error in zip(found.joints, np.max(np.abs(found.errors), axis=0).tolist(), strict=True):
        worst[name] = max(error, worst.get(name, 0.0))
    most = np.max(np.abs(found.reactions), axis=0).tolist()
    joints = [loop.name for loop in run.model.loops for _ in parts_of(run.model, loop)]
    return {
        label: {"max_reaction": size, "max_error": worst[name]}
        for label, size, name in zip(found.labels, most, joints, strict=True)
    }


def _facts(run: Record, values: dict[str, Any], joints: dict[str, Array], held: dict[str, dict[str, Any]]) -> Facts:
    failed = {
        name: (v["first_failed"], v["measured"]) for name, v in held.items() if v["held"] is False and v["expected"]
    }
    columns = {name: column.tolist() for name, column in joints.items()}
    return Facts(
        run.scenario, run.model, run.stopped, len(run) - 1, values, len(run.events), failed, columns, _unresolved(run),
        run.halved, run.scenario.is_passive and run.law == "scenario",
    )  # fmt: skip


def _wrist(run: Record) -> dict[str, float | None] | None:
    """Return the largest force, N, and moment, N m, between the arm and what it carries; None if it carries nothing."""
    if len(run) == 0 or not (run.scenario.tool.mass or run.scenario.model_error.payload):
        return None
    parts = {"max_force": run.wrist_wrench[:, :3], "max_moment": run.wrist_wrench[:, 3:]}
    return {name: plain(np.max(np.linalg.norm(part, axis=1))) for name, part in parts.items()}


def _tool(run: Record) -> dict[str, float | None] | None:
    """Return how far the tool turned from its reference and from the normal at most, degrees; None if it is free."""
    if len(run) == 0 or getattr(run.scenario.reference, "orientation", "free") == "free":
        return None
    return {"max_orientation_error": plain(np.max(run.orientation_error)), "max_angle": plain(np.max(run.tool_angle))}


def run_gains_fault(run: Record) -> str:
    """Return what is wrong with the gains for this step; nothing is known of a law or a class of one's own."""
    if run.law != "scenario" or lacks_members(run.scenario):
        return ""
    return modes.gains_fault(run.scenario, robot_of(run.scenario, run.model))


def joint_measures(run: Record) -> dict[str, Array]:
    """Return `JOINT_MEASURES`, each (n,); an instant is NaN where there is none. Without rows nothing exists: NaN."""
    values = run_values(run) if len(run) else None
    return {name: getattr(values, name, np.full(run.model.n, np.nan)) for name in JOINT_MEASURES}


def _exists(value: float | None) -> bool:
    """Whether a value is a number, or is known not to exist."""
    return value is None or math.isfinite(value)


def _measures(run: Record, values: Any) -> dict[str, float | None]:
    """Return `MEASURES`; None is what does not exist, and a number that is not finite what overflowed."""
    found: dict[str, float | None] = {name: float(getattr(values, name)) for name in MEASURES}
    if np.all(run.mode == FREE):
        found["rms_force_error"] = None
    if np.isnan(values.force_settled_at):
        found["force_settled_at"] = None
    return found | dict.fromkeys(absent_measures(run.scenario, run.law != "scenario"))


def energy_balance(run: Record) -> tuple[Array, Array]:
    """Return the residual of the energy balance and the energy exchanged, each (N,), J, from the start to each row.

    The residual is the change of kinetic and potential energy less the energy that the arm was given: the work of the
    joint torques, ∫ Qᵀq̇ dt, of the contact force, ∫ f ė dt, and of friction at the tip and in the joints, less what
    the events took (`closedloop.loop.step.energy_supplied`). It shrinks with the step, impacts or not, as the
    integrator's order says. The energy exchanged is ∫ |Qᵀq̇| dt, by the trapezoidal rule over the rows: what the
    residual is small or large against.
    """
    row, n, scale = columns_of(run), run.model.n, Scale(np.zeros(Scale.count()))
    scale.start_energy, scale.start_supplied = run.kinetic_energy[0] + run.potential_energy[0], run.energy_supplied[0]
    left = interpreted(energy_left)(row, run.potential_energy, scale)
    power = np.abs(interpreted(torque_power)(row, n))
    return left, np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(run.time))])
