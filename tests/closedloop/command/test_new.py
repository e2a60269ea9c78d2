"""``closedloop new``: a scenario that runs as it is, for many arms; nothing is replaced."""

import dataclasses
import errno
import os
import re

import numpy as np
import pytest
from budget import others

import closedloop as cl
import robot_models
from closedloop.__main__ import main
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.command.new import SPEEDS, _with_gains, first_slide
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.modes import unresolved_feedback
from robot_models.described import path_of

ARMS = ("wam4", "pointmass3", "ur5", "ur10", "panda", "kinova", "talos_arm", "xarm7")


@pytest.fixture
def new(capsys, monkeypatch, tmp_path):
    """Return a function that runs ``closedloop new`` in an empty folder and returns (status, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        capsys.readouterr()
        return main(["new", *words]), *capsys.readouterr()

    return call


def test_a_joint_that_does_not_move_the_tip_is_not_too_weak_to_press(new, tmp_path):
    """It is too weak for the weight that hangs on it, as a wheel on a spring that the file does not have."""
    geom = '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>'
    upper, lower = (f'<joint name="{name}" axis="0 1 0"/>{geom}' for name in ("a", "b"))
    arm = f'<body>{upper}<body pos=".3 0 0">{lower}<site name="end" pos=".3 0 0"/></body></body>'
    wheel = f'<body><joint name="wheel" axis="0 0 1" type="slide" actuatorfrcrange="-5 5"/>{geom}</body>'
    (tmp_path / "cart.xml").write_text(f"<mujoco><worldbody>{arm}{wheel}</worldbody></mujoco>")
    status, _, err = new("mine", "--robot", "cart.xml", "--tip", "end")
    assert status == 2
    assert "joint wheel is too weak for what it carries at rest, which takes 196% of its effort limit" in err


def test_what_no_drive_turns_bears_nothing():
    """A five-bar whose elbows are free has a load at its cranks alone, and one whose cranks are weak cannot press."""
    five_bar = robot_models.load("five_bar")

    def slide(*limits):
        model = dataclasses.replace(five_bar, effort_limit=np.array(limits))
        return first_slide(Robot(model), "five_bar")

    assert slide(60.0, 1e-6, 60.0, 1e-6).law.force == 10.0
    with pytest.raises(ScenarioError, match=r"joint J[12] is too weak to press with 10 N"):
        slide(0.3, 60.0, 0.3, 60.0)


def test_loops_that_no_posture_closes_are_named_at_once():
    """No start is sought for a four-bar whose last pin is two metres off."""
    four_bar = robot_models.load("four_bar")
    (pin,) = four_bar.loops
    apart = dataclasses.replace(pin, points=((2.0, 0.0, 0.0), pin.points[1]))
    with pytest.raises(ScenarioError, match=r"four_bar: its loops stay open by [\d.]+ m \(rad\) near the posture of"):
        first_slide(Robot(dataclasses.replace(four_bar, loops=(apart,))), "four_bar")


@pytest.mark.parametrize("robot", ["planar2", *others(ARMS)])
def test_what_is_written_runs_with_a_good_verdict(robot, new, tmp_path):
    """The file has a comment on its robot, and its run slides, presses as asked and is good."""
    status, out, err = new("my_slide", "--robot", robot)
    assert (status, err) == (0, "")
    assert "run it with: closedloop run my_slide.toml" in out
    text = (tmp_path / "my_slide.toml").read_text()
    assert text.startswith(f"# {robot} presses with 10 N and slides")
    assert text.count("#") > 15
    run = cl.simulate(cl.load_scenario("my_slide.toml"))
    assert run.summary()["verdict"]["good"]
    assert run.contact_force[-1] == pytest.approx(10.0, abs=0.01)
    assert abs(run.position[-1] - run.position[0]).max() > 0.01
    assert run.normal_mobility.min() > 0.02


def test_a_file_is_never_replaced(new, tmp_path):
    """What is there stays; a name that leads elsewhere, or is none, is refused before anything is looked for."""
    (tmp_path / "mine.toml").write_text("mine")
    assert new("mine", "--robot", "planar2")[::2] == (
        2, "closedloop: mine.toml: is there already and is not replaced; choose another name\n"
    )  # fmt: skip
    assert (tmp_path / "mine.toml").read_text() == "mine"
    assert "no folder 'nowhere'" in new("nowhere/mine", "--robot", "planar2")[2]
    assert new("a:b", "--robot", "planar2")[2].startswith("closedloop: a:b.toml: name = 'a:b': must be a plain name")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--robot", "double_pendulum"],
            "double_pendulum with the tip link2: no start was found from which it presses on a surface",
        ),
        (["--robot", "planar2", "--tip", "link1"], "planar2 with the tip link1: no start was found"),
        (["--robot", "planar2", "--tip", "link1"], "no joint moves the tip: it lies on their axes"),
        (["--robot", "double_pendulum"], "joint joint1 cannot move: its limits are [0, 0]"),
        (["--robot", "planar2", "--tip", "hand"], "planar2 has no frame 'hand'"),
        (["--robot", "nosuch"], "no robot is named 'nosuch'"),
        (["--robot", "planar2", "--force", "9000"], "is too weak to press with 9000 N: that takes "),
        (["--robot", "planar2", "--force", "-1"], "--force -1: must be greater than 0"),
    ],
)
def test_a_robot_that_will_not_do_is_refused_in_one_line(words, said, new, tmp_path):
    """The line says what is wrong, and no file is left."""
    status, out, err = new("mine", *words)
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert said in err
    assert not list(tmp_path.iterdir())


def test_a_robot_in_a_file_is_named_from_the_scenario(new, tmp_path):
    """The path is that from the folder of the scenario."""
    (tmp_path / "mine.urdf").write_bytes(path_of("planar2").read_bytes())
    (tmp_path / "deep").mkdir()
    assert new("deep/slide", "--robot", "mine.urdf", "--tip", "tip")[0] == 0
    assert re.search(r'^model = "../mine.urdf"', (tmp_path / "deep" / "slide.toml").read_text(), re.MULTILINE)
    cl.prepare(cl.load_scenario("deep/slide.toml"))


def test_a_scenario_of_the_robots_own_name_is_no_sidecar(new, tmp_path):
    """`closedloop new mine --robot mine.urdf` writes mine.toml beside it, which runs, with the file's stops."""
    (tmp_path / "mine.urdf").write_bytes(path_of("planar2").read_bytes())
    status, out, err = new("mine", "--robot", "mine.urdf")
    assert (status, err) == (0, "")
    assert "the tip is tip, the frame of a tool or the end of the longest chain; others, see --tip: base, link1" in out
    scenario = cl.load_scenario("mine.toml")
    assert scenario.robot.stops == bool(robot_models.load("mine.urdf").position_upper.max() < 10.0)
    cl.prepare(scenario)


