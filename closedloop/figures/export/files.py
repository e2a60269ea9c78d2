"""A run in files of other programs: tables, MATLAB's arrays, ROS 2 messages.

CSV and Parquet have a column for each number of a row, its unit in the header; events are written beside them. MCAP has
standard ROS 2 messages: Foxglove, PlotJuggler and ``ros2 bag`` open it.

    /joint_states         sensor_msgs/msg/JointState        q, q̇ and the torque of the law; of what turns freely the
                                                            rotation vector and the angular velocity in its axes
    /tip_pose             geometry_msgs/msg/PoseStamped     the tip's frame, in the base frame
    /tip_wrench           geometry_msgs/msg/WrenchStamped   f n and friction on the tip, base axes
    /commanded_wrench     geometry_msgs/msg/WrenchStamped   f_des n, as /tip_wrench; none without a law that presses
    /desired_position     geometry_msgs/msg/PointStamped    where the law wants the tip, in the base frame
    /desired_path         nav_msgs/msg/Path                 all of it, once, without orientation
    /wrist_wrench         geometry_msgs/msg/WrenchStamped   what a sensor between arm and tool reads, the tip's axes
    /contacts/NAME        geometry_msgs/msg/WrenchStamped   of a contact of links, on the link with the point, base axes
    /loops/NAME           geometry_msgs/msg/WrenchStamped   of a loop joint on its first side, axes of its second frame
    /events               rcl_interfaces/msg/Log            impact, touchdown, liftoff, stick ..., each at its time
    /robot_description    std_msgs/msg/String               the URDF, where the robot is one

Times count from 0, the start of the run. The scenario's text is attached as scenario.toml.

A bag of rosbag2 is a folder with the same messages in an MCAP file, and metadata.yaml.
"""

import io
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import OutputError, ScenarioError, missing_line, needs
from closedloop.base.files import made_folder, write_whole
from closedloop.control.laws.none import NoLaw
from closedloop.figures.scene.scene import quaternions, scene_of, thin_out
from closedloop.loop.events.table import EVENT_COLUMNS, KINDS
from closedloop.mechanics.loops.reactions import named_side, parts_of
from closedloop.record.columns.derived import DERIVED, loop_positions, part_labels
from closedloop.record.run import Run, units_by_kind
from closedloop.scenario.arm import robot_of

# The fields of each message that is sent, and of those within.
FIELDS = {
    "sensor_msgs/JointState": "std_msgs/Header header; string[] name; float64[] position; float64[] velocity; "
    "float64[] effort",
    "geometry_msgs/PoseStamped": "std_msgs/Header header; geometry_msgs/Pose pose",
    "geometry_msgs/PointStamped": "std_msgs/Header header; geometry_msgs/Point point",
    "nav_msgs/Path": "std_msgs/Header header; geometry_msgs/PoseStamped[] poses",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header; geometry_msgs/Wrench wrench",
    "rcl_interfaces/Log": "builtin_interfaces/Time stamp; uint8 level; string name; string msg; string file; "
    "string function; uint32 line",
    "std_msgs/String": "string data",
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Quaternion": "float64 x; float64 y; float64 z; float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force; geometry_msgs/Vector3 torque",
}


def _definition(kind: str) -> str:
    """Return the definition of a message as ROS 2 has it: its fields, and then each message within, once."""
    kinds, texts = [kind], []
    for each in kinds:
        fields = FIELDS[each].split("; ")
        texts.append("\n".join(fields if each == kind else [f"MSG: {each}", *fields]))
        inner = [field.partition(" ")[0].removesuffix("[]") for field in fields]
        kinds += [name for name in inner if name in FIELDS and name not in kinds]
    return f"\n{'=' * 80}\n".join(texts)


SENT = ("sensor_msgs/JointState", "geometry_msgs/PoseStamped", "geometry_msgs/PointStamped", "nav_msgs/Path",
        "geometry_msgs/WrenchStamped", "rcl_interfaces/Log", "std_msgs/String")  # fmt: skip
