"""Logs from files, and from ROS 2's bags.

A `sensor_msgs/msg/JointState` gives columns `position_NAME`, `velocity_NAME`, `effort_NAME` by the names of the joints,
at the times of their headers; a `geometry_msgs/msg/WrenchStamped` gives `TOPIC.force.x` ... (without the first slash)
at the same times, between its messages by a line.
"""

from __future__ import annotations

import re
import sqlite3
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array, number_of
from closedloop.base.errors import missing_line, needs
from closedloop.base.files import kind_of, reason_of
from closedloop.figures.export.files import DEFINITIONS
from closedloop.simulation.batch.threads import Done, uninterrupted
from closedloop.studies.identify.motion import Log, LogError

if TYPE_CHECKING:
    from closedloop.record.run import Run
    from robot_models import RobotModel


JOINTS, WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
# Steps of SQLite after which it is asked whether a query is still wanted: some ten milliseconds.
CHECKED = 100_000
NEEDS = missing_line("reading MCAP and rosbag2 needs", "mcap-ros2-support", "mcap")


def table_of_bag(path: Path) -> dict[str, Array]:
    """Return the columns of a bag that are joints and wrenches, by name, (N,) each."""
    if find_spec("mcap_ros2") is None:
        raise LogError(f"{path}: {NEEDS}")
    try:
        inside = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
        files = [path] if path.is_file() else [file for file in inside if file.is_file()]  # a pipe would be waited for
        if not files:
            raise LogError(f"{path}: is no file, and no folder with .mcap or .db3")
        readers = ((file, _of_mcap if file.suffix.lower() == ".mcap" else _of_database) for file in files)
        messages = [message for file, read in readers for message in read(file)]
    except LogError:
        raise
    except Exception as error:  # whatever the readers raise
        raise LogError(f"{path}: cannot be read: {str(error).splitlines()[0] if str(error) else 'damaged'}") from None
    by_topic: dict[str, list[Any]] = {}
    kinds = {}
    for topic, kind, message in messages:
        by_topic.setdefault(topic, []).append(message)
        kinds[topic] = kind
    joints = [topic for topic, kind in kinds.items() if kind == JOINTS]
    if len(joints) != 1:
        what = f"has several topics of {JOINTS}: {', '.join(joints)}" if joints else f"has no {JOINTS}"
        raise LogError(f"{path}: {what}: one is needed")
    rows = by_topic[joints[0]]
    names = list(rows[0].name)
    if any(list(row.name) != names for row in rows):
        raise LogError(f"{path}: {joints[0]}: its messages have different joints")
    time = _times(rows)
    table = {"time": time}
    for field in ("position", "velocity", "effort"):
        values = [getattr(row, field) for row in rows]
        if all(len(value) == len(names) for value in values):
            table |= {f"{field}_{name}": column for name, column in zip(names, np.array(values).T, strict=True)}
    for topic, kind in kinds.items():
        if kind == WRENCH:
            others = _times(by_topic[topic])
            for axis in "xyz":
                force = np.array([getattr(each.wrench.force, axis) for each in by_topic[topic]])
                table[f"{topic.lstrip('/')}.force.{axis}"] = np.interp(time, others, force)
    return table


def _times(messages: list[Any]) -> Array:
    return np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages], dtype=np.float64)


def _of_mcap(file: Path) -> Iterator[tuple[str, str, Any]]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary: Any = reader.get_summary()
        kinds = {} if summary is None else {number: schema.name for number, schema in summary.schemas.items()}
        channels = () if summary is None else summary.channels.values()
        wanted = [each.topic for each in channels if kinds.get(each.schema_id) in (JOINTS, WRENCH)]
        for schema, channel, _, message in reader.iter_decoded_messages(topics=wanted):
            if schema is not None:
                yield channel.topic, schema.name, message


def _of_database(file: Path) -> Iterator[tuple[str, str, Any]]:
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    factory = DecoderFactory()
    decoders: dict[str, Any] = {}
    for number, kind in enumerate((JOINTS, WRENCH), 1):
        schema = Schema(id=number, name=kind, encoding="ros2msg", data=DEFINITIONS[kind].encode())
        decoders[kind] = factory.decoder_for("cdr", schema)
    for name, kind, data in uninterrupted(lambda done: _rows(file, tuple(decoders), done)):
        yield name, kind, decoders[kind](data)


