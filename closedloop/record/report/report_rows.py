"""The rows of the table of errors: how large every error of a run was, and what its parts bore."""

from __future__ import annotations

from typing import Any

import numpy as np

from closedloop.control.drives import AT_RATE_LIMIT, AT_TORQUE_LIMIT
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.record.columns.record import Record
from closedloop.record.report.run_values import contact_rows
from closedloop.record.report.summary import joint_measures
from closedloop.record.report.verdict import energy_at_stake

# Quantity, value, unit, and what stands beside it.
Row = tuple[str, str, str, str]
_LIMITS = {AT_TORQUE_LIMIT: "torque limit", AT_RATE_LIMIT: "rate limit"}


def report_rows(run: Record) -> list[Row]:
    """Return the rows of the table of errors: quantity, value, unit, and what stands beside it; the run has rows."""
    facts = run.summary()
    touching = run.mode != FREE
    commanded = f"commanded {run.reference_force[-1]:.6g} N" if run.law == "scenario" else f"law {run.law}"
    kind = run.scenario.stabiliser.kind
    absent = {"none": "no stabiliser", "projection": "projection needs no force"}.get(kind, "")
    force = run.contact_force[touching] if np.any(touching) else np.zeros(1)
    where = "" if np.all(touching) else "in contact" if np.any(touching) else "never in contact"
    end = facts["final_closure_error"]
    time = run.scenario.time
    scheme = scheme_of(time.integrator)
    step = "steps of its own" if time.integrator in ADAPTIVE else f"step {time.step:g} s"
    where_to = "along the surface" if run.scenario.has_surface else "across surface.normal"
    has_law = run.scenario.has_law or run.law != "scenario"
    path = [("path error, RMS", _shown(facts["rms_path_error"], ".2g"), "m", where_to)] if has_law else []
    tip: list[Row] = [
        (
            "contact force f at the end",
            _shown(facts["final_contact_force"], ".9g"),
            "N",
            commanded if touching[-1] else f"free; {commanded}",
        ),
        ("f, lowest and highest", f"{np.min(force):.4g} … {np.max(force):.4g}", "N", where),
        *_undetermined_rows(facts),
        *_direction_rows(facts),
        ("force error, RMS", _shown(facts["rms_force_error"], ".2g"), "N", "while it touches"),
        *path,
        ("the stabiliser's part of f", _shown(facts["max_stabiliser_force"], ".2g"), "N", absent),
        (
            "closure error |e|" if run.scenario.compliance.kind == "none" else "depth in the surface |e|",
            _shown(facts["max_abs_closure_error"], ".2g"),
            "m",
            f"{_shown(end, '.1g')} m at the end" if touching[-1] else f"a gap of {_shown(end, '.3g')} m at the end",
        ),
        ("closure rate |ė|", _shown(facts["max_abs_closure_rate"], ".2g"), "m/s", ""),
    ]
    return [
        *(tip if run.scenario.has_surface else path),
        ("residual of Eq. 24", _shown(facts["max_kkt_residual"], ".1g"), "relative", "rounding is 1e-16"),
        (
            "energy unaccounted for",
            _shown(facts["max_energy_residual"], ".2g"),
            "J",
            f"of {energy_at_stake(facts, facts['energy_gained'] is not None):.2g} J exchanged",
        ),
        (
            "order of the integrator",
            "not known" if scheme is None else f"{scheme.order}",
            "",
            f"{time.integrator}, {step}",
        ),
        *_step_rows(facts["step_error"]),
        ("tip speed", _shown(facts["max_tip_speed"], ".4g"), "m/s", ""),
        *_undriven_rows(run, facts),
        *_loop_rows(run),
        *contact_rows(run),
        *_joint_rows(run),
        *_tool_rows(run, facts),
        *_limited_rows(run),
        *_contact_rows(run, facts),
    ]


def _undetermined_rows(facts: dict[str, Any]) -> list[Row]:
    """Return since when f is not determined by rigid bodies, at an arm that rests on friction in its joints."""
    at = facts["force_not_determined_from"]
    if at is None:
        return []
    return [("f not determined by rigid bodies", f"from {at:.4g}", "s", "at rest; that of least friction is given")]


def _direction_rows(facts: dict[str, Any]) -> list[Row]:
    """Return by how much friction points away from the slip, where the step does not resolve how the slip turns."""
    off = facts["friction_off_slip"]
    if off is None:
        return []
    what = f"at {off['at']:.4g} s; of slip slower than {off['below_speed']:.2g} m/s, which turns within a step"
    return [("friction off the slip, at most", f"{off['max_angle']:.2g}", "deg", what)]


def _undriven_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return what becomes of the law's torque on joints without a drive: the drives give it, or it is lost."""
    of_bodies = run.model.of_bodies
    lost = facts["motions_without_drive"] - int(np.sum(of_bodies))
    undriven = np.flatnonzero(~run.model.driven & ~of_bodies)
    if not len(undriven):  # nobody expects a drive of a free body
        return []
    names = ", ".join(run.model.joint_names[j] for j in undriven)
    if lost:
        return [("motions without a drive", f"{lost}", "", f"torque asked there is lost: {names}")]
    where = "torque asked there is given by the drives, through the loops"
    return [("joints without a drive", f"{len(undriven)}", "", f"{where}: {names}")]


