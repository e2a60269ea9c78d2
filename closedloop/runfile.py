"""A run as a file: NetCDF-4, which is HDF5, with everything that is needed to repeat it as attributes.

xarray, h5py and MATLAB open it. Reading trusts nothing: what is not exactly a run is refused with the file's name.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.errors import ClosedLoopError, OutputError, RunFileError
from closedloop.record import COLUMNS, Run
from closedloop.scenario import parse_scenario

FORMAT, FORMAT_VERSION = "closedloop run", 2


def attributes(run: Run) -> dict[str, Any]:
    """Return what made the run, as plain text and numbers."""
    model = run.model
    robot = {name: getattr(model, name) for name in ("name", "format", "tip", "description", "source")}
    robot |= {name: getattr(model, name).tolist() for name in ("armature", "home", "gravity")}
    robot["locked"] = dict(model.locked)
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "scenario": run.scenario.to_toml(),
        "robot_text": model.text,
        "robot": json.dumps(robot),  # floats in their shortest exact form
        "law": run.law,
        "seed": "none: nothing in this run is random",
        "versions": json.dumps(dict(run.versions)),
        "stopped": run.stopped or "",
        "wall_seconds": run.wall_seconds,
        "summary": json.dumps(run.summary()),
    }


def save_run(run: Run, path: str | Path) -> Path:
    """Write a run and return the path; an older file is replaced only once the new one is whole.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    import h5netcdf
    import h5py

    path = Path(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with h5netcdf.File(unfinished, "w") as file:
            file.dimensions = {"time": len(run), "joint": run.model.n, "axis": 3, "event": len(run.events)}
            for name, spec in COLUMNS.items():
                variable = file.create_variable(name, spec.dims, data=np.asarray(run.columns[name]))
                variable.attrs["units"] = run.units(name)
                variable.attrs["long_name"] = spec.meaning
            labels = {
                "joint": ("joint", run.model.joint_names),
                "joint_type": ("joint", run.model.joint_types),
                "axis": ("axis", ("x", "y", "z")),
            }
            for name, (dimension, words) in labels.items():
                text = file.create_variable(name, (dimension,), dtype=h5py.string_dtype())
                text[:] = np.array(words, dtype=object)
            for key, value in attributes(run).items():
                file.attrs[key] = value
        unfinished.replace(path)
    except (OSError, ValueError) as error:
        with suppress(OSError, ValueError):
            unfinished.unlink(missing_ok=True)
        # h5py puts the inside of HDF5 into the text; the operating system's word is enough.
        number = getattr(error, "errno", None)
        reason = os.strerror(number) if number else str(error).splitlines()[0]
        raise OutputError(f"{path}: cannot be written: {reason}") from None
    return path


def load_run(path: str | Path) -> Run:
    """Read a run that `save_run` wrote.

    Raises
    ------
    RunFileError
        If there is no such file, or it is not a run, or it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise RunFileError(f"{path}: there is no such file")
    try:
        found, columns = _read(path)
        if found.get("format") != FORMAT:
            raise RunFileError(f"is not a run file (its 'format' attribute is not '{FORMAT}')")
        if int(found["format_version"]) > FORMAT_VERSION:
            raise RunFileError(
                f"was written by a newer version: format {found['format_version']}, this one reads {FORMAT_VERSION}"
            )
        if int(found["format_version"]) < FORMAT_VERSION:
            raise RunFileError(
                f"was written by an older version: format {found['format_version']}, this one reads {FORMAT_VERSION}; "
                "run its scenario again"
            )
        texts = ("scenario", "robot_text", "robot", "law", "versions", "stopped")
        if wrong := [key for key in texts if not isinstance(found[key], str)]:
            raise RunFileError(f"is damaged: attribute '{wrong[0]}' is not text")
        robot, versions = json.loads(found["robot"]), json.loads(found["versions"])
        if not (isinstance(robot, dict) and isinstance(versions, dict) and isinstance(robot.get("name"), str)):
            raise RunFileError("is damaged: its attributes 'robot' and 'versions' must be tables")
        run = Run(
            scenario=parse_scenario(found["scenario"], where="attribute 'scenario'"),
            model=robot_models.from_text(found["robot_text"], **robot),
            columns=columns,
            law=found["law"],
            versions=versions,
            stopped=found["stopped"] or None,
            wall_seconds=float(found["wall_seconds"]),
        )
    except KeyError as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {error} is missing") from None
    except ClosedLoopError as error:
        raise RunFileError(f"{path}: {error}") from None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0].strip()
        raise RunFileError(f"{path}: is not a run file, or is damaged: {reason}") from None
    _check_shapes(path, run)
    return run


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return all attributes, and the columns if the file says that it is a run."""
    import h5netcdf

    with h5netcdf.File(path, "r") as file:
        found = dict(file.attrs)
        if found.get("format") != FORMAT:
            return found, {}
        if int(found.get("format_version", 0)) != FORMAT_VERSION:
            return found, {}
        return found, {name: np.asarray(file.variables[name][...]) for name in COLUMNS}


def _check_shapes(path: Path, run: Run) -> None:
    sizes = {"time": len(run), "joint": run.model.n, "axis": 3, "event": run.columns["event_time"].size}
    for name, spec in COLUMNS.items():
        column, shape = run.columns[name], tuple(sizes[dim] for dim in spec.dims)
        if column.shape != shape or column.dtype.kind not in "fi":
            raise RunFileError(
                f"{path}: is damaged: column '{name}' is {column.dtype} of shape {column.shape}, "
                f"not numbers of shape {shape}"
            )
