"""A run as a file: NetCDF-4, which is HDF5, with everything that is needed to repeat it as attributes.

xarray, h5py and MATLAB open it. Reading trusts nothing: what is not exactly a run is refused with the file's name. Two
digests tell damage: the file's seal (`closedloop.record.sealed`), of all its bytes, and the attribute `checksum`, of
what a run is made of, which still holds when another program has added to the file. Files from before there were any
are read too; of them only what cannot be a run is refused.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.contacts.names import names_of, tangents_of
from closedloop.errors import ClosedLoopError, RunFileError, faults_on_one_line
from closedloop.files import reason_of, write_whole
from closedloop.record.netcdf_image import Variable, netcdf_image
from closedloop.record.run import ALL_COLUMNS, Run, columns_there
from closedloop.record.sealed import read_sealed, seal
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.scenario import Scenario
from closedloop.surface.plane import unit
from robot_models import RobotModel

FORMAT, FORMAT_VERSION = "closedloop run", 2
CHECKSUM = "checksum"
# Attributes that must be text, and that files from before there was a checksum may lack.
_TEXTS = ("scenario", "robot_text", "robot", "law", "versions", "stopped")
_LATER = {"engine": "pinocchio", "law_digest": "", "not_finite": '["kkt_condition"]'}
# An attribute of a run with users' classes only: JSON of their names and the SHA-256 of their texts.
MEMBERS = "members"
# Columns that files of earlier versions may lack, and a column as long: what nobody wrote down is NaN.
_LATER_COLUMNS = {"energy_supplied": "time", "event_restitution": "event_time", "event_contact": "event_time"}
# What the checksum is of.
ATTRIBUTES = {"format", "format_version", "seed", "wall_seconds", "summary", *_TEXTS, *_LATER, MEMBERS}


def question(
    scenario: Scenario, model: RobotModel, law: str, law_digest: str, engine: str, members: Mapping[str, str]
) -> dict[str, str]:
    """Return what determines a run to the last bit, on one machine, as the texts that its file has as attributes.

    `members` are the digests of the users' classes, see `closedloop.scenario.members.member_digests`.
    """
    robot = {name: getattr(model, name) for name in ("name", "format", "tip", "description", "source")}
    robot |= {name: getattr(model, name).tolist() for name in ("armature", "home", "gravity")}
    robot["locked"] = dict(model.locked)
    if model.loops or model.drives:  # a tree has none, in files of any version
        robot |= {"loops": [loop.as_table() for loop in model.loops], "drives": list(model.drives)}
    return {
        "scenario": scenario.to_toml(),
        "robot_text": model.text,
        "robot": json.dumps(robot),  # floats in their shortest exact form
        "law": law,
        "law_digest": law_digest,
        "engine": engine,
    } | ({MEMBERS: json.dumps(dict(sorted(members.items())))} if members else {})


def attributes(run: Run) -> dict[str, Any]:
    """Return what made the run, as plain text and numbers."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **question(run.scenario, run.model, run.law, run.law_digest, run.engine, run.member_digests),
        "seed": _seed(run),
        "versions": json.dumps(dict(run.versions)),
        "stopped": run.stopped or "",
        "wall_seconds": run.wall_seconds,
        "not_finite": json.dumps(_not_finite(run.columns)),
        "summary": json.dumps(run.summary()),
    }


def _seed(run: Run) -> str:
    sensor, encoder = run.scenario.sensor, run.scenario.encoder
    noisy = np.max(encoder.noise) > 0.0 or np.max(encoder.velocity_noise) > 0.0
    drawn = [f"{sensor.seed}: the noise of the force sensor"] if sensor.noise > 0.0 else []
    drawn += [f"{encoder.seed}: the noise of the encoders"] if noisy else []
    if drawn:
        return f"{', '.join(drawn)}; nothing else in this run is random"
    return "none: nothing in this run is random"


def _not_finite(columns: Mapping[str, NDArray[Any]]) -> list[str]:
    """Return the columns in which a number is infinite or none at all."""
    return [name for name in columns_there(columns) if not np.all(np.isfinite(columns[name]))]


