"""Logs of ROS 2: a run written as MCAP, and the same messages in a bag of rosbag2, are read as they were."""

import os
import signal
import sqlite3
import time

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.export.files import write_mcap
from closedloop.simulation.batch.threads import Done
from closedloop.studies.comparison.recording import read_recording
from closedloop.studies.identify import read as bag_module
from closedloop.studies.identify.motion import LogError
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
    os.mkfifo(tmp_path / "pipe.csv")
    os.mkfifo(tmp_path / "pipe.nc")
    (tmp_path / "of_pipes").mkdir()
    os.mkfifo(tmp_path / "of_pipes" / "pipe.mcap")
    for name, says in (("pipe.csv", "is a pipe: a log is a file"), ("pipe.nc", "is a pipe"), ("of_pipes", "no folder")):
        with pytest.raises(LogError, match=says):  # opened, it would be waited for without an end
            read_log(tmp_path / name, run.model)


ENDLESS = (
    "WITH RECURSIVE t(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM t) "
    "SELECT id, '/joint_states' AS name, '{}' AS type FROM t"
)


@pytest.mark.parametrize(
    "topics",
    [
        f"CREATE VIEW topics AS {ENDLESS.format('sensor_msgs/msg/JointState')}",
        f"CREATE VIEW topics AS {ENDLESS.format('x')}",
        "CREATE TABLE topics(id INTEGER, name TEXT, type TEXT AS (hex(zeroblob(9e8))))",
    ],
)
def test_a_query_without_an_end_is_not_begun(topics, tmp_path, run):
    """What rosbag2 keeps in tables is read from tables: a view may be endless, a computed column of any size."""
    with sqlite3.connect(tmp_path / "endless.db3") as bag:
        bag.execute(topics)
        bag.execute("CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)")
    bag.close()
    with pytest.raises(LogError, match="has no table topics as rosbag2 writes it"):
        read_log(tmp_path / "endless.db3", run.model)


def test_a_signal_ends_a_long_query(tmp_path, run, monkeypatch):
    """SQLite asks every so often whether it is to go on; the signal is what is raised."""
    write_mcap(run, tmp_path / "run.mcap")
    database(tmp_path / "run.mcap", tmp_path / "bag.db3")
    check = Done.check

    def endless(done):
        os.kill(os.getpid(), signal.SIGINT)
        while True:
            check(done)
            time.sleep(0.01)

    monkeypatch.setattr(Done, "check", endless)
    monkeypatch.setattr(bag_module, "CHECKED", 1)
    with pytest.raises(KeyboardInterrupt):
        read_log(tmp_path / "bag.db3", run.model)


def test_a_name_is_no_part_of_an_address(tmp_path, run, monkeypatch):
    """A bag's name may have any character: it is opened for reading, and nothing is made."""
    monkeypatch.chdir(tmp_path)
    write_mcap(run, tmp_path / "run.mcap")
    database(tmp_path / "run.mcap", tmp_path / "q?mode=rwc&x=#.db3")
    assert len(read_log("q?mode=rwc&x=#.db3", run.model).time) == len(run)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["q?mode=rwc&x=#.db3", "run.mcap"]
