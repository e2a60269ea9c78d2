"""By how much a run differs from the same at half the step: every value of its summary, its main columns, its events.

Rows are compared at the common instants, every second row of the other run. An event is compared with the one of its
kind, and of its contact, that has the same number. The error of the step that a run states is this difference of the
contact force and of the tip's position, for any scheme: apart from rows beside a change of the mode of contact, where
the force jumps at an instant that moves with the step, and which the table of events has.
"""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, plain
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.columns.record import Record
from closedloop.record.report.measures import MEASURES

MAIN_COLUMNS = (
    "q", "v", "torque", "position", "velocity", "contact_force", "friction_force", "joint_friction", "measured_force",
    "closure_error", "closure_rate", "kinetic_energy", "motor_position", "transmitted_torque", "link_forces",
)  # fmt: skip
# Why the error of the step is not known of a run that was not compared.
NOT_HALVED = "it was not run again at half the step"
OWN_STEPS = "the integrator chooses its steps: time.tolerance sets its error"
# Rows before and after a change of mode that are beside it: a row is recorded before what happens in its step.
BESIDE = (-1, 0, 1, 2)
# A change of mode moves with the step by this many rows at most; where the modes differ for longer, so do the runs.
MOVES = 20


def halved_comparison(run: Record, other: Record) -> dict[str, Any]:
    """Return what differs between a run and the same at half its step, as the part ``halved`` of its summary.

    ``step``, s, of the other; ``stopped``, why it could not go on, or None; ``rows`` compared; ``modes_differ``, in how
    many of them the mode of contact does; ``force`` and ``position``, the measured errors of the step, N and m, None
    without rows; ``columns``, ``values`` and ``events``, see below. It is strict JSON: what is no number is None.
    """
    count = min(len(run), (len(other) + 1) // 2)
    kept = _away_from_changes(run.mode[:count], other.mode[::2][:count])
    both = (run.mode[:count] != FREE) | (other.mode[::2][:count] != FREE)
    force = np.abs(run.contact_force[:count] - other.contact_force[::2][:count]) * both
    position = np.linalg.norm(run.position[:count] - other.position[::2][:count], axis=1)
    return {
        "step": other.scenario.time.step,
        "stopped": other.stopped,
        "rows": count,
        "modes_differ": int(np.count_nonzero(run.mode[:count] != other.mode[::2][:count])),
        "force": plain(np.max(force[kept])) if np.any(kept) else None,
        "position": plain(np.max(position[kept])) if np.any(kept) else None,
        "columns": {
            name: _column(run, getattr(run, name)[:count], getattr(other, name)[::2][:count], name)
            for name in MAIN_COLUMNS
            if count and (name in run.columns)
        },
        "values": _values(run.summary(), other.summary()),
        "events": _events(run, other),
    }


def _away_from_changes(mode: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which rows are not beside a change of mode of either run, nor between two that are the same one."""
    kept = np.ones(mode.size, dtype=bool)
    for own in (mode, other):
        changes = np.flatnonzero(np.diff(own))
        for offset in BESIDE:
            kept[np.clip(changes + offset, 0, mode.size - 1)] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mode != other, [False]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        kept[begin:end] = end - begin > MOVES
    return kept


def _column(run: Record, column: Array, other: Array, name: str) -> dict[str, Any]:
    """Return the largest difference of a column, its root mean square over the rows, its unit, and when it is, s.

    Of a vector it is the length of the difference; of joints and contacts that of the one that differs most.
    """
    off = np.abs(column - other)
    if off.ndim == 2 and off.shape[1]:
        vector = off.shape[1] == 3 and name in ("position", "velocity", "friction_force")
        off = np.linalg.norm(off, axis=1) if vector else np.max(off, axis=1)
    at = int(np.argmax(off))
    return {
        "max": plain(off[at]),
        "rms": plain(np.sqrt(np.mean(off * off))),
        "unit": run.units(name),
        "at": float(run.time[at]),
    }


def _values(own: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each value of both summaries, by how much they differ, None where one does not exist, and its unit."""
    return {
        name: {
            "value": own[name],
            "at_half": other[name],
            "difference": None if None in (own[name], other[name]) else abs(own[name] - other[name]),
            "unit": measure.units,
        }
        for name, measure in MEASURES.items()
    }


def _events(run: Record, other: Record) -> dict[str, dict[str, Any]]:
    """Return of each kind of event how many both runs have, and by how much their instants differ at most, s."""
    found: dict[str, list[dict[int, list[float]]]] = {}
    for k, each in enumerate((run, other)):
        for event in each.events:
            of_kind = found.setdefault(event.kind, [defaultdict(list), defaultdict(list)])
            of_kind[k][event.contact].append(event.time)
    compared: dict[str, dict[str, Any]] = {}
    for kind, (own, others) in found.items():
        moved = [
            (abs(a - b), a) for contact, times in own.items() for a, b in zip(times, others[contact], strict=False)
        ]
        most, at = max(moved, default=(None, None))
        compared[kind] = {
            "count": sum(map(len, own.values())),
            "at_half": sum(map(len, others.values())),
            "max_time_difference": most,
            "at": at,
        }
    return compared


def step_error(run: Record) -> dict[str, Any]:
    """Return the part ``step_error`` of the summary: by how much f, N, and the tip, m, differ at half the step.

    ``force`` and ``position`` are None where they are not known; ``why_not`` says why, or is None. Without a surface
    there is no f.
    """
    if run.halved is None:
        own = run.scenario.time.integrator in ADAPTIVE
        return {"force": None, "position": None, "why_not": OWN_STEPS if own else NOT_HALVED}
    found = {"force": run.halved["force"] if run.scenario.has_surface else None, "position": run.halved["position"]}
    return found | {"why_not": None if run.halved["rows"] else "no row could be compared"}


def halved_rows(halved: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows of the block of a report: quantity, by how much it differs, unit, and what stands beside it."""
    rows = [
        (name, _shown(each["max"]), each["unit"], f"at {each['at']:.4g} s; RMS {_shown(each['rms'])}")
        for name, each in halved["columns"].items()
        if each["max"] != 0.0
    ]
    rows += [
        (name, _shown(each["difference"]), each["unit"], f"{_shown(each['value'])}, then {_shown(each['at_half'])}")
        for name, each in halved["values"].items()
        if each["value"] != each["at_half"]
    ]
    for kind, each in halved["events"].items():
        counts = f"{each['count']}, then {each['at_half']}"
        beside = counts if each["at"] is None else f"{counts}; instants, most at {each['at']:.4g} s"
        rows.append((f"events: {kind}", _shown(each["max_time_difference"]), "s", beside))
    if halved["modes_differ"]:
        rows.append(("mode", str(halved["modes_differ"]), "rows", f"of {halved['rows']}"))
    return rows


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"