def test_another_arm_that_cannot_hold_itself_at_home_is_put_where_it_can(new, tmp_path):
    """An arm beside the one that presses takes three times its limit at home; hanging down it takes nothing."""
    beside = """<link name="other"><inertial><origin xyz="0.5 0 0"/><mass value="3"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="beside"
    type="revolute"><parent link="base"/><child link="other"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="5" velocity="5"/></joint></robot>"""
    (tmp_path / "two.urdf").write_text(path_of("planar2").read_text().replace("</robot>", beside))
    assert new("mine", "--robot", "two.urdf", "--tip", "tip")[::2] == (0, "")
    run = cl.simulate(cl.load_scenario("mine.toml"))
    assert run.summary()["verdict"]["good"]
    assert abs(run.torque[:, list(run.model.joint_names).index("beside")]).max() < 5.0


def test_a_head_that_is_a_point_is_put_where_its_neck_moves_it(new, tmp_path):
    """At home two axes of the neck move the point the same way, so that H is singular; elsewhere they do not."""
    neck = "".join(
        f"""<link name="{name}"/><joint name="to_{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/>
        <axis xyz="{axis}"/><limit lower="-1" upper="1" effort="50" velocity="5"/><origin xyz="0 0 0.05"/></joint>"""
        for name, parent, axis in (("pitch", "base", "0 1 0"), ("roll", "pitch", "1 0 0"), ("yaw", "roll", "0 0 1"))
    )
    head = """<link name="head"><inertial><origin xyz="0 0 0.1"/><mass value="1"/><inertia ixx="0" iyy="0" izz="0"
    ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="on" type="fixed"><parent link="yaw"/><child link="head"/>
    <origin xyz="0.02 0 0"/></joint></robot>"""
    (tmp_path / "two.urdf").write_text(path_of("planar2").read_text().replace("</robot>", neck + head))
    assert new("mine", "--robot", "two.urdf", "--tip", "tip")[::2] == (0, "")
    scenario = cl.load_scenario("mine.toml")
    assert cl.simulate(scenario).summary()["verdict"]["good"]
    ahead = (*scenario.start.q[:2], 0.0, 0.0, 0.0)
    with pytest.raises(SimulationError, match="the mass matrix of two is not positive definite"):
        cl.simulate(scenario.replace({"start.q": ahead}))