def _rows(file: Path, kinds: Sequence[str], done: Done) -> list[tuple[str, str, bytes]]:
    """Return topic, type and data of the messages of these types in a database, in the order of their times.

    Only tables are asked, in the form that rosbag2 has: a query of a view, or of a column that is computed, may have no
    end.
    """
    connection = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)
    connection.set_progress_handler(done.check, CHECKED)  # what it raises ends the query
    try:
        tables = dict(connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
        for name in ("topics", "messages"):
            if not re.match(r"CREATE TABLE\b(?!.*\bAS\s*\()", tables.get(name) or "", re.IGNORECASE | re.DOTALL):
                raise LogError(f"{file}: has no table {name} as rosbag2 writes it")
        marks = ", ".join("?" * len(kinds))
        asked = (
            "SELECT topics.name, topics.type, messages.data FROM messages JOIN topics ON messages.topic_id = topics.id "
            f"WHERE topics.type IN ({marks}) ORDER BY messages.timestamp, messages.rowid"
        )
        return connection.execute(asked, kinds).fetchall()
    finally:
        connection.close()


# What columns are called in logs, in the order in which the names are tried.
NAMES = {
    "time": ("time", "t", "timestamp", "stamp"),
    "q": ("q", "position", "pos", "joint_position", "measured_position", "theta", "actual_q", "angle"),
    "v": ("v", "qd", "dq", "velocity", "vel", "joint_velocity", "measured_velocity", "actual_qd"),
    "torque": ("torque", "tau", "effort", "joint_torque", "measured_torque", "tau_j", "current", "i"),
}
# How a quantity and a joint make the name of a column; a unit in brackets behind it, and case, do not count.
FORMS = ("{} {}", "{}_{}", "{}{}", "{}[{}]", "{}.{}", "{}-{}")
# The units that may stand behind the name of a column, and what its values are multiplied by.
SECONDS = {
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "µs": 1e-6,
    "microseconds": 1e-6, "ns": 1e-9, "nanoseconds": 1e-9, "minutes": 60.0, "hours": 3600.0, "days": 86400.0,
}  # fmt: skip
ANGLES = {"rad": 1.0, "deg": np.pi / 180.0, "degrees": np.pi / 180.0, "°": np.pi / 180.0}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
FORCES = {"n": 1.0, "mn": 1e-3, "kn": 1e3}
CURRENTS = {"a": 1.0, "ma": 1e-3}
UNITS = {
    "time": SECONDS,
    "q": ANGLES | LENGTHS,
    "v": {f"{unit}{per}": k for unit, k in (ANGLES | LENGTHS).items() for per in ("", "/s", " s^-1", " s-1")},
    "torque": CURRENTS | FORCES | {
        f"{force}{times}{length}": k * arm
        for force, k in FORCES.items() for length, arm in LENGTHS.items() for times in ("", " ", "*", "·", ".")
    },
    "force": FORCES,
    "speed": {f"{unit}{per}": k for unit, k in LENGTHS.items() for per in ("/s", " s^-1", " s-1")},
}  # fmt: skip
MOST_LISTED = 12
_UNIT = re.compile(r"\s*[\[(]([^\[\]()]*)[\])]$")


def read_log(
    path: str | Path, robot: RobotModel, *, columns: Mapping[str, str] | None = None, degrees: bool = False,
    gain: float | Sequence[float] | None = None,
) -> Log:  # fmt: skip
    """Read a log of a robot.

    `path`: .csv, .parquet, or .nc: a run of this simulator, or variables over the first dimension, (N,) or (N, n);
        .mcap, .db3 or a folder of rosbag2.
    `columns`: of "time", "q", "v", "torque" to a name with {} for the joint, its name or its number, from 1 or 0:
        ``{"torque": "effort_{}"}``; or to the names of all columns, in the robot's order, with commas between. The
        usual names are found by themselves.
    `degrees`: whether angles are in degrees, and velocities in degrees/s.
    `gain`, float or (n,), optional: what torques are multiplied by: N m/A of currents, which need one.
    Raises LogError if the file cannot be read, or columns are missing.
    """
    path, given = Path(path), dict(columns or {})
    factors_of(gain)  # whatever the file is
    if unknown := set(given) - set(NAMES):
        raise LogError(f"columns: {sorted(unknown)[0]!r} is none of {', '.join(NAMES)}")
    if path.suffix.lower() == ".nc" and not given:
        run = run_of(path)
        if run is not None:
            return log_of_run(run, str(path))
    table, time, q, v, torque = read_joints(path, robot, given, degrees, gain)
    for name, x in (("q", q), ("torque", torque)):
        if x is None:
            raise LogError(
                f"{path}: no columns for {name} of the joints {', '.join(robot.joint_names)}: name them, as in "
                f"--columns {name}='{name}_{{}}' or {name}=NAME,NAME; {{}} is the joint; it has {listed(table)}"
            )
    assert q is not None
    assert torque is not None
    return Log(time, q, torque, robot.joint_names, v, str(path))


def read_joints(
    path: Path, robot: RobotModel, given: dict[str, str], degrees: bool, gain: float | Sequence[float] | None
) -> tuple[dict[str, Array], Array, Array | None, Array | None, Array | None]:
    """Return the columns of a file, and the time, positions, velocities and torques among them; see `read_log`."""
    factors, table = factors_of(gain), table_of(path)
    time = time_of(table, given.get("time"), path)
    q, v = (joints_of(table, what, given, robot, path, degrees) for what in ("q", "v"))
    torque = joints_of(table, "torque", given, robot, path, currents=gain is not None)
    return table, time, q, v, None if torque is None else torque * factors


def factors_of(gain: float | Sequence[float] | None) -> Array:
    """Return what torques are multiplied by, () or (n,); raise LogError if nothing would be left of them."""
    factors = np.asarray(1.0 if gain is None else gain, dtype=np.float64)
    if not np.isfinite(factors).all() or not factors.all():
        raise LogError(f"gain is {gain!r}: must be finite and not 0")
    return factors


def log_of_run(run: Run, source: str = "the run") -> Log:
    """Return the log of a run: encoders where it has them, and torques that the force on the tip is added to.

    Raises LogError if links have contacts, or joints are elastic: their torques are not those of the drives alone.
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
    from closedloop.record.run import load_run

    _must_be_a_file(path)
    try:
        return load_run(path)
    except ClosedLoopError:
        return None


def _must_be_a_file(path: Path) -> None:
    """Refuse what is neither a file nor a folder: a pipe would be waited for, and libraries wait uninterruptibly."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: cannot be read: {reason_of(error)}") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise LogError(f"{path}: is {kind_of(mode)}: a log is a file, or a folder of rosbag2")