DEFINITIONS = {kind.replace("/", "/msg/"): _definition(kind) for kind in SENT}
NEEDS_MCAP = missing_line("MCAP needs", "mcap-ros2-support", "mcap")
PATH_POINTS = 1000  # of the message with the whole desired path, at most
INFO = 20  # level of a log message


def write_mcap(run: Run, path: str | Path) -> list[Path]:
    """Write a run as MCAP, and return its path in a list."""
    if find_spec("mcap_ros2") is None:
        raise ScenarioError(NEEDS_MCAP)
    return [write_whole(path, partial(_write, run))]


def _write(run: Run, file: BinaryIO) -> None:
    from mcap_ros2.writer import Writer

    writer: Any = Writer(file)
    schemas = {name: writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()}

    def send(topic: str, kind: str, message: dict[str, Any], time: float) -> None:
        at = round(1e9 * time)
        writer.write_message(topic, schemas[kind], message, log_time=at, publish_time=at)

    def send_wrench(topic: str, force: Any, moment: Any, time: float, frame: str) -> None:
        wrench = {"force": _vector(force), "torque": _vector(moment)}
        header = {"stamp": _stamp(time), "frame_id": frame}
        send(topic, "geometry_msgs/msg/WrenchStamped", {"header": header, "wrench": wrench}, time)

    if run.model.format == "urdf":
        send("/robot_description", "std_msgs/msg/String", {"data": run.model.text}, 0.0)
    frames = list(run.model.pinocchio_model().frames)[1:]
    base, scene = str(next((frame.name for frame in frames if frame.parentJoint == 0), "base")), scene_of(run)
    reactions = list(_reactions(run))
    names, q = list(run.model.joint_names), loop_positions(run)
    nothing, unturned = np.zeros(3), {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    wanted, commanded = run.reference_tip, bool(np.any(run.reference_force))
    bears = np.any(run.link_forces, axis=0) if run.scenario.contact else []
    start = {"stamp": _stamp(0.0), "frame_id": base}
    points: Any = [] if isinstance(run.scenario.law, NoLaw) else thin_out(wanted, PATH_POINTS)
    poses = [{"position": _vector(point), "orientation": unturned} for point in points]
    if poses:
        path = {"header": start, "poses": [{"header": start, "pose": pose} for pose in poses]}
        send("/desired_path", "nav_msgs/msg/Path", path, 0.0)
    for k in range(len(run)):
        time, there = float(run.time[k]), scene.joint_places(k)
        header = {"stamp": _stamp(time), "frame_id": base}
        joints = {"position": q[k].tolist(), "velocity": run.v[k].tolist(), "effort": run.torque[k].tolist()}
        send("/joint_states", "sensor_msgs/msg/JointState", {"header": header, "name": names, **joints}, time)
        pose = {"position": _vector(run.position[k]), "orientation": _turn(scene.tip_axes(there[0]))}
        send("/tip_pose", "geometry_msgs/msg/PoseStamped", {"header": header, "pose": pose}, time)
        send_wrench("/tip_wrench", run.tip_force[k], nothing, time, base)
        if poses:
            point = {"header": header, "point": _vector(wanted[k])}
            send("/desired_position", "geometry_msgs/msg/PointStamped", point, time)
        if commanded:
            send_wrench("/commanded_wrench", run.reference_force[k] * run.surface_normal[k], nothing, time, base)
        send_wrench("/wrist_wrench", run.wrist_wrench[k, :3], run.wrist_wrench[k, 3:], time, scene.tip)
        for touching, arrow, some in zip(scene.touching, scene.between_links(k, *there), bears, strict=True):
            if some:  # of thousands of points of boxes few ever touch
                send_wrench(f"/contacts/{touching.name}", arrow.force, nothing, time, base)
        for name, frame, force, couple in reactions:
            send_wrench(f"/loops/{name}", force[k], couple[k], time, frame)
    for event in run.events:
        rates = f"closure rate {event.rate_before:.6g} to {event.rate_after:.6g} m/s"
        said = f"{event.kind}: {rates}, {event.energy_lost:.4g} J lost"
        message = {"stamp": _stamp(event.time), "level": INFO, "name": "closedloop", "msg": said}
        send("/events", "rcl_interfaces/msg/Log", message | {"file": "", "function": "", "line": 0}, event.time)
    writer.add_attachment(0, 0, "scenario.toml", "application/toml", run.scenario.to_toml().encode())
    writer.finish()


def _reactions(run: Run) -> Iterator[tuple[str, str, Any, Any]]:
    """Yield name, second frame, force (N, 3), N, and couple (N, 3), N m, of each loop joint that binds two frames."""
    if run.loops is None:
        return
    robot, at = robot_of(run.scenario, run.model), 0
    for loop in run.model.loops:
        kinds = [what for what, _ in parts_of(run.model, loop)]
        own = run.loops.reactions[:, at : at + len(kinds)]
        at += len(kinds)
        if loop.type != "gear":
            couple = own[:, 3:] if len(kinds) == 6 else np.zeros((len(run), 3))
            yield loop.name, named_side(robot, loop)[0], own[:, :3], couple


def _stamp(time: float) -> dict[str, int]:
    nanoseconds = round(1e9 * time)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _vector(values: Any) -> dict[str, float]:
    x, y, z = (float(value) for value in values)
    return {"x": x, "y": y, "z": z}


def _turn(axes: Any) -> dict[str, float]:
    """Return the orientation of axes (3, 3), the columns of a rotation, as the parts of a quaternion."""
    w, x, y, z = (float(part) for part in quaternions(axes[None])[0])
    return {"x": x, "y": y, "z": z, "w": w}


# Of metadata.yaml: the version that ROS 2 Humble and all later ones read.
VERSION = 5


def write_rosbag2(run: Run, path: str | Path) -> list[Path]:
    """Write a run as a bag, the folder `path`, for ``ros2 bag play`` and ``ros2 bag info``; return what was written.

    Raises ScenarioError if the package mcap-ros2-support is missing.
    Raises OutputError if the folder cannot be made or written into.
    """
    folder = Path(path)
    name = f"{folder.name}_0.mcap"
    written = write_mcap(run, made_folder(folder) / name)
    import yaml

    text = yaml.safe_dump({"rosbag2_bagfile_information": _information(written[0])}, sort_keys=False)
    return [*written, write_whole(folder / "metadata.yaml", text.encode())]


def _information(path: Path) -> dict[str, Any]:
    """Return what the metadata say of an MCAP file."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary: Any = make_reader(file).get_summary()
    counts, numbers = summary.statistics, summary.statistics.channel_message_counts
    spans = {
        "starting_time": {"nanoseconds_since_epoch": counts.message_start_time},
        "duration": {"nanoseconds": counts.message_end_time - counts.message_start_time},
        "message_count": counts.message_count,
    }
    topics = [
        {
            "topic_metadata": {
                "name": channel.topic, "type": summary.schemas[channel.schema_id].name,
                "serialization_format": channel.message_encoding, "offered_qos_profiles": "",
            },
            "message_count": numbers[number],
        }
        for number, channel in summary.channels.items()
    ]  # fmt: skip
    return {
        "version": VERSION, "storage_identifier": "mcap", **spans, "topics_with_message_count": topics,
        "compression_format": "", "compression_mode": "", "relative_file_paths": [path.name],
        "files": [{"path": path.name, **spans}],
    }  # fmt: skip


def save(run: Run, path: str | Path) -> list[Path]:
    """Write a run in the format that the path's ending names, and return what was written; see `Run.save`."""
    path = Path(path)
    if path.suffix not in FORMATS:
        raise OutputError(
            f"{path}: must end in .nc, .h5, {', '.join(FORMATS)}: the ending says in which format it is written"
        )
    return FORMATS[path.suffix](run, path)


def write_csv(run: Run, path: str | Path) -> list[Path]:
    """Write a run as CSV, and its events, if it has any, beside it with ``_events`` in the name; return the paths.

    Numbers have as many digits as tell them apart from all others, so they are read back to the bit. Headers are
    ``q J1 [rad]``, ``position x [m]`` ...; what has no unit has none. Reactions
    of loop joints are last, ``reaction pin: force along x [N]`` ..., in the axes of the second of its frames.
    """
    needs("pyarrow")
    from pyarrow import csv

    return _write_tables(run, Path(path), csv.write_csv)


def write_parquet(run: Run, path: str | Path) -> list[Path]:
    """Write a run as Parquet, with the headers of `write_csv`, and its events beside it; return the paths."""
    needs("pyarrow")
    from pyarrow import parquet

    return _write_tables(run, Path(path), parquet.write_table)


def write_mat(run: Run, path: str | Path) -> list[Path]:
    """Write a run for MATLAB (version 5), and return its path in a list.

    Each column is an array of its name, (N, 1) or (N, k); the struct ``units`` has the unit of each, ``events`` the
    columns of the events.
    """
    from scipy.io import savemat

    names = [*run.specs, *DERIVED]
    values: dict[str, Any] = {name: np.asarray(getattr(run, name)) for name in names if name not in EVENT_COLUMNS}
    values["units"] = {name: run.units(name) for name in names}
    values["events"] = {name: np.asarray(getattr(run, name)) for name in EVENT_COLUMNS}
    file = io.BytesIO()
    savemat(file, values, long_field_names=True, do_compression=True, oned_as="column")
    return [write_whole(path, file.getvalue())]


def encoded(columns: Mapping[str, NDArray[Any]], write: Callable[[Any, BinaryIO], object]) -> bytes:
    """Return the file that a function of pyarrow writes of columns."""
    import pyarrow as pa

    content = io.BytesIO()
    write(pa.table(dict(columns)), content)
    return content.getvalue()


def _write_tables(run: Run, path: Path, write: Callable[[Any, BinaryIO], object]) -> list[Path]:
    """Write the rows of a run, and its events, if it has any, beside it; return the paths."""
    rows = [*(name for name in run.specs if name not in EVENT_COLUMNS), *DERIVED]
    whole = {k: v for name in rows for k, v in _flat(run, name).items()}
    if (loops := run.loops) is not None:  # what the joints of a mechanism's loops carried
        parts = zip(loops.labels, loops.units, loops.reactions.T, strict=True)
        whole |= {_header(f"reaction {label}", unit): values for label, unit, values in parts}
    written = [write_whole(path, encoded(whole, write))]
    if run.events:
        columns = {k: v for name in EVENT_COLUMNS for k, v in _flat(run, name).items()}
        columns["event_kind"] = np.array([KINDS[int(kind)] for kind in run.event_kind])
        written.append(write_whole(path.with_name(f"{path.stem}_events{path.suffix}"), encoded(columns, write)))
    return written


def _flat(run: Run, name: str) -> dict[str, NDArray[Any]]:
    """Return a column of a run as columns of single numbers, by their headers."""
    values, dims = getattr(run, name), (run.specs.get(name) or DERIVED[name]).dims
    if len(dims) == 1:
        return {_header(name, run.units(name)): values}
    found, (first, _, other) = {}, run.units(name).partition(" | ")  # of a turn and a slide, or of a force and a moment
    for k, entry in enumerate(part_labels(run, name)):
        second = run.model.joint_types[k] == "prismatic" if dims[1] == "joint" else entry.startswith("m")
        unit = units_by_kind("rad", run.model.coordinate_types[k]) if dims[1] == "coordinate" else first
        unit = other if other and second else unit
        found[_header(f"{name} {entry}", unit)] = values[:, k]
    return found


def _header(name: str, unit: str) -> str:
    return name if unit in ("", "1") else f"{name} [{unit}]"


# By the ending of the path; `closedloop export` has them too.
FORMATS: dict[str, Callable[[Run, str | Path], list[Path]]] = {
    ".csv": write_csv, ".mat": write_mat, ".mcap": write_mcap, ".parquet": write_parquet,
}  # fmt: skip
