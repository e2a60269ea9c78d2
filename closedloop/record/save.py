"""Writing a run as a file: NetCDF-4, which is HDF5, with everything that is needed to repeat it as attributes.

xarray, h5py and MATLAB open it. Two digests tell damage: the file's seal (`closedloop.record.netcdf_file`), of all its
bytes, and the attribute `checksum`, of what a run is made of, which still holds when another program has added to the
file. `closedloop.record.load` reads it.
"""

import hashlib
import json
import sys
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.record.columns.derived import as_text, columns_by_contact
from closedloop.record.columns.record import Record, in_order
from closedloop.record.netcdf_file import Variable, seal_file, write_netcdf
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import labels_of, tangents_of
from robot_models import RobotModel


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages whose arithmetic a run depends on."""
    return dict(_package_versions())


@cache
def _package_versions() -> dict[str, str]:
    names = ("closedloop", "pin", "numpy", "numba", "llvmlite")
    return {"python": sys.version.split()[0]} | {name: _version(name) for name in names}


@cache
def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


FORMAT, FORMAT_VERSION = "closedloop run", 2
# Endings of files in this format, and the metadata conventions that their units and names follow.
HDF5 = (".nc", ".h5")
CONVENTIONS = {"Conventions": "CF-1.11"}
CHECKSUM = "checksum"
# Attributes that are text.
TEXTS = ("scenario", "robot_text", "robot", "law", "versions", "stopped", "engine", "law_digest", "not_finite")
# An attribute of a run with users' classes only: JSON of their names and the SHA-256 of their texts.
MEMBERS = "members"
# An attribute of a run that has columns beyond those of all runs: see `closedloop.record.columns.derived`.
ADDED = "added"
# An attribute of a run that was compared with one at half its step: JSON, see `closedloop.record.report.halved`.
HALVED = "halved"
# What the checksum is of.
ATTRIBUTES = {
    ADDED, "format", "format_version", "seed", "wall_seconds", "summary", *TEXTS, MEMBERS, HALVED,
}  # fmt: skip


def question(
    scenario: Scenario, model: RobotModel, law: str, law_digest: str, engine: str, members: Mapping[str, str]
) -> dict[str, str]:
    """Return what determines a run to the last bit, on one machine, as the texts that its file has as attributes.

    `members` are the digests of the users' classes, see `closedloop.scenario.user_module.member_digests`.
    """
    robot = {name: getattr(model, name) for name in ("name", "format", "tip", "description", "source")}
    robot |= {name: getattr(model, name).tolist() for name in ("armature", "home", "gravity")}
    robot["locked"] = dict(model.locked)
    if model.loops or model.drives:  # a tree has none, in files of any version
        robot |= {"loops": [loop.as_table() for loop in model.loops], "drives": list(model.drives or ())}
    if model.drives == ():
        robot["undriven"] = True
    return {
        "scenario": scenario.to_toml(),
        "robot_text": model.text,
        "robot": json.dumps(robot),  # floats in their shortest exact form
        "law": law,
        "law_digest": law_digest,
        "engine": engine,
    } | ({MEMBERS: json.dumps(dict(sorted(members.items())))} if members else {})


def attributes(run: Record) -> dict[str, Any]:
    """Return what made the run, as plain text and numbers."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **question(run.scenario, run.model, run.law, run.law_digest, run.engine, run.member_digests),
        "seed": _seed(run),
        "versions": json.dumps(dict(run.versions)),
        "stopped": run.stopped or "",
        "wall_seconds": run.wall_seconds,
        "not_finite": json.dumps(not_finite(run.columns)),
        "summary": json.dumps(run.summary()),
        **({ADDED: as_text(run.added)} if run.added else {}),
        **({HALVED: json.dumps(dict(run.halved))} if run.halved is not None else {}),
    }


def _seed(run: Record) -> str:
    sensor, encoder = run.scenario.sensor, run.scenario.encoder
    noisy = np.max(encoder.noise) > 0.0 or np.max(encoder.velocity_noise) > 0.0
    drawn = [f"{sensor.seed}: the noise of the force sensor"] if sensor.noise > 0.0 else []
    drawn += [f"{encoder.seed}: the noise of the encoders"] if noisy else []
    if drawn:
        return f"{', '.join(drawn)}; nothing else in this run is random"
    return "none: nothing in this run is random"


def not_finite(columns: Mapping[str, NDArray[Any]]) -> list[str]:
    """Return the columns in which a number is infinite or none at all."""
    return [name for name in in_order(columns) if not np.all(np.isfinite(columns[name]))]


def checksum(found: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the attributes of a file, its own left out, and of the columns of a run that it has.

    Each attribute in order of the alphabet as the JSON of [name, value]; each column as that of [name, type, shape] and
    its bytes, rows first.
    """
    total = hashlib.sha256()
    for name in sorted(found):
        total.update(json.dumps([name, found[name]]).encode())
    for name in in_order(columns):
        column = np.ascontiguousarray(columns[name])
        total.update(json.dumps([name, column.dtype.str, column.shape]).encode())
        total.update(column.data.cast("B") if column.size else b"")
    return f"sha256:{total.hexdigest()}"


def save_run(run: Record, path: str | Path) -> Path:
    """Write a run and return the path; an older file is replaced only once the new one is whole.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    variables = {
        name: Variable(spec.dims, np.asarray(run.columns[name]), {"units": run.units(name), "long_name": spec.meaning})
        for name, spec in run.specs.items()
    }
    labels = {
        "joint": ("joint", run.model.joint_names),
        "joint_type": ("joint", run.model.joint_types),
        "axis": ("axis", ("x", "y", "z")),
    }
    if run.model.balls:
        labels["coordinate"] = ("coordinate", run.model.coordinate_names)
    if run.scenario.contact:
        names = labels_of(run.scenario.contact)
        labels |= {"contact": ("contact", names), "contact_tangent": ("contact_tangent", tangents_of(names))}
        for name, (whole, k) in columns_by_contact(run.scenario.contact).items():  # again, each by its contact's name
            told = variables[whole].attributes
            variables[name] = Variable(("time",), run.columns[whole][:, k], told)
    for name, (dimension, words) in labels.items():
        variables[name] = Variable((dimension,), np.array(words, dtype=object))
    dimensions = {"time": len(run), "joint": run.model.n, "axis": 3, "event": len(run.events)}
    if run.model.balls:
        dimensions["coordinate"] = len(run.model.coordinate_names)
    if contacts := len(run.scenario.contact or ()):
        dimensions |= {"contact": contacts, "contact_tangent": 2 * contacts}
    own = {spec.dims[1]: run.columns[name].shape[1] for name, spec in run.added.items() if len(spec.dims) == 2}
    dimensions = own | dimensions
    made = attributes(run)
    made |= {CHECKSUM: checksum(made, run.columns)}
    return write_netcdf(Path(path), dimensions, variables, CONVENTIONS | made, seal_file)