def table_of(path: Path) -> dict[str, Array]:
    """Return the columns of a file that are numbers, or instants, which become seconds from the first."""
    kind = path.suffix.lower()
    needs(*{".csv": ["pyarrow"], ".txt": ["pyarrow"], ".parquet": ["pyarrow"], ".nc": ["xarray"]}.get(kind, []))
    _must_be_a_file(path)
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
    names = [name for name in read.column_names if name.strip()]  # a comma at the end of each line makes one without
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise LogError(f"{path}: has several columns {twice[0]!r}: each must have a name of its own")
    if names and all(number_of(name) is not None for name in names):
        raise LogError(f"{path}: its first line has numbers: it must have the names of the columns")
    columns = ((name, _numbers(read[name])) for name in names)
    return {name: values for name, values in columns if values is not None}


def _numbers(column: Any) -> Array | None:
    """Return a column of pyarrow as numbers, or None if it is text; instants in seconds from the first."""
    import pyarrow as pa
    from pyarrow import compute

    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        try:
            first = next((str(text) for text in column if text.is_valid), "")
            column = column.cast(pa.timestamp("ns", "UTC" if re.search(r"(Z|[+-]\d\d:?\d\d)$", first) else None))
        except pa.ArrowInvalid:
            return None
    kind = column.type
    if pa.types.is_temporal(kind):
        unit = {"day": "days"}.get(str(kind), getattr(kind, "unit", "days" if pa.types.is_date32(kind) else "ms"))
        ticks = column.cast(pa.int32() if kind.bit_width == 32 else pa.int64()).cast(pa.int64())
        since = compute.subtract(ticks, compute.min(ticks))
        return np.asarray(since.to_numpy().astype(np.float64) * SECONDS[unit])
    try:
        return np.asarray(column.to_numpy().astype(np.float64))
    except (ValueError, TypeError):
        return None


def _netcdf(path: Path) -> dict[str, Array]:
    import xarray

    found: dict[str, Array] = {}
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        for name, x in data.variables.items():
            if x.dtype.kind not in "fiu" or x.ndim not in (1, 2):
                continue
            unit, _, since = str(x.attrs.get("units", "")).partition(" since ")
            behind = f" [{unit}]" if unit else ""
            values = x.values if not since else x.values - np.min(x.values)
            values = np.asarray(values, dtype=np.float64)
            if x.ndim == 1:
                found[f"{name}{behind}"] = values
                continue
            labels = data[x.dims[1]].values if x.dims[1] in data.variables else range(1, x.shape[1] + 1)
            found |= {f"{name}_{label}{behind}": values[:, k] for k, label in enumerate(labels)}
    return found


@cache
def unit_behind(name: str, what: str) -> tuple[str, float | None]:
    """Return the name of a column without the unit behind it, in lower case, and what the unit multiplies values by.

    A unit that a quantity, a key of `UNITS`, does not have is part of the name, and the factor is then None.
    """
    units, found = UNITS[what], _UNIT.search(name)
    if found and found[1].strip().lower() in units:
        return name[: found.start()].strip().lower(), units[found[1].strip().lower()]
    stem, _, end = name.strip().lower().rpartition("_")
    if what == "time" and stem in NAMES["time"] and end in units:  # time_ms
        return stem, units[end]
    return name.strip().lower(), None