def test_a_full_disk_leaves_no_file(new, tmp_path, monkeypatch):
    """The next ``new`` has nothing in its way; and a file that appears meanwhile is not replaced."""

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("closedloop.base.files.os.fsync", full)
        assert new("mine", "--robot", "planar2")[2] == (
            "closedloop: mine.toml: cannot be written: No space left on device\n"
        )
    assert not list(tmp_path.iterdir())

    def meanwhile(_):
        (tmp_path / "mine.toml").write_text("theirs")

    with monkeypatch.context() as patched:
        patched.setattr("closedloop.base.files.os.fsync", meanwhile)
        assert "is there already and is not replaced" in new("mine", "--robot", "planar2")[2]
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("mine.toml", "theirs")]


def test_gains_are_those_that_the_step_resolves(tmp_path):
    """Joints of a long chain move faster together than each alone: the step has to carry that, too."""
    axes, body = ("0 1 0", "0 0 1", "1 0 0"), '<geom type="capsule" fromto="0 0 0 .2 0 0" size=".03"/>'
    links = "".join(f'<body pos=".2 0 0"><joint name="j{k}" axis="{axes[k % 3]}"/>{body}' for k in range(12))
    path = tmp_path / "chain.xml"
    path.write_text(f'<mujoco><worldbody>{links}<site name="tip" pos=".2 0 0"/>{12 * "</body>"}</worldbody></mujoco>')
    robot, rng = Robot(robot_models.load(path), "tip"), np.random.default_rng(1)
    for _ in range(6):
        scenario = _with_gains(robot, str(path), 10.0, rng.uniform(-1.0, 1.0, 12), (0.0, 1.0, 0.0), 0.02)
        assert not unresolved_feedback(scenario, robot)


def test_a_finger_slides_as_far_as_it_reaches(tmp_path):
    """The usual 60 mm are too far for it, so it slides slowly, and less."""
    links = "".join(
        f'<body pos="{x} 0 0"><joint name="j{k}" axis="{axis}" range="{low} {high}"/>'
        '<geom type="capsule" fromto="0 0 0 .025 0 0" size=".008"/>'
        for k, (x, axis, low, high) in enumerate(
            [(0, "0 0 1", -20, 20), (0.01, "0 1 0", -10, 90), (0.025, "0 1 0", -10, 90), (0.025, "0 1 0", -10, 90)]
        )
    )
    path = tmp_path / "finger.xml"
    path.write_text(f'<mujoco><worldbody>{links}<site name="tip" pos=".025 0 0"/>{4 * "</body>"}</worldbody></mujoco>')
    robot = Robot(robot_models.load(path), "tip")
    assert first_slide(robot, str(path)).reference.speed < max(SPEEDS)


