"""The values that answer whether a run is good: both verdicts, errors of the force, margins, energy, limits.

A tile has a name, a value in words, and whether it is good where a verdict or a bound says so. Beside it stands how it
differs from the run that it is compared with, and whether that is better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from closedloop.mechanics.closure.contact_force import FREE
from closedloop.record.clearance import passing_note
from closedloop.record.report.control_verdict import told
from closedloop.record.report.verdict import names_of
from closedloop.record.run import Run

Tile = dict[str, Any]

# Values that differ by no more than this share are equal: no digit that is shown differs.
ALIKE = 5e-4
# By name: the value of the summary, its unit, what it is, whether less is better, and the factor to its unit.
NUMBERS: dict[str, tuple[str, str, str, bool, float]] = {
    "force RMS": ("rms_force_error", "N", "RMS error of the contact force over the rows in contact", True, 1.0),
    "force peak": ("peak_force_error", "N", "largest error of the contact force in contact", True, 1.0),
    "settled": ("force_settled_at", "s", "instant from which f stays within 2 % of what is desired", True, 1.0),
    "path RMS": ("rms_path_error", "mm", "RMS distance of the tip from its path, along the surface", True, 1e3),
    "in contact": ("time_in_contact", "s", "time in contact", False, 1.0),
    "torque": ("torque_share", "%", "largest torque as a share of that joint's own limit", True, 100.0),
    "energy error": ("max_energy_residual", "J", "largest energy unaccounted for", True, 1.0),
    "friction loss": ("energy_lost_to_friction", "J", "energy lost to friction, of the tip and the joints", True, 1.0),
    "step error": ("step_error", "N", "by how much f differs in a run at half the step", True, 1.0),
}  # fmt: skip
MARGINS: dict[str, tuple[str, str, str]] = {
    "gain margin": ("gain", "x", "the factor by which the loop's gain may rise until it is unstable"),
    "phase margin": ("phase", "deg", "by which the phase may lag where the loop's gain is 1"),
    "delay margin": ("delay", "ms", "the delay that the loop may have in addition"),
}


def values(run: Run, summary: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers of the strip: of the summary, and the largest error of f and share of a torque's limit."""
    found = {key: summary.get(key) for key, *_ in NUMBERS.values()} | {"step_error": summary["step_error"]["force"]}
    touching = run.mode != FREE
    off = np.abs(run.contact_force - run.reference_force)[touching]
    found["peak_force_error"] = float(np.max(off)) if off.size and run.scenario.has_surface else None
    limits = run.model.effort_limit
    limited = np.flatnonzero(np.isfinite(limits) & (limits > 0.0) & run.model.driven)
    shares = [
        summary["joints"][run.model.joint_names[j]]["max_joint_torque"] / limits[j]
        for j in limited
        if summary["joints"][run.model.joint_names[j]]["max_joint_torque"] is not None
    ]
    found["torque_share"] = max(shares, default=None)
    return found


def tiles(
    run: Run, summary: Mapping[str, Any], before: Mapping[str, float | None] | None = None, name: str = ""
) -> list[Tile]:
    """Return the tiles of a run; `before` are the `values` of another, which is called `name`."""
    numbers, control = values(run, summary), summary["control_verdict"]
    found = [
        _verdict("numbers", summary["verdict"]["problems"], names_of(summary["verdict"]["problems"]),
                 "whether the numbers of this run can be trusted"),
    ]  # fmt: skip
    if run.scenario.has_law or control["problems"]:  # without a law nothing is commanded
        why = "whether the arm did what was commanded"
        found.append(_verdict("control", control["problems"], told(summary), why))
    for label, (key, unit, hint, less, factor) in NUMBERS.items():
        number = numbers[key]
        needless = {"energy_lost_to_friction": 0.0, "time_in_contact": run.time[-1] - run.time[0]}.get(key)
        if number is None or (needless is not None and abs(number - needless) < run.scenario.time.step):
            continue
        tile = _tile(label, factor * number, unit, hint)
        if key == "torque_share" and number > 1.0:
            tile["good"] = False
        found.append(tile | _change(number, None if before is None else before.get(key), less, factor, name))
    if passing := passing_note(summary["clearance"]):
        near = summary["clearance"]
        found.append(
            {"name": "clearance", "text": f"{1e3 * near['distance']:.3g}", "unit": "mm", "hint": passing,
             "good": False, "at": near["time"]}
        )  # fmt: skip
    return found


def margin_tiles(margins: Mapping[str, Any], stable: bool, before: Mapping[str, Any] | None, name: str) -> list[Tile]:
    """Return the tiles of a loop's margins, as `Margins.as_dict` gives them, beside those of another."""
    if not stable:
        return [{"name": "loop", "text": "unstable", "unit": "", "hint": "a pole of the loop grows", "good": False}]
    found = []
    for label, (key, unit, hint) in MARGINS.items():
        factor = 1e3 if key == "delay" else 1.0
        number, other = margins.get(key), None if before is None else before.get(key)
        if number is None:
            found.append({"name": label, "text": "any", "unit": "", "hint": f"{hint}: at no value", "good": None})
        else:
            found.append(_tile(label, factor * number, unit, hint) | _change(number, other, False, factor, name))
    return found


def _tile(label: str, number: float, unit: str, hint: str) -> Tile:
    return {"name": label, "text": f"{number:.3g}", "unit": unit, "hint": hint, "good": None}


def _verdict(label: str, problems: Sequence[Mapping[str, Any]], text: str, hint: str) -> Tile:
    why = "; ".join(problem["text"] for problem in problems)
    at = next((problem["at"] for problem in problems if problem.get("at") is not None), None)
    return {
        "name": label, "text": text.replace("_", " "), "unit": "", "hint": f"{hint}: {why}" if why else hint,
        "good": not problems, "at": at, "why": why,
    }  # fmt: skip


def _change(number: float, before: float | None, less: bool, factor: float, name: str) -> Tile:
    """Return how a value differs from that of another run, and whether it is better."""
    if before is None:
        return {}
    change = number - before
    if abs(change) <= ALIKE * max(abs(number), abs(before)):
        return {}
    return {"change": f"{factor * change:+.2g}", "better": (change < 0.0) == less, "against": name}