def time_of(table: dict[str, Array], given: str | None, path: Path) -> Array:
    """Return the column of the time, s."""
    for name in (given,) if given else NAMES["time"]:
        found = columns_named(table, [name], "time", path)
        if found is not None:
            return found[0]
    wanted = given or " or ".join(NAMES["time"][:3])
    raise LogError(
        f"{path}: no column {wanted} for the time: name it, as in --columns time=NAME; it has {listed(table)}"
    )


def columns_named(
    table: dict[str, Array], names: Sequence[str], what: str, path: Path, said: Sequence[float | None] = ()
) -> list[Array] | None:
    """Return the columns of a quantity with these names in SI units, or None if one of them is not there.

    They may have another case, and a unit behind. Values are multiplied by what the unit behind a name of `names` says,
    or else by `said`, or else by what the unit behind the column's own name says.
    """
    found = []
    for name in names:
        column = _column(table, name, what, path)
        if column is None:
            return None
        found.append(column)
    if twice := [name for name, count in Counter(found).items() if count > 1]:
        raise LogError(f"{path}: column {twice[0]!r} is named for two of {', '.join(names)}: each has one of its own")
    columns = []
    for name, asked, factor in zip(found, names, said or [None] * len(names), strict=True):
        factors = unit_behind(asked, what)[1], factor, unit_behind(name, what)[1]
        columns.append(table[name] * next((k for k in factors if k is not None), 1.0))
    return columns


def _column(table: dict[str, Array], name: str, what: str, path: Path) -> str | None:
    if name in table:
        return name
    plain = unit_behind(name, what)[0]
    alike = [each for each in table if unit_behind(each, what)[0] == plain]
    if len(alike) > 1:
        raise LogError(f"{path}: columns {alike[0]!r} and {alike[1]!r}: which is it? Name one: --columns {what}=...")
    return alike[0] if alike else None


def joints_of(
    table: dict[str, Array], what: str, given: dict[str, str], robot: RobotModel, path: Path, degrees: bool = False,
    currents: bool = True,
) -> Array | None:  # fmt: skip
    """Return the columns of a quantity, (N, n) in the robot's order and SI units, or None if it is not there.

    Angles are in degrees if `degrees`, whatever unit is behind the names of their columns. Without `currents` torques
    whose unit is that of a current are refused.
    """
    n, angles = robot.n, degrees and what in ("q", "v")
    said = [ANGLES["deg"] if angles and kind != "prismatic" else None for kind in robot.joint_types]
    labels = [list(robot.joint_names), [str(k + 1) for k in range(n)], [str(k) for k in range(n)]]
    asked = given.get(what)
    patterns: list[str] = []
    if asked and "{}" not in asked:
        tried = [[name.strip() for name in asked.split(",")]]
    else:
        patterns = [asked] if asked else [form.format(name, "{}") for name in NAMES[what] for form in FORMS]
        tried = [[pattern.format(label) for label in row] for row in labels for pattern in patterns]
    for names in tried:
        found = columns_named(table, names, what, path, said) if len(names) == n else None
        if found is not None:
            for name in names if not currents else ():  # nothing says how many N m an A is
                units = [unit[1].strip().lower() for each in (name, _column(table, name, "torque", path) or "")
                         if (unit := _UNIT.search(each))]  # fmt: skip
                if units and units[0] in CURRENTS:
                    cure = "give the N m/A of each joint, as in --gain 13.6,14.3"
                    raise LogError(f"{path}: {name!r} is a current, in A: {cure}")
            return np.stack(found, axis=1)
    if asked:
        missing = _lacking(table, tried[0], what, path)[:1]
        reason = f"no column {missing[0]!r}" if missing else f"{len(tried[0])} columns for {n} joints"
        raise LogError(f"{path}: --columns {what}={asked}: {reason}; it has {listed(table)}")
    for names in tried[: len(patterns)] if what != "v" else ():  # by the joints' names
        lacking = _lacking(table, names, what, path)
        if 0 < len(lacking) < n:
            raise LogError(
                f"{path}: has {what} of {n - len(lacking)} of {n} joints: no column of numbers {lacking[0]!r}; it has "
                f"{listed(table)}"
            )
    return None


def _lacking(table: dict[str, Array], names: Sequence[str], what: str, path: Path) -> list[str]:
    return [name for name in names if _column(table, name, what, path) is None]


def listed(table: dict[str, Array]) -> str:
    """Return the names of columns, for a message."""
    names, more = list(table), len(table) - MOST_LISTED
    return ", ".join(names[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
