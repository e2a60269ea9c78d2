"""Reactions of loop joints in CSV and MCAP: the numbers and axes of `run.loops`."""

import numpy as np
import pyarrow.csv
import pytest

import closedloop as cl
from closedloop.figures.export.files import write_csv, write_mcap


@pytest.fixture(scope="module")
def run():
    """Return a short run of a four-bar."""
    return cl.simulate(cl.load_scenario("four_bar", {"time.duration": 0.01}))


def test_csv_has_the_reactions_of_loop_joints(run, tmp_path):
    """A column for each part, with its unit, to the bit."""
    table = pyarrow.csv.read_csv(write_csv(run, tmp_path / "run.csv")[0])
    for label, unit, values in zip(run.loops.labels, run.loops.units, run.loops.reactions.T, strict=True):
        assert np.array_equal(table[f"reaction {label} [{unit}]"], values)
    assert np.max(np.abs(run.loops.reactions)) > 1.0


def test_mcap_has_the_reactions_of_loop_joints(run, tmp_path):
    """A wrench for each loop joint and row, in the axes of its second frame."""
    reader = pytest.importorskip("mcap_ros2.reader")
    (loop,) = run.model.loops
    sent = [m.ros_msg for m in reader.read_ros2_messages(write_mcap(run, tmp_path / "run.mcap")[0], ["/loops/pin"])]
    assert len(sent) == len(run)
    wrenches = [[getattr(part, axis) for part in (m.wrench.force, m.wrench.torque) for axis in "xyz"] for m in sent]
    assert np.array_equal(wrenches, run.loops.reactions)
    assert {m.header.frame_id for m in sent} == {loop.frames[1]}
