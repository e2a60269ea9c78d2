"""Reactions of loop joints in CSV and MCAP: the numbers and axes of `run.loops`."""

import numpy as np
import pyarrow.csv
import pytest

import closedloop as cl
from closedloop.figures.export.files import write_csv, write_mcap
from closedloop.mechanics.loops.reactions import parts_of
from validation.loops import cases
from validation.loops.andrews import coasting


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


def test_each_loop_joint_has_its_own_topic(tmp_path):
    """Of a mechanism with two pins each wrench is that of its own columns, after those of the pin before."""
    reader = pytest.importorskip("mcap_ros2.reader")
    model = cases.doubled_four_bar()
    scenario = coasting(model, list(model.home), [0.0] * model.n, 0.01, 0.001)
    run = cl.simulate(scenario.replace({"external_force": [{"force": [10.0, 5.0, 3.0]}]}), model=model)
    assert np.min(np.ptp(run.loops.reactions.reshape(len(run), 2, 6)[:, :, :3], axis=2)) > 0.1
    path, at, seen = write_mcap(run, tmp_path / "run.mcap")[0], 0, 0
    for loop in run.model.loops:
        kinds = [what for what, _ in parts_of(run.model, loop)]
        own = run.loops.reactions[:, at : at + len(kinds)]
        at += len(kinds)
        sent = [m.ros_msg for m in reader.read_ros2_messages(path, [f"/loops/{loop.name}"])]
        forces = [[getattr(m.wrench.force, axis) for axis in "xyz"] for m in sent]
        assert np.array_equal(forces, own[:, :3])
        seen += len(sent)
    assert at == run.loops.reactions.shape[1]
    assert seen == len(run.model.loops) * len(run)
