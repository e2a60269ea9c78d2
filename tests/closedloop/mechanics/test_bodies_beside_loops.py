"""Free bodies beside a mechanism with loops: neither changes the other, until they touch."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from test_loop_coordinates import cut_at_pin, posture

import closedloop as cl
import robot_models
from closedloop.scenario.load import parse_scenario

BALL = {
    "name": "ball", "shape": "ball", "radius": 0.05, "mass": 2.0, "position": [3, 3, 3], "velocity": [0.5, -0.25, 4],
    "spin": [1, 2, 3],
}  # fmt: skip


def beside(run, alone):
    """Which positions and which velocities of a run with bodies are those of one without."""
    names = run.model.coordinate_names, run.model.joint_names
    wanted = alone.model.coordinate_names, alone.model.joint_names
    return tuple([own.index(name) for name in these] for own, these in zip(names, wanted, strict=True))


def place(run, name="ball"):
    """Where the body is, (N, 3), m."""
    return run.q[:, [run.model.coordinate_names.index(f"{name}_{axis}") for axis in "xyz"]]


def lands_as_thrown(run):
    """Whether the ball flies its parabola, to the order of the scheme."""
    t, h = run.time[:, None], run.scenario.time.step
    scheme = {"rk4": 0.0, "semi_implicit_euler": 0.5 * h}[run.scenario.time.integrator]  # g is half a step late there
    wanted = np.array([3, 3, 3]) + t * [0.5, -0.25, 4] - 9.81 * np.array([0, 0, 1]) * (0.5 * t * t + scheme * t)
    return np.abs(place(run) - wanted).max() < 1e-12


@pytest.mark.parametrize("name", ["four_bar", "gripper_gear", "five_bar", "delta", "stewart"])
def test_a_thrown_ball_changes_nothing_of_a_mechanism(name):
    """Its joints, its torque and its contact are the same, and so are what its loops carry; the ball flies."""
    changes = {"time.duration": 0.03}
    alone = cl.simulate(cl.load_scenario(name, changes), progress=False)
    both = cl.simulate(cl.load_scenario(name, changes | {"body": [BALL]}), progress=False)
    q, v = beside(both, alone)
    np.testing.assert_allclose(both.q[:, q], alone.q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(both.v[:, v], alone.v, rtol=0, atol=1e-11)
    np.testing.assert_allclose(both.torque[:, v], alone.torque, rtol=0, atol=1e-10)
    np.testing.assert_allclose(both.contact_force, alone.contact_force, rtol=0, atol=1e-9)
    np.testing.assert_allclose(both.loops.reactions, alone.loops.reactions, rtol=0, atol=1e-8)
    assert lands_as_thrown(both)
    assert not both.summary()["verdict"]["problems"]


GRIPPER = """
[robot]
model = "{model}"
[surface]
kind = "none"
normal = [-1, 0, 0]
[[body]]
name = "cube"
shape = "box"
edges = [0.06, 0.06, 0.06]
mass = 0.5
position = [0, 0, 0.03]
[[contact]]
name = "left"
link = "left_finger"
at = [[0, -0.02, -0.08], [0, 0.02, -0.08], [0, -0.02, -0.06], [0, 0.02, -0.06]]
against = "cube"
normal = [-1, 0, 0]
through = [-0.03, 0, 0]
friction = 0.4
[[contact]]
name = "right"
link = "right_finger"
at = [[0, -0.02, -0.08], [0, 0.02, -0.08], [0, -0.02, -0.06], [0, 0.02, -0.06]]
against = "cube"
normal = [1, 0, 0]
through = [0.03, 0, 0]
friction = 0.4
[[contact]]
name = "floor"
link = "cube"
at = "collision"
friction = 0.4
[reference]
kind = "line"
direction = [0, 0, 1]
speed = 0.1
start = 0.1
stop = 0.4
timing = "minimum_jerk"
[law]
kind = "paper"
kp = [4000, 0, 0]
kd = [200, 5, 0]
force = 40.0
[stabiliser]
time_constant = 0.01
[time]
duration = 0.5
integrator = "rk4"
"""


SIDECAR = """
tip = "pad"
drives = ["lift", "left_slide"]
[home]
left_slide = 0.02
right_slide = 0.02
[[closed_loop]]
name = "gear"
type = "gear"
joints = ["right_slide", "left_slide"]
polynomial = [0, 1]
"""


@pytest.fixture(scope="module")
def lifted(tmp_path_factory):
    """The gripper whose fingers a gear couples, without the block of its file, lifts a free cube."""
    folder = tmp_path_factory.mktemp("gripper")
    root = ET.fromstring(robot_models.load("gripper").text)
    for element in [each for each in root if each.get("name", "").startswith("block")]:
        root.remove(element)
    (folder / "two.urdf").write_text(ET.tostring(root, encoding="unicode"))
    (folder / "two.toml").write_text(SIDECAR)
    scenario = parse_scenario(GRIPPER.format(model=folder / "two.urdf"))
    return cl.simulate(scenario, progress=False)


def test_a_gripper_with_a_gear_lifts_a_free_cube(lifted):
    """The cube goes up with the hand, upright; the fingers stay coupled; no contact is entered."""
    z, hand = place(lifted, "cube")[:, 2], lifted.q[:, lifted.model.coordinate_names.index("lift")]
    assert z[-1] - z[0] > 0.02
    np.testing.assert_allclose((z - hand)[-100:], (z - hand)[-1], atol=1e-6)
    left, right = (lifted.q[:, lifted.model.coordinate_names.index(f"{side}_slide")] for side in ("left", "right"))
    np.testing.assert_allclose(left, right, atol=1e-12)
    at = lifted.model.coordinate_names.index("cube_qw")
    np.testing.assert_allclose(lifted.q[:, at], 1.0, atol=1e-9)
    assert lifted.link_gaps.min() > -1e-9
    assert not lifted.summary()["verdict"]["problems"]


def test_the_equation_of_motion_holds_in_every_row(lifted):
    """H q̈ + C − Q less what contacts and loops give is rounding; of the free cube it is m z̈ + m g."""
    size = np.max(np.abs(lifted.torque)) + 10.0
    assert np.max(lifted.loops.unexplained) < 1e-11 * size


def test_coordinates_of_a_loop_joint_beside_a_body(tmp_path):
    """A loop joint with friction is a joint of the tree; start.q leaves out it, the body, both or neither."""
    model = cut_at_pin(tmp_path, drives=("J1",), friction=0.2, damping=0.1)
    j1, j2, j3, pin = posture(1.1)
    file = tmp_path / "at_pin.urdf"
    text = f'[robot]\nmodel = "{file}"\n[time]\nduration = 0.03\nintegrator = "rk4"'
    alone = cl.simulate(parse_scenario(text, overrides={"start.q": [j1, j2, j3]}), progress=False)
    runs = []
    named = {"J1": j1, "J2": j2, "J3": j3, "pin": pin}
    for q in ([j1, j2, j3], [named[name] for name in model.joint_names]):
        runs.append(cl.simulate(parse_scenario(text, overrides={"body": [BALL], "start.q": q}), progress=False))
    for run in runs:
        q, v = beside(run, alone)
        np.testing.assert_allclose(run.q[:, q], alone.q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(run.v[:, v], alone.v, rtol=0, atol=1e-10)
        assert lands_as_thrown(run)


def test_a_run_file_of_both_loads_and_runs_again(lifted, tmp_path):
    """The robot that comes back is the same, and so is a run with it."""
    again = cl.load_run(lifted.save(tmp_path / "run.nc"))
    assert again.model.coordinate_names == lifted.model.coordinate_names
    assert np.array_equal(again.model.home, lifted.model.home)
    repeated = cl.simulate(again.scenario, model=again.model, progress=False)
    assert np.array_equal(repeated.q, lifted.q)