def checksum(found: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the attributes of a file, its own left out, and of the columns of a run that it has.

    Each attribute in order of the alphabet as the JSON of [name, value]; each column as that of [name, type, shape] and
    its bytes, rows first.
    """
    total = hashlib.sha256()
    for name in sorted(found):
        total.update(json.dumps([name, found[name]]).encode())
    for name in (name for name in ALL_COLUMNS if name in columns):
        column = np.ascontiguousarray(columns[name])
        total.update(json.dumps([name, column.dtype.str, column.shape]).encode())
        total.update(column.tobytes())
    return f"sha256:{total.hexdigest()}"


def save_run(run: Run, path: str | Path) -> Path:
    """Write a run and return the path; an older file is replaced only once the new one is whole.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    variables = {
        name: Variable(spec.dims, np.asarray(run.columns[name]), {"units": run.units(name), "long_name": spec.meaning})
        for name, spec in columns_there(run.columns).items()
    }
    labels = {
        "joint": ("joint", run.model.joint_names),
        "joint_type": ("joint", run.model.joint_types),
        "axis": ("axis", ("x", "y", "z")),
    }
    if run.scenario.contact:
        names = names_of(run.scenario.contact)
        labels |= {"contact": ("contact", names), "contact_tangent": ("contact_tangent", tangents_of(names))}
    for name, (dimension, words) in labels.items():
        variables[name] = Variable((dimension,), np.array(words, dtype=object))
    dimensions = {"time": len(run), "joint": run.model.n, "axis": 3, "event": len(run.events)}
    if contacts := len(run.scenario.contact or ()):
        dimensions |= {"contact": contacts, "contact_tangent": 2 * contacts}
    made = attributes(run)
    content = netcdf_image(dimensions, variables, made | {CHECKSUM: checksum(made, run.columns)})

    def write(file: BinaryIO) -> None:
        file.write(content)
        file.write(seal(content))

    return write_whole(path, write)


def load_run(path: str | Path) -> Run:
    """Read a run that `save_run` wrote, now or in an earlier version with this format: a column it lacks is NaN.

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
    found = _LATER | dict(found)
    if wrong := [key for key in (*_TEXTS, *_LATER) if not isinstance(found[key], str)]:
        raise RunFileError(f"is damaged: attribute '{wrong[0]}' is not text")
    robot, versions = json.loads(found["robot"]), json.loads(found["versions"])
    if not (isinstance(robot, dict) and isinstance(versions, dict) and isinstance(robot.get("name"), str)):
        raise RunFileError("is damaged: its attributes 'robot' and 'versions' must be tables")
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
    _check_columns(columns, model.n, len(scenario.contact or ()), [*json.loads(found["not_finite"]), *absent])
    return Run(
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
    )


def _add_plane(columns: dict[str, NDArray[Any]], scenario: Scenario) -> None:
    """Add what a file from before there were other surfaces than a plane at rest does not have."""
    if "surface_normal" in columns or np.shape(columns["velocity"])[1:] != (3,):
        return
    n, v = unit(scenario.surface.normal, "surface.normal"), columns["velocity"]
    columns["surface_normal"] = np.tile(n, (len(v), 1))
    columns["slip_velocity"] = v - np.outer(v @ n, n)


def _verify(found: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> None:
    """Compare the checksum with that of what was written, whatever else another program has added since."""
    ours = {name: value for name, value in found.items() if name in ATTRIBUTES}
    if found[CHECKSUM] != checksum(ours, columns):
        raise RunFileError("is damaged, or was changed: its checksum is not that of its columns and attributes")


def _check_columns(columns: Mapping[str, NDArray[Any]], joints: int, contacts: int, not_finite: list[str]) -> None:
    sizes = {"time": columns["time"].size, "joint": joints, "axis": 3, "event": columns["event_time"].size}
    sizes |= {"contact": contacts, "contact_tangent": 2 * contacts}
    for name, spec in columns_there(columns).items():
        column, shape = columns[name], tuple(sizes[dim] for dim in spec.dims)
        if column.shape != shape or column.dtype.kind not in "fi":
            raise RunFileError(
                f"is damaged: column '{name}' is {column.dtype} of shape {column.shape}, not numbers of shape {shape}"
            )
    if wrong := [name for name in _not_finite(columns) if name not in not_finite]:
        raise RunFileError(f"is damaged: column '{wrong[0]}' has entries that are not finite numbers")
