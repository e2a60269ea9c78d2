"""Logs from files: CSV, Parquet, NetCDF, MCAP, rosbag2, runs of this simulator; columns are found by their names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.files import reason_of
from closedloop.base.optional import needs
from closedloop.studies.identify.log import Log, LogError

if TYPE_CHECKING:
    from closedloop.record.run import Run
    from robot_models import RobotModel

# What columns are called in logs, in the order in which the names are tried.
NAMES = {
    "time": ("time", "t", "timestamp", "stamp"),
    "q": ("q", "position", "pos", "joint_position", "measured_position", "theta", "actual_q", "angle"),
    "v": ("v", "qd", "dq", "velocity", "vel", "joint_velocity", "measured_velocity", "actual_qd"),
    "torque": ("torque", "tau", "effort", "joint_torque", "measured_torque", "tau_j", "current", "i"),
}
# How a quantity and a joint make the name of a column; a unit in brackets behind it, and case, do not count.
FORMS = ("{} {}", "{}_{}", "{}{}", "{}[{}]", "{}.{}", "{}-{}")
MOST_LISTED = 12
_UNIT = re.compile(r"\s*(?:\[(?:rad|deg|N|m|s|A)[^\]]*\]|\((?:rad|deg|N|m|s|A)[^)]*\))$")


def read_log(
    path: str | Path,
    robot: RobotModel,
    *,
    columns: Mapping[str, str] | None = None,
    degrees: bool = False,
    gain: float | Sequence[float] = 1.0,
) -> Log:
    """Read a log of a robot.

    Parameters
    ----------
    path : str or Path
        .csv, .parquet, or .nc: a run of this simulator, or variables over the first dimension, (N,) or (N, n); .mcap,
        .db3 or a folder of rosbag2, see `closedloop.studies.identify.bag`.
    columns : mapping, optional
        Of "time", "q", "v", "torque" to a name with {} for the joint, its name or its number, from 1 or 0:
        ``{"torque": "effort_{}"}``; or to the names of all columns, in the robot's order, with commas between.
        The usual names are found by themselves.
    degrees : bool
        Whether angles are in degrees, and velocities in degrees/s.
    gain : float or (n,)
        What torques are multiplied by: N m/A of currents.

    Raises
    ------
    LogError
        If the file cannot be read, or columns are missing.
    """
    path, given = Path(path), dict(columns or {})
    if unknown := set(given) - set(NAMES):
        raise LogError(f"columns: {sorted(unknown)[0]!r} is none of {', '.join(NAMES)}")
    if path.suffix.lower() == ".nc" and not given:
        run = run_of(path)
        if run is not None:
            return log_of_run(run, str(path))
    table = table_of(path)
    time = time_of(table, given.get("time"), path)
    q = joints_of(table, "q", given, robot, path)
    torque = joints_of(table, "torque", given, robot, path)
    v = joints_of(table, "v", given, robot, path)
    for name, x in (("q", q), ("torque", torque)):
        if x is None:
            raise LogError(
                f"{path}: no columns for {name} of the joints {', '.join(robot.joint_names)}: name them, as in "
                f"--columns {name}='{name}_{{}}' or {name}=NAME,NAME; {{}} is the joint; it has {listed(table)}"
            )
    assert q is not None
    assert torque is not None
    turns = in_radians(robot, degrees)
    return Log(
        time, q * turns, torque * np.asarray(gain, dtype=np.float64), robot.joint_names,
        None if v is None else v * turns, str(path),
    )  # fmt: skip


def in_radians(robot: RobotModel, degrees: bool) -> Array | float:
    """Return what positions (N, n) of a file, which may be in degrees, are multiplied by."""
    return np.where(np.array(robot.joint_types) == "prismatic", 1.0, np.pi / 180.0) if degrees else 1.0


def log_of_run(run: Run, source: str = "the run") -> Log:
    """Return the log of a run: encoders where it has them, and torques that the force on the tip is added to.

    Raises
    ------
    LogError
        If links have contacts, or joints are elastic: their torques are not those of the drives alone.
    """
    from closedloop.mechanics.robot.pinocchio import Robot

    if run.scenario.contact or "motor_position" in run.specs:
        what = "elastic joints" if "motor_position" in run.specs else "contacts of links"
        raise LogError(f"{source}: a run with {what} is not read as a log: its torques are not those of rigid joints")
    robot = Robot(run.model, run.scenario.robot.tip)
    force = run.contact_force[:, None] * run.surface_normal + run.friction_force
    torque = np.array(run.torque)
    for k in np.flatnonzero(np.any(force != 0.0, axis=1)):
        torque[k] += robot.frame_jacobian(np.ascontiguousarray(run.q[k]))[:3].T @ force[k]
    measured = "measured_position" in run.specs
    q = run.measured_position if measured else run.q
    v = run.measured_velocity if measured else run.v
    return Log(np.array(run.time), np.array(q), torque, run.model.joint_names, np.array(v), source)


def run_of(path: Path) -> Run | None:
    """Return a run of this simulator, or None if the file is another NetCDF."""
    from closedloop.base.errors import ClosedLoopError
    from closedloop.record.load import load_run

    try:
        return load_run(path)
    except ClosedLoopError:
        return None


def table_of(path: Path) -> dict[str, Array]:
    """Return the columns of a file that are numbers."""
    kind = path.suffix.lower()
    needs(*{".csv": ["pyarrow"], ".txt": ["pyarrow"], ".parquet": ["pyarrow"], ".nc": ["xarray"]}.get(kind, []))
    try:
        if kind in (".csv", ".txt"):
            from pyarrow import csv

            read: Any = csv.read_csv(path)
        elif kind == ".parquet":
            from pyarrow import parquet

            read = parquet.read_table(path)
        elif kind == ".nc":
            return _netcdf(path)
        elif kind in (".mcap", ".db3") or path.is_dir():
            from closedloop.studies.identify.bag import table_of_bag

            return table_of_bag(path)
        else:
            raise LogError(f"{path}: is none of .csv, .parquet, .nc, .mcap, and .db3 or a folder of rosbag2")
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {reason_of(error)}") from None
    except Exception as error:  # whatever pyarrow and HDF5 raise
        hint = "; commas separate columns, and a decimal has a point" if kind in (".csv", ".txt") else ""
        raise LogError(f"{path}: cannot be read: {(str(error) or 'damaged').splitlines()[0]}{hint}") from None
    found = {}
    for name in read.column_names:
        try:
            found[name] = read[name].to_numpy().astype(np.float64)
        except (ValueError, TypeError):
            continue  # a text
    return found


def _netcdf(path: Path) -> dict[str, Array]:
    import xarray

    found: dict[str, Array] = {}
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        for name, x in data.variables.items():
            if x.dtype.kind not in "fiu" or x.ndim not in (1, 2):
                continue
            values = np.asarray(x.values, dtype=np.float64)
            if x.ndim == 1:
                found[str(name)] = values
                continue
            labels = data[x.dims[1]].values if x.dims[1] in data.variables else range(1, x.shape[1] + 1)
            found |= {f"{name}_{label}": values[:, k] for k, label in enumerate(labels)}
    return found


def plain_name(name: str) -> str:
    """Return a name without the unit behind it, in lower case."""
    return _UNIT.sub("", name).strip().lower()


def time_of(table: dict[str, Array], given: str | None, path: Path) -> Array:
    """Return the column of the time."""
    for name in column_named(table, (given,) if given else NAMES["time"]):
        if name is not None:
            return table[name]
    wanted = given or " or ".join(NAMES["time"][:3])
    raise LogError(
        f"{path}: no column {wanted} for the time: name it, as in --columns time=NAME; it has {listed(table)}"
    )


def column_named(table: dict[str, Array], names: Sequence[str]) -> list[str | None]:
    """Return which columns have these names, be it in another case or with a unit behind; None for one that has not."""
    plain = {plain_name(name): name for name in table}
    return [name if name in table else plain.get(name.lower()) for name in names]


def joints_of(table: dict[str, Array], what: str, given: dict[str, str], robot: RobotModel, path: Path) -> Array | None:
    """Return the columns of a quantity, (N, n) in the robot's order, or None if it is not there."""
    n = robot.n
    labels = [list(robot.joint_names), [str(k + 1) for k in range(n)], [str(k) for k in range(n)]]
    asked = given.get(what)
    patterns: list[str] = []
    if asked and "{}" not in asked:
        tried = [[name.strip() for name in asked.split(",")]]
    else:
        patterns = [asked] if asked else [form.format(name, "{}") for name in NAMES[what] for form in FORMS]
        tried = [[pattern.format(label) for label in row] for row in labels for pattern in patterns]
    for names in tried:
        found = column_named(table, names)
        if len(found) == n and None not in found:
            return np.stack([table[name] for name in found if name is not None], axis=1)
    if asked:
        missing = _lacking(table, tried[0])[:1]
        reason = f"no column {missing[0]!r}" if missing else f"{len(tried[0])} columns for {n} joints"
        raise LogError(f"{path}: --columns {what}={asked}: {reason}; it has {listed(table)}")
    for names in tried[: len(patterns)] if what != "v" else ():  # by the joints' names
        lacking = _lacking(table, names)
        if 0 < len(lacking) < n:
            raise LogError(
                f"{path}: has {what} of {n - len(lacking)} of {n} joints: no column of numbers {lacking[0]!r}; it has "
                f"{listed(table)}"
            )
    return None


def _lacking(table: dict[str, Array], names: Sequence[str]) -> list[str]:
    return [name for name, found in zip(names, column_named(table, names), strict=True) if found is None]


def listed(table: dict[str, Array]) -> str:
    """Return the names of columns, for a message."""
    names, more = list(table), len(table) - MOST_LISTED
    return ", ".join(names[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
