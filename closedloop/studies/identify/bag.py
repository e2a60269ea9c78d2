"""Logs of ROS 2: MCAP files, and bags of rosbag2, a folder or its .db3, with standard messages.

A `sensor_msgs/msg/JointState` gives columns `position_NAME`, `velocity_NAME`, `effort_NAME` by the names of the joints,
at the times of their headers; a `geometry_msgs/msg/WrenchStamped` gives `TOPIC.force.x` ... (without the first slash)
at the same times, between its messages by a line.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.optional import missing_line
from closedloop.figures.export.mcap_file import DEFINITIONS
from closedloop.simulation.batch.threads import Done, uninterrupted
from closedloop.studies.identify.log import LogError

JOINTS, WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
# Steps of SQLite after which it is asked whether a query is still wanted: some ten milliseconds.
CHECKED = 100_000
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
    inside = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    files = [path] if path.is_file() else [file for file in inside if file.is_file()]  # a pipe would be waited for
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
        found = connection.execute(f"SELECT id, name, type FROM topics WHERE type IN ({marks})", kinds)
        topics = {number: (name, kind) for number, name, kind in found}
        rows = []
        for number, (name, kind) in topics.items():
            asked = "SELECT timestamp, data FROM messages WHERE topic_id = ?"
            rows += [(stamp, name, kind, data) for stamp, data in connection.execute(asked, (number,))]
    finally:
        connection.close()
    return [row[1:] for row in sorted(rows, key=itemgetter(0))]
