"""[[body]]: free bodies beside a robot, in scenarios, overrides and run files."""

from pathlib import Path

import numpy as np
import pytest
from pyarrow.parquet import read_table

import closedloop as cl
from closedloop.command.sweep import main as sweep
from closedloop.run import main
from closedloop.scenario.load import parse_scenario

THROWN = """
[robot]
model = "pointmass3"
[[body]]
name = "ball"
shape = "ball"
radius = 0.05
mass = 2.0
position = [1, 2, 3]
velocity = [0.5, -0.25, 4]
spin = [1, 2, 3]
[time]
duration = 0.1
integrator = "rk4"
"""


def test_a_body_beside_an_arm_with_held_joints_changes_nothing_of_it() -> None:
    """The frames of the Panda's fingers, which are held, belong to themselves in what Pinocchio makes of it."""
    beside = {"body": [{"name": "ball", "shape": "ball", "radius": 0.05, "mass": 2.0, "position": [3, 3, 3]}]}
    alone, both = (cl.simulate(cl.load_scenario("panda_slide", {"time.duration": 0.01, **x})) for x in ({}, beside))
    np.testing.assert_allclose(both.contact_force, alone.contact_force, rtol=1e-12)
    assert both.model.require_frame("panda_leftfinger") == "panda_leftfinger"


def test_a_thrown_body_flies_its_parabola() -> None:
    """x = x0 + v0 t + g t²/2, and a ball turns evenly about its axis, whatever the robot beside it does."""
    run = cl.simulate(parse_scenario(THROWN), progress=False)
    t, names = run.time, run.model.coordinate_names
    x = run.q[:, [names.index(f"ball_{axis}") for axis in "xyz"]]
    wanted = np.array([1, 2, 3]) + t[:, None] * [0.5, -0.25, 4] + 0.5 * t[:, None] ** 2 * [0, 0, -9.81]
    np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-14)
    rate = np.sqrt(14.0)
    half = 0.5 * rate * t
    turn = np.column_stack([np.cos(half), np.sin(half)[:, None] * np.array([1, 2, 3]) / rate])
    np.testing.assert_allclose(run.q[:, [names.index(f"ball_q{part}") for part in "wxyz"]], turn, atol=1e-12)


def test_lists_may_leave_out_bodies() -> None:
    """start.q, start.v and the lists of a law are the robot's own, or those of all coordinates."""
    short = parse_scenario(THROWN, overrides={"start.q": [0.1, 0.2, 0.3], "start.v": [1, 0, 0]})
    whole = {
        "start.q": [0.1, 0.2, 0.3, 1, 2, 3, 1, 0, 0, 0],
        "start.v": [1, 0, 0, 0.5, -0.25, 4, 1, 2, 3],
    }
    law = {"law.kind": "paper", "law.kp": [10, 10, 10], "law.kd": [1, 1, 1]}
    for more in ({}, law):
        one = cl.simulate(parse_scenario(short.to_toml(), overrides=more), progress=False)
        other = cl.simulate(parse_scenario(THROWN, overrides=whole | more), progress=False)
        assert np.array_equal(one.q, other.q)
    assert not np.array_equal(one.q[-1, :3], cl.simulate(short, progress=False).q[-1, :3])


def test_a_run_file_has_the_bodies(tmp_path: Path) -> None:
    """It repeats the run, and a key that is overridden acts: place and mass alike."""
    (tmp_path / "thrown.toml").write_text(THROWN)
    out = tmp_path / "out"
    assert main([str(tmp_path / "thrown.toml"), "--out", str(out), "--no-figures"]) == 0
    again = tmp_path / "again"
    assert main([str(out / "run.nc"), "--out", str(again), "--no-figures"]) == 0
    first, second = cl.load_run(out / "run.nc"), cl.load_run(again / "run.nc")
    assert np.array_equal(first.q, second.q)
    moved = tmp_path / "moved"
    changes = ["--body.ball.mass", "3", "--body.ball.position", "[0,0,5]"]
    assert main([str(out / "run.nc"), "--out", str(moved), "--no-figures", *changes]) == 0
    run = cl.load_run(moved / "run.nc")
    assert run.q[0, 3:6].tolist() == [0, 0, 5]
    assert run.model.pinocchio_model().inertias[-1].mass == 3.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"body.ball.edges": [1, 1, 1]}, "edges must be left out: the size of a ball is radius"),
        ({"body.ball.shape": "box"}, "edges is missing: the size of a box is edges"),
        ({"body.ball.shape": "cone"}, "body"),
        ({"body.ball.mass": 0}, "mass"),
        ({"body.ball.quaternion": [0, 0, 0, 0]}, "quaternion has length zero"),
        ({"body.ball.quaternion": [0, 0, 1]}, r"quaternion = \[0, 0, 1\]: must be four numbers"),
        ({"body.bal.mass": 1}, "there is no body 'bal'"),
        ({"start.q": [0, 0]}, "start.q has 2 entries.*10, or 3 without those that move freely"),
        ({"start.v": [0] * 8}, "start.v has 8 entries.*9, or 3 without"),
    ],
)
def test_what_cannot_be_is_one_line(changes: dict[str, object], words: str) -> None:
    """Each fault names its key and what would be right."""
    with pytest.raises(cl.ScenarioError, match=words) as caught:
        cl.simulate(parse_scenario(THROWN, overrides=changes), progress=False)
    assert all("\n" not in fault for fault in caught.value.faults)


