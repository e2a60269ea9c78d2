"""Reading a run that `closedloop.record.save` wrote. Nothing is trusted: what is not exactly a run is refused.

Files from before there were digests, or with fewer columns, are read too; of them only what cannot be a run is refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ClosedLoopError, RunFileError, faults_on_one_line
from closedloop.base.files import reason_of
from closedloop.loop.events.phases import INSTANT
from closedloop.loop.events.table import KINDS
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.surface.placed import unit
from closedloop.record.columns.derived import from_text
from closedloop.record.columns.record import (
    ALL_COLUMNS,
    CONTACT_COLUMNS,
    RESISTANCE_COLUMNS,
    SURFACE_COLUMNS,
    Column,
    columns_there,
)
from closedloop.record.netcdf_file import read_sealed
from closedloop.record.report.halved import checked_comparison
from closedloop.record.run import Run
from closedloop.record.save import (
    ADDED,
    ATTRIBUTES,
    CHECKSUM,
    FORMAT,
    FORMAT_VERSION,
    HALVED,
    LATER_TEXTS,
    MEMBERS,
    TEXTS,
    checksum,
    not_finite,
)
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

# Of instants, relative.
ROUNDING = 1e-14
# What files from before there was a checksum may lack.
_LATER = dict(zip(LATER_TEXTS, ("pinocchio", "", '["kkt_condition"]'), strict=True))
# Columns that files of earlier versions may lack, and a column as long: what nobody wrote down is NaN.
_LATER_COLUMNS = {
    "energy_supplied": "time",
    "event_restitution": "event_time",
    "event_contact": "event_time",
    "event_energy_rested": "event_time",
}


@arguments_checked()
def load_run(path: str | Path) -> Run:
    """Read a run that `save_run` wrote, in this or an earlier version of this format; a missing column is NaN.

    A user's class that its scenario picks is not imported: the run can be looked at, and repeated once the class is
    named, as ``load_scenario`` and ``--reference.kind my_module:MyPath`` do.

    Raises
    ------
    RunFileError
        If there is no such file, or it is not a run, or it is damaged.
    """
    path = Path(path)
    try:
        run = _run_of(*read_sealed(path, list(ALL_COLUMNS)))
    except KeyError as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {error} is missing") from None
    except ClosedLoopError as error:
        raise RunFileError(f"{path}: {faults_on_one_line(error)}") from None
    except RecursionError:
        raise RunFileError(f"{path}: is damaged: an attribute is nested too deep") from None
    except (OSError, ValueError, TypeError, AttributeError, ArithmeticError, LookupError, RuntimeError) as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {reason_of(error)}") from None
    return run


def _run_of(found: Mapping[str, Any], columns: dict[str, NDArray[Any]]) -> Run:
    """Make a run of what a file holds, which may be anything."""
    if found.get("format") != FORMAT:
        raise RunFileError(f"is not a run file (its 'format' attribute is not '{FORMAT}')")
    version = int(found["format_version"])
    if version != FORMAT_VERSION:
        age, cure = ("a newer", "") if version > FORMAT_VERSION else ("an older", "; run its scenario again")
        raise RunFileError(f"was written by {age} version: format {version}, this one reads {FORMAT_VERSION}{cure}")
    if CHECKSUM in found:
        _verify(found, columns)
    # Another program may have written numbers in another machine's order of bytes, which few libraries take.
    columns = {name: column.astype(column.dtype.newbyteorder("="), copy=False) for name, column in columns.items()}
    found = _LATER | dict(found)
    if wrong := [key for key in (*TEXTS, *_LATER) if not isinstance(found[key], str)]:
        raise RunFileError(f"is damaged: attribute '{wrong[0]}' is not text")
    robot, versions = json.loads(found["robot"]), json.loads(found["versions"])
    if not (isinstance(robot, dict) and isinstance(versions, dict) and isinstance(robot.get("name"), str)):
        raise RunFileError("is damaged: its attributes 'robot' and 'versions' must be tables")
    if not all(isinstance(text, str) for text in versions.values()):
        raise RunFileError("is damaged: attribute 'versions' must be a table of texts")
    members = json.loads(found.get(MEMBERS, "{}"))
    if not (isinstance(members, dict) and all(isinstance(text, str) for text in members.values())):
        raise RunFileError(f"is damaged: attribute '{MEMBERS}' must be a table of texts")
    if found["engine"] not in ("pinocchio", "compiled"):
        raise RunFileError(f"is damaged: attribute 'engine' is {found['engine'][:40]!r}")
    if not 0.0 <= float(found["wall_seconds"]) < math.inf:
        raise RunFileError(f"is damaged: attribute 'wall_seconds' is {found['wall_seconds']}")
    model = robot_models.from_text(found["robot_text"], **robot)
    scenario = parse_scenario(found["scenario"], where="attribute 'scenario'", keep_absent=True)
    _add_plane(columns, scenario)
    absent = [name for name in _LATER_COLUMNS if name not in columns]
    columns |= {name: np.full(columns[_LATER_COLUMNS[name]].size, np.nan) for name in absent}
    allowed = [*json.loads(found["not_finite"]), *absent]
    added = from_text(found[ADDED]) if ADDED in found else {}
    sections = scenario.contact or ()
    contacts, resists = len(sections), any(section.resists for section in sections)
    of_contacts = [name for name in CONTACT_COLUMNS if resists or name not in RESISTANCE_COLUMNS]
    needed = (*(of_contacts if contacts else ()), *(SURFACE_COLUMNS if scenario.has_surface else ()))
    _check_columns(columns, added, _sizes(model, contacts), allowed, needed)
    # A run that was stopped may have events in the step that it did not finish.
    _check_events(columns, model.n + contacts, scenario.time.step if found["stopped"] else 0.0)
    return Run(  # type: ignore[abstract]  # its columns are there by their names
        scenario=scenario,
        model=model,
        columns=columns,
        law=found["law"],
        versions=versions,
        stopped=found["stopped"] or None,
        wall_seconds=float(found["wall_seconds"]),
        engine=found["engine"],
        law_digest=found["law_digest"],
        member_digests=members,
        added=added,
        halved=checked_comparison(json.loads(found[HALVED])) if HALVED in found else None,
    )


def _sizes(model: RobotModel, contacts: int) -> dict[str, int]:
    """Return the lengths of the dimensions that a model and a scenario give."""
    turning = {"coordinate": len(model.coordinate_names)} if model.balls else {}
    return {"joint": model.n, "contact": contacts} | turning


def _add_plane(columns: dict[str, NDArray[Any]], scenario: Scenario) -> None:
    """Add what a file from before there were other surfaces than a plane at rest does not have."""
    if "surface_normal" in columns or not scenario.has_surface or np.shape(columns["velocity"])[1:] != (3,):
        return
    n, v = unit(scenario.surface.normal, "surface.normal"), columns["velocity"]
    columns["surface_normal"] = np.tile(n, (len(v), 1))
    columns["slip_velocity"] = v - np.outer(v @ n, n)


def _verify(found: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> None:
    """Compare the checksum with that of what was written, whatever else another program has added since."""
    ours = {name: value for name, value in found.items() if name in ATTRIBUTES}
    if found[CHECKSUM] != checksum(ours, columns):
        raise RunFileError("is damaged, or was changed: its checksum is not that of its columns and attributes")


def _check_columns(
    columns: Mapping[str, NDArray[Any]], added: Mapping[str, Column], known: dict[str, int], allowed: list[str],
    needed: tuple[str, ...],
) -> None:  # fmt: skip
    sizes = {"time": columns["time"].size, "axis": 3, "event": columns["event_time"].size}
    sizes |= known | {"contact_tangent": 2 * known["contact"]}
    for name, spec in (columns_there({*columns, *needed}, "coordinate" in known) | dict(added)).items():
        column = columns[name]
        own = column.shape[-1] if column.ndim == 2 else 0  # a column of one's own has as many parts as it has
        shape = tuple(sizes.get(dim, own) for dim in spec.dims)
        if column.shape != shape or column.dtype.kind not in "fi":
            raise RunFileError(
                f"is damaged: column '{name}' is {column.dtype} of shape {column.shape}, not numbers of shape {shape}"
            )
    if wrong := [name for name in not_finite(columns) if name not in allowed]:
        raise RunFileError(f"is damaged: column '{wrong[0]}' has entries that are not finite numbers")
    _check_values(columns)


# Columns of whole numbers, and what each may be.
_KNOWN: dict[str, tuple[int, ...]] = {
    "mode": (FREE, PRESSED, STUCK), "link_modes": (FREE, PRESSED, STUCK), "torque_limited": (0, 1, 2),
    "event_kind": tuple(KINDS),
}  # fmt: skip


def _check_values(columns: Mapping[str, NDArray[Any]]) -> None:
    """Refuse what no run can hold: time that does not go on, unknown modes and kinds."""
    time = columns["time"]
    if time.size and (time[0] != 0.0 or not np.all(np.diff(time) > 0.0)):
        raise RunFileError("is damaged: column 'time' does not go from 0 upwards, row by row")
    for name, known in _KNOWN.items():
        if name in columns and (wrong := columns[name][~np.isin(columns[name], known)]).size:
            raise RunFileError(
                f"is damaged: column '{name}' has {wrong[0]:g}, which is none of {', '.join(map(str, known))}"
            )


def _check_events(columns: Mapping[str, NDArray[Any]], most: int, beyond: float) -> None:
    """Refuse events out of order, later than `beyond`, s, after the last row, or of more contacts than the `most`."""
    instants, which = columns["event_time"], columns["event_contact"]
    if not instants.size:
        return
    if not (instants[0] >= 0.0 and np.all(np.diff(instants) >= 0.0)):
        raise RunFileError("is damaged: column 'event_time' does not go from 0 upwards")
    end = float(columns["time"][-1]) if columns["time"].size else 0.0
    if instants[-1] > end + beyond + INSTANT + ROUNDING * end:
        raise RunFileError(f"is damaged: column 'event_time' has {instants[-1]:g} s, and the run ends at {end:g} s")
    if (wrong := which[(which < 0) | (which > most)]).size:
        raise RunFileError(f"is damaged: column 'event_contact' has {wrong[0]:g}: the run has contacts 0 to {most}")
