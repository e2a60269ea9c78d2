"""Logs of ROS 2: MCAP files, and bags of rosbag2, a folder or its .db3, with standard messages.

A `sensor_msgs/msg/JointState` gives columns `position_NAME`, `velocity_NAME`, `effort_NAME` by the names of the joints,
at the times of their headers; a `geometry_msgs/msg/WrenchStamped` gives `TOPIC.force.x` ... (without the first slash)
at the same times, between its messages by a line.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.optional import missing_line
from closedloop.figures.export.messages import DEFINITIONS
from closedloop.studies.identify.log import LogError

JOINTS, WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
NEEDS = missing_line("reading MCAP and rosbag2 needs", "mcap-ros2-support", "mcap")


def table_of_bag(path: Path) -> dict[str, Array]:
    """Return the columns of a bag that are joints and wrenches, by name, (N,) each."""
    if find_spec("mcap_ros2") is None:
        raise LogError(f"{path}: {NEEDS}")
    try:
        messages = list(_messages(path))
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


def _messages(path: Path) -> Iterator[tuple[str, str, Any]]:
    """Yield topic, kind and message of joints and wrenches, in the order of the bag."""
    files = [path] if path.is_file() else sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if not files:
        raise LogError(f"{path}: is no file, and no folder with .mcap or .db3")
    for file in files:
        yield from _of_mcap(file) if file.suffix.lower() == ".mcap" else _of_database(file)


def _of_mcap(file: Path) -> Iterator[tuple[str, str, Any]]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        wanted = [
            channel.topic
            for summary in [reader.get_summary()]
            if summary is not None
            for channel in summary.channels.values()
            if channel.schema_id in summary.schemas and summary.schemas[channel.schema_id].name in (JOINTS, WRENCH)
        ]
        for schema, channel, _, message in reader.iter_decoded_messages(topics=wanted):
            if schema is not None:
                yield channel.topic, schema.name, message


def _of_database(file: Path) -> Iterator[tuple[str, str, Any]]:
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    factory, decoders = DecoderFactory(), {}
    for number, kind in enumerate((JOINTS, WRENCH), 1):
        schema = Schema(id=number, name=kind, encoding="ros2msg", data=DEFINITIONS[kind].encode())
        decoders[kind] = factory.decoder_for("cdr", schema)
    connection = sqlite3.connect(f"file:{file.resolve().as_posix()}?mode=ro", uri=True)
    try:
        topics = {row[0]: row[1:] for row in connection.execute("SELECT id, name, type FROM topics")}
        for number, data in connection.execute("SELECT topic_id, data FROM messages ORDER BY timestamp"):
            name, kind = topics[number]
            decode = decoders.get(kind)
            if decode is not None:
                yield name, kind, decode(data)
    finally:
        connection.close()