def _loop_rows(run: Record) -> list[Row]:
    """Return how far the loops of a mechanism were from closed, and what they carried."""
    found = run.loops
    if found is None:
        return []
    worst = int(np.argmax(np.max(np.abs(found.errors), axis=0)))
    m, least, most = found.errors.shape[1], int(np.min(found.rank)), int(np.max(found.rank))
    ranks = f"{least}" if least == most else f"{least} to {most}"
    rows = [("loops: error", f"{np.max(np.abs(found.errors)):.2g}", "m (rad)", found.joints[worst])]
    for unit in ("N", "N m"):
        at = [k for k, own in enumerate(found.units) if own == unit]
        if at:
            largest = max(at, key=lambda k: float(np.max(np.abs(found.reactions[:, k]))))
            size = float(np.max(np.abs(found.reactions[:, largest])))
            rows.append(("loops: reaction", f"{size:.4g}", unit, found.labels[largest]))
    spare = "; reactions of least norm" if least < m else ""
    return [*rows, ("loops: independent rows", ranks, "", f"of {m}{spare}")]


def _joint_rows(run: Record) -> list[Row]:
    """Return how near to its limits the arm came, where it has any."""
    found = joint_measures(run)
    rows = []
    for title, key, limit in (
        ("joint speed, of its limit", "max_joint_velocity", run.model.velocity_limit),
        ("joint torque, of its limit", "max_joint_torque", run.model.effort_limit),
    ):
        share = np.divide(found[key], limit, where=limit > 0.0, out=np.full(run.model.n, np.inf))
        j = int(np.argmax(share))
        if np.any(np.isfinite(limit)):
            rows.append((title, f"{100.0 * share[j]:.3g}", "%", f"joint {run.model.joint_names[j]}"))
    return rows


def _tool_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return how the tool is turned, where that is asked for, and what it bears, if the arm carries one."""
    rows, wrist, tool = [], facts["wrist"], facts["tool"]
    if tool is not None:
        error, angle = _shown(tool["max_orientation_error"], ".3g"), _shown(tool["max_angle"], ".3g")
        rows.append(("tool from its orientation", error, "deg", f"its axis {angle} deg from the normal"))
    if wrist is not None:
        force, moment = _shown(wrist["max_force"], ".4g"), _shown(wrist["max_moment"], ".4g")
        at = f"at the frame {run.scenario.robot.tip or run.model.tip}"
        rows.append(("force between arm and tool", force, "N", f"moment {moment} N m, {at}"))
    return rows


def _limited_rows(run: Record) -> list[Row]:
    """Return a row for each joint whose torque a limit of the drives cut."""
    found, rows = joint_measures(run), []
    for j, at in enumerate(found["torque_limited_at"]):
        if np.isfinite(at):
            kinds = np.unique(run.torque_limited[:, j])
            what = " and ".join(word for kind, word in _LIMITS.items() if kind in kinds)
            share = f"{100.0 * found['torque_limited_share'][j]:.3g}"
            where = f"joint {run.model.joint_names[j]}, first at {at:.4g} s: {what}"
            rows.append(("torque cut, of the time", share, "%", where))
    return rows


def _shown(value: float | None, form: str) -> str:
    """Return a value of the summary as text; None is one that is no finite number."""
    return "not known" if value is None else format(value, form)


def _contact_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return what a run in which contact changes has to say beside the rest."""
    counts = ", ".join(
        f"{count} {kind.replace('_', ' ')}{'s' * (count > 1)}" for kind, count in facts["events"].items() if count
    )
    rows = [("events", str(len(run.events)), "", counts)] if run.events else []
    at_links = bool(run.scenario.contact) and np.any(run.link_frictions)
    if facts["max_friction_force"] or facts["max_joint_friction"] or at_links:
        rows.append(("energy lost to friction", _shown(facts["energy_lost_to_friction"], ".3g"), "J", ""))
    if run.scenario.surface.contact == "bilateral":
        return rows
    cut = facts["largest_rate_cut"] or 0.0
    if run.scenario.has_surface:
        rows += [
            ("time in contact", _shown(facts["time_in_contact"], ".4g"), "s", f"of {run.time[-1]:g} s"),
            ("deepest penetration", _shown(facts["deepest_penetration"], ".2g"), "m", ""),
        ]
    if facts["events"]["impact"] or facts["events"]["touchdown"]:
        what = f"bounce cut: {cut:.2g} m/s" if cut > 0.0 else "no bounce was cut"
        if rested := facts["energy_taken_at_rest"]:
            what += f", {rested:.2g} J taken to rest"
        rows.append(("energy lost in impacts", _shown(facts["energy_lost_in_impacts"], ".3g"), "J", what))
    return rows


def _step_rows(found: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows of the error of the step, see `closedloop.record.report.halved.step_error`."""
    said = [("f differs by", found["force"], "N"), ("tip differs by", found["position"], "m")]
    known = [
        (label, f"{error:.2g}", unit, "from the run at half the step")
        for label, error, unit in said
        if error is not None
    ]
    return known or [("error of the step", "not known", "", found["why_not"])]