def test_no_robot_and_no_body_is_nothing() -> None:
    """A scenario without a robot needs a body."""
    with pytest.raises(cl.ModelError, match="there is no body, and no robot"):
        cl.simulate(parse_scenario('[robot]\nmodel = "none"'), progress=False)


def test_a_sweep_over_a_body(tmp_path: Path) -> None:
    """Keys of bodies are keys of sweeps, of bodies alone too."""
    file, out = tmp_path / "thrown.toml", tmp_path / "sweep.parquet"
    file.write_text(THROWN.replace("pointmass3", "none"))
    assert sweep([str(file), "--over", "body.ball.mass=1:3:2", "--out", str(out)]) == 0
    table = read_table(out).to_pydict()
    assert table["body.ball.mass"] == [1.0, 3.0]
    assert table["verdict"] == ["good", "good"]


def test_encoders_read_the_arm_beside_a_body() -> None:
    """Its joints are read with noise and in steps; the body, which no encoder reads, is known as it is."""
    arm = {"law.kind": "paper", "law.kp": [100.0] * 3, "law.kd": [10.0] * 3, "encoder.quantisation": 1e-3}
    run = cl.simulate(parse_scenario(THROWN, overrides=arm | {"start.v": [0.2, -0.1, 0.3]}), progress=False)
    steps = run.measured_position[:, :3] / 1e-3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.max(np.abs(run.measured_position[:, :3] - run.q[:, :3])) > 1e-5
    names = run.model.joint_names
    x = [names.index(f"ball_{axis}") for axis in "xyz"]
    np.testing.assert_array_equal(run.measured_position[:, x], run.q[:, x])
    np.testing.assert_array_equal(run.measured_velocity[:, 3:], run.v[:, 3:])


RUBBING = {
    "coulomb": {"kinetic": 0.3},
    "coulomb_viscous": {"kinetic": 0.3, "viscous": 0.5},
    "dahl": {"kinetic": 0.3, "stiffness": 100.0},
    "karnopp": {"kinetic": 0.2, "static": 0.3, "viscous": 0.1, "dead_band": 1e-3},
    "lugre": {"kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.01, "stiffness": 1e3, "damping": 3.0},
    "seven_parameter": {
        "kinetic": 0.2, "static_excess": 0.1, "stribeck_speed": 0.01, "stiffness": 1e3, "memory_delay": 5e-3,
        "rise_time": 0.1,
    },
    "stribeck": {"kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.01},
}  # fmt: skip


@pytest.mark.parametrize("scheme", ["rk4", "semi_implicit_euler"])
@pytest.mark.parametrize("kind", RUBBING)
def test_no_friction_of_joints_acts_on_a_free_body(kind: str, scheme: str) -> None:
    """A thrown ball flies as without it, while the arm is braked; a list may leave out the body, or have it."""
    moves = {"start.v": [1, -0.5, 0.2], "time.integrator": scheme, "robot.gravity": [0, 0, 0]}
    plain = cl.simulate(parse_scenario(THROWN, overrides=moves), progress=False)
    runs = []
    for count in (0, 3, 9):
        section = {key: [value] * count if count else value for key, value in RUBBING[kind].items()}
        changes = moves | {f"joint_friction.{key}": value for key, value in section.items()}
        changes |= {"joint_friction.kind": kind}
        runs.append(cl.simulate(parse_scenario(THROWN, overrides=changes), progress=False))
    np.testing.assert_allclose(runs[0].v[:, 3:], plain.v[:, 3:], rtol=1e-13)
    assert np.all(np.abs(runs[0].joint_friction[1:, :3]) > 0.0)
    assert not np.any(runs[0].joint_friction[:, 3:])
    assert np.max(np.abs(runs[0].v[-1, :3] - plain.v[-1, :3])) > 1e-3
    for run in runs[1:]:
        assert np.array_equal(run.q, runs[0].q)
