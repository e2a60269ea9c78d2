"""Loops that a YAML beside a URDF describes, as Gepetto's robots have them."""

import numpy as np
import pytest
from model_texts import INERTIAL, joint, link, urdf

import closedloop as cl
import robot_models
from closedloop.mechanics.loops.assemble import closed_start, errors_at
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.robot.pinocchio import Robot

# Two cranks on a base, bound at their ends by a rod; it closes with all angles zero.
FREE = dict.fromkeys(["limit"], '<limit effort="9" velocity="9"/>')
LINKS = ("base", ""), ("crank", INERTIAL), ("rod", INERTIAL), ("rocker", INERTIAL), ("end_a", ""), ("end_b", "")
JOINTS = (
    joint("motor", "base", "crank", kind="continuous", origin="0 0 0", **FREE),
    joint("knee", "crank", "rod", kind="continuous", origin="0 0 0.5", **FREE),
    joint("pin", "base", "rocker", kind="continuous", origin="1 0 0", **FREE),
    joint("close_a", "rod", "end_a", kind="fixed", origin="1 0 0", limit=""),
    joint("close_b", "rocker", "end_b", kind="fixed", origin="0 0 0.5", limit=""),
)


@pytest.fixture
def load(tmp_path):
    """Return what loads the mechanism with a YAML beside it."""

    def load(yaml, robot=None):
        robot = robot or urdf(*(link(name, content) for name, content in LINKS), *JOINTS)
        (tmp_path / "bars.urdf").write_text(robot)
        (tmp_path / "bars.yaml").write_text(yaml)
        return robot_models.load(tmp_path / "bars.urdf")

    return load


@pytest.mark.parametrize("frames", ["[end_a, end_b]", "['close_a', 'close_b']"])
@pytest.mark.parametrize(("kind", "rows"), [("3D", 3), ("6d", 6)])
def test_a_yaml_closes_loops_of_frames_and_names_the_motors(load, frames, kind, rows):
    """Frames are links or fixed joints; 6d holds their axes too; what has no motor turns freely."""
    model = load(f"closed_loop: [{frames}]\ntype: ['{kind}']\nname_mot: ['motor']\n")
    (loop,) = model.loops
    assert loop.frames == ("end_a", "end_b")
    assert loop.rows == rows
    assert model.drives == ("motor",)
    robot = Robot(model, "rod")
    error, _ = errors_at(robot, loop_memory(robot), np.zeros(3), np.zeros(3))
    assert np.abs(error).max() <= 1e-15


def test_a_mechanism_that_is_far_from_closed_is_assembled_within_its_limits(load):
    """From a posture 1 rad away it closes with every joint inside; a start by CAD's rounding needs no asking."""
    robot = Robot(load("closed_loop: [[end_a, end_b]]\ntype: [3d]\n"), "rod")
    q, _ = closed_start(robot, np.array([0.4, 2.0, -1.0]), np.zeros(3), assemble=True)
    assert np.abs(errors_at(robot, loop_memory(robot), q, np.zeros(3))[0]).max() <= 1e-12
    near, _ = closed_start(robot, np.array([4e-7, 0.0, 0.0]), np.zeros(3), assemble=False)
    assert 0.0 < np.abs(near).max() <= 4e-7


def test_ball_and_universal_joints_are_hinges_in_a_row(load):
    """Their mass matrix is that of the joint: H of the rod's turns is its inertia, in the axes of x, y, z in turn."""
    kinds = "joint_name: [knee, pin]\njoint_type: [SPHERICAL, UJOINT_XZ]\n"
    model = load(f"closed_loop: [[end_a, end_b]]\ntype: [3d]\nname_mot: [motor]\n{kinds}")
    assert model.joint_names == ("motor", "knee_X", "knee_Y", "knee_Z", "pin_X", "pin_Z")
    assert any("knee" in each and "90 degrees" in each for each in model.warnings)
    H = Robot(model, "rod").terms(np.zeros(6), np.zeros(6)).mass_matrix
    c, tensor = np.array([0.1, 0.02, 0.3]), np.array([[0.1, 0.01, 0.002], [0.01, 0.12, 0.003], [0.002, 0.003, 0.05]])
    assert H[1:4, 1:4] == pytest.approx(tensor + 2.0 * (c @ c * np.eye(3) - np.outer(c, c)), abs=1e-14)
    fixed = load("closed_loop: [[end_a, end_b]]\njoint_name: [knee]\njoint_type: [FIXED]\n")
    assert fixed.joint_names == ("motor", "pin")


def test_what_the_urdf_does_not_have_is_said(load):
    """A loop or a joint of another variant of the robot is left out with its name; wrong keys and types are refused."""
    model = load("closed_loop: [[end_a, end_b], [left_a, left_b]]\njoint_name: [left]\njoint_type: [SPHERICAL]\n")
    assert len(model.loops) == 1
    assert sum("left" in each for each in model.warnings) == 2
    for yaml, word in (
        ("closed_loop: [[end_a]]\n", "2 names"),
        ("closed_loop: [[end_a, end_b]]\ntype: [7d]\n", "7d"),
        ("closed_loop: [[left_a, left_b]]\n", "no frame"),
        ("closed_loop: [[end_a, end_b]]\nmotors: [a]\n", "unknown key 'motors'"),
        ("closed_loop: [[end_a, end_b]]\njoint_name: [knee]\njoint_type: [BALL]\n", "BALL"),
        ("closed_loop: [[end_a, end_b", "not valid YAML"),
    ):
        with pytest.raises(robot_models.ModelError, match=word.replace("[", r"\[")):
            load(yaml)
    assert not load("other: 1\n").loops


def test_a_joint_may_be_beyond_its_limit_by_rounding():
    """A posture 2e-6 rad beyond a limit is at it; one 2e-5 beyond it is refused."""
    model = robot_models.load("pointmass3")
    beyond = {"robot.model": "pointmass3", "start.v": [0, 0, 0], "law.kp": 0.0, "law.kd": 0.0, "time.duration": 0.002}
    for excess, fine in ((2e-6, True), (2e-5, False)):
        start = [float(model.position_upper[0]) + excess, 0.0, 0.0]
        scenario = cl.load_scenario("planar2_drop", beyond | {"start.q": start, "law.force": 0.0})
        if fine:
            names = [each["name"] for each in cl.simulate(scenario, progress=False).summary()["verdict"]["problems"]]
            assert "position_limit" not in names
        else:
            with pytest.raises(cl.ClosedLoopError, match="moves within"):
                cl.simulate(scenario, progress=False)