BOX = '<geom type="box" size=".02 .02 .02"/>'
FINGER = (
    '<body name="upper"><joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>'
    '<body name="lower" pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" '
    'size=".02"/><site name="tool" pos=".3 0 0"/></body></body>'
)


@pytest.mark.parametrize(
    ("bodies", "says", "kind"),
    [
        (
            f'<body><joint name="jaw" type="slide" axis="1 0 0" range="0 .04"/>{BOX}<site name="pad"/></body>',
            "presses with 10 N on a wall",
            "hold",
        ),
        (FINGER.replace("0 1 0", "0 0 1"), "slides 60 mm along a wall", "line"),
        (
            f'<body name="trunk" pos="0 0 1"><freejoint/>{BOX}{FINGER}</body>',
            "held rigid, see robot.lock: trunk",
            "line",
        ),
        (
            f'{FINGER}<body name="cube" pos="1 1 1"><freejoint name="loose"/>{BOX}</body>',
            "held rigid, see robot.lock: loose",
            "line",
        ),
    ],
    ids=["a pad of a gripper", "an arm that lies", "a trunk that is free", "a free body beside"],
)
def test_what_cannot_slide_along_a_level_surface_does_what_it_can(bodies, says, kind, new, tmp_path):
    """On a wall, without a slide, with what is free held where the file has it: each with a good verdict."""
    (tmp_path / "mine.xml").write_text(f"<mujoco model='mine'><worldbody>{bodies}</worldbody></mujoco>")
    status, out, err = new("trial", "--robot", "mine.xml")
    assert (status, err) == (0, "")
    assert says in out
    scenario = cl.load_scenario("trial.toml")
    assert scenario.reference.kind == kind
    run = cl.simulate(scenario)
    assert run.summary()["verdict"]["good"]
    assert run.contact_force[-1] == pytest.approx(scenario.law.force, abs=0.01)


def test_a_tip_that_no_drive_moves_is_named_at_once(new, tmp_path):
    """A body on joints without a drive, beside an arm: nothing could press it onto a surface."""
    target = (
        f'<body name="target"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide"/>{BOX}</body>'
    )
    text = f"<mujoco><worldbody>{FINGER}{target}</worldbody><actuator><motor joint='a'/></actuator></mujoco>"
    (tmp_path / "mine.xml").write_text(text)
    status, _, err = new("trial", "--robot", "mine.xml", "--tip", "target")
    assert status == 2
    assert "with the tip target: no joint with a drive moves it; another frame may work, see --tip" in err


def test_a_leg_on_a_trunk_that_nothing_drives_presses_as_on_a_stand(new, tmp_path):
    """The joints of the trunk are held where the file has them; the tip is the foot, not the goal beside it."""
    hinge = (
        '<joint name="{0}" axis="0 1 0" damping="1"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/>'
    )
    (tmp_path / "leg.xml").write_text(
        '<mujoco><worldbody><body name="trunk" pos="0 0 1"><joint name="rx" type="slide" axis="1 0 0"/>'
        '<joint name="rz" type="slide" axis="0 0 1" ref="1"/><joint name="ry" axis="0 1 0"/><geom size=".1" mass="3"/>'
        f'<body name="thigh">{hinge.format("hip")}<body name="foot" pos="0 0 -.4">{hinge.format("knee")}</body></body>'
        '</body><body name="goal"><joint name="gx" type="slide" axis="1 0 0"/>'
        '<joint name="gy" type="slide" axis="0 1 0"/><joint name="gz" type="slide" axis="0 0 1"/>'
        '<geom size=".1"/></body></worldbody><actuator><motor joint="hip"/><motor joint="knee"/></actuator></mujoco>'
    )
    status, out, err = new("stand", "--robot", "leg.xml")
    assert (status, err) == (0, "")
    assert "the tip is foot" in out
    assert "held rigid, see robot.lock: rx, rz, ry" in out
    scenario = cl.load_scenario("stand.toml")
    assert scenario.robot.lock == {"rx": 0.0, "rz": 1.0, "ry": 0.0}
    assert cl.simulate(scenario).summary()["verdict"]["good"]
