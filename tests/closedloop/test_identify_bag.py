"""Logs of ROS 2: a run written as MCAP, and the same messages in a bag of rosbag2, are read as they were."""

import sqlite3

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.export.mcap_file import write_mcap
from closedloop.studies.comparison.recording import read_recording
from closedloop.studies.identify.log import LogError
from closedloop.studies.identify.read import read_log

pytest.importorskip("mcap_ros2")


@pytest.fixture(scope="module")
def run():
    """Return a slide of a planar arm."""
    return cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.6}), progress=False)


def database(mcap, path):
    """Write the raw messages of an MCAP as rosbag2's SQLite."""
    from mcap.reader import make_reader

    with mcap.open("rb") as stream, sqlite3.connect(path) as bag:
        bag.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        bag.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        known = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic not in known:
                known[channel.topic] = len(known) + 1
                bag.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (len(known), channel.topic, schema.name))
            row = (known[channel.topic], message.log_time, message.data)
            bag.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)
    bag.close()


@pytest.mark.parametrize("form", ["mcap", "db3", "folder"])
def test_a_bag_is_read_as_it_was_written(run, tmp_path, form):
    """Positions, torques and the force on the tip, to the last bit; times to the nanosecond of their stamps."""
    path = tmp_path / "run.mcap"
    write_mcap(run, path)
    if form != "mcap":
        folder = tmp_path / "bag"
        folder.mkdir()
        database(path, folder / "bag_0.db3")
        path = folder if form == "folder" else folder / "bag_0.db3"
    log = read_log(path, run.model)
    np.testing.assert_array_equal(log.q, run.q)
    np.testing.assert_array_equal(log.torque, run.torque)
    np.testing.assert_allclose(log.time, run.time, atol=1e-9)
    force = ",".join(f"tip_wrench.force.{axis}" for axis in "xyz")
    recording = read_recording(path, run.model, columns={"force": force})
    np.testing.assert_array_equal(recording.force, run.tip_force)


def test_what_is_no_bag_is_refused(tmp_path, run):
    """A folder without files, a damaged file, and one without joints: one line."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="no folder with"):
        read_log(tmp_path / "empty", run.model)
    for name in ("bad.mcap", "bad.db3"):
        (tmp_path / name).write_bytes(b"no bag" * 30)
        with pytest.raises(LogError, match="cannot be read"):
            read_log(tmp_path / name, run.model)
    with sqlite3.connect(tmp_path / "other.db3") as bag:
        bag.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        bag.execute("CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)")
    bag.close()
    with pytest.raises(LogError, match="has no sensor_msgs"):
        read_log(tmp_path / "other.db3", run.model)
