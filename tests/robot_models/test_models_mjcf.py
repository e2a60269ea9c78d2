"""An MJCF means to Pinocchio what it means to MuJoCo, or is refused."""

import numpy as np
import pinocchio as pin
import pytest
from model_texts import MJCF_INERTIAL, mjcf

import robot_models

CLASSES = (
    '<default><joint armature="1" axis="1 0 0"/><site pos="0 0 0.3"/>'
    '<default class="k"><joint range="-10 10"/>'
    '<default class="k2"><joint armature="2"/></default></default></default>'
)

SAME = {
    "plain": mjcf(),
    "radians and a long axis": mjcf(
        head='<compiler angle="radian"/>', joint='<joint name="shoulder" axis="0 2 0" range="-1 1"/>'
    ),
    "compiler after the bodies": mjcf(tail='<compiler angle="radian"/>'),
    "euler sequence": mjcf(head='<compiler eulerseq="zyx"/>'),
    "gravity": mjcf(head='<option gravity="1 -2 -3"/>'),
    "joint off the body's origin": mjcf(joint='<joint name="shoulder" axis="0 1 0" pos="0.1 0.2 0.3"/>'),
    "slide": mjcf(joint='<joint name="shoulder" type="slide" axis="0 1 1"/>'),
    "class": mjcf(head=CLASSES, joint='<joint name="shoulder" class="k2"/>'),
    "childclass": mjcf(head=CLASSES, base='<body name="base" childclass="k2">'),
    "class inside a childclass": mjcf(
        head=CLASSES + "",
        base='<body name="base" childclass="k2">',
        joint='<joint name="shoulder" class="k"/>',
    ),
    "full inertia": mjcf(inertial='<inertial pos="0 0.1 0" mass="1" fullinertia="1 1.2 1.3 0.1 0.2 0.3"/>'),
    "moving base": mjcf(base=f'<body name="base" pos="0 0 1"><joint name="rail" type="slide"/>{MJCF_INERTIAL}'),
    "welded link": mjcf(joint=""),
    "a long axis of a turn": mjcf(base='<body name="base" axisangle="0 3 4 40">'),
    "two axes": mjcf(base='<body name="base" xyaxes="1 2 0 0 1 1">'),
    "z axis": mjcf(base='<body name="base" zaxis="1 2 3">'),
    "z axis turned over": mjcf(base='<body name="base" zaxis="0 0 -2">'),
    "range of a slide, in metres": mjcf(joint='<joint name="shoulder" type="slide" range="-0.1 0.4"/>'),
    "two arms": mjcf(world=f'<body name="other" pos="1 0 0"><joint name="free"/>{MJCF_INERTIAL}</body>'),
    "visual mesh": mjcf(
        inner='<geom type="mesh" mesh="m"/>',
        tail='<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>',
    ),
    "box": mjcf(inertial='<geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0" euler="10 20 30"/>'),
    "sphere": mjcf(inertial='<geom size="0.1" density="300"/>'),
    "capsule": mjcf(inertial='<geom type="capsule" size="0.1" fromto="0 0 0 0.1 0.2 0.5"/>'),
    "cylinder": mjcf(inertial='<geom type="cylinder" size="0.1 0.3" mass="3"/>'),
    "ellipsoid and box": mjcf(
        inertial='<geom type="ellipsoid" size="0.1 0.2 0.3"/><geom type="box" size="0.1 0.1 0.1" pos="1 0 0"/>'
    ),
}


def load(tmp_path, text):
    """Return the robot of a text."""
    path = tmp_path / "robot.xml"
    path.write_text(text)
    return robot_models.load(path)


@pytest.mark.parametrize("case", SAME)
def test_agrees_with_mujoco(tmp_path, case):
    """The same mass matrix, bias and places of bodies as MuJoCo's, from the file and from our text."""
    mujoco = pytest.importorskip("mujoco")
    robot = load(tmp_path, SAME[case])
    model = robot.pinocchio_model()
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, robot.n))
    data = model.createData()
    upper = np.triu(pin.crba(model, data, q))
    H = upper + np.triu(upper, 1).T
    C = pin.nonLinearEffects(model, data, q, v)
    pin.framesForwardKinematics(model, data, q)
    for text in (SAME[case], robot.text):
        theirs = mujoco.MjModel.from_xml_string(text)
        their_data = mujoco.MjData(theirs)
        order = [theirs.joint(name).qposadr[0] for name in robot.joint_names]
        their_data.qpos[order], their_data.qvel[order] = q, v
        mujoco.mj_forward(theirs, their_data)
        full = np.column_stack([_mass_column(mujoco, theirs, their_data, k) for k in range(theirs.nv)])
        np.testing.assert_allclose(H, full[np.ix_(order, order)], atol=1e-11)
        np.testing.assert_allclose(C, their_data.qfrc_bias[order], atol=1e-11)
        for name in robot.frames:
            kind = "site" if name == "touch" else "body"
            place = getattr(their_data, kind)(name).xpos
            np.testing.assert_allclose(data.oMf[model.getFrameId(name)].translation, place, atol=1e-13)
        bounded = np.array([theirs.joint(name).limited[0] for name in robot.joint_names], dtype=bool)
        np.testing.assert_array_equal(np.isfinite(robot.position_upper), bounded)
        upper = np.array([theirs.joint(name).range[1] for name in robot.joint_names])
        np.testing.assert_allclose(robot.position_upper[bounded], upper[bounded], rtol=1e-12)


def _mass_column(mujoco, model, data, k):
    unit, column = np.zeros(model.nv), np.zeros(model.nv)
    unit[k] = 1.0
    mujoco.mj_mulM(model, data, column, unit)
    return column


def test_pinocchio_alone_would_lose_the_base(tmp_path):
    """The reason for our reading: given the file as it is, Pinocchio 4.1 drops the pose of the still base."""
    robot = load(tmp_path, mjcf())
    ours, alone = robot.pinocchio_model(), pin.buildModelFromMJCF(str(tmp_path / "robot.xml"))
    q = np.array([0.3, 0.4])
    gravity = [pin.computeGeneralizedGravity(m, m.createData(), q) for m in (ours, alone)]
    assert np.abs(gravity[0] - gravity[1]).max() > 0.1


def test_fields(tmp_path):
    """Limits, types, armature, gravity and the keyframe are those of the file, in its units."""
    robot = load(
        tmp_path,
        mjcf(
            head='<option gravity="0 0 -1.62"/>',
            tail='<keyframe><key name="x" qpos="9 9"/><key name="home" qpos="0.1 0.2"/></keyframe>',
        ),
    )
    assert robot.joint_types == ("revolute", "continuous")
    np.testing.assert_allclose(robot.position_upper, [np.pi / 2, np.inf])
    np.testing.assert_array_equal(robot.armature, [0.3, 0])
    np.testing.assert_array_equal(robot.gravity, [0, 0, -1.62])
    np.testing.assert_array_equal(robot.home, [0.1, 0.2])
    assert robot.frames == ("base", "upper", "fore", "hand", "touch")
    assert robot.tip == "hand"
    assert robot.require_frame("touch") == "touch"


def test_drive_inertia_switches_the_files_armature(tmp_path):
    """Off means off, whatever the file says."""
    path = tmp_path / "robot.xml"
    path.write_text(mjcf())
    assert not robot_models.load(path, drive_inertia=False).pinocchio_model().armature.any()
    assert robot_models.load(path).pinocchio_model().armature.tolist() == [0.3, 0]


def test_includes_are_inlined(tmp_path):
    """The text stands by itself: rebuilt without the files, and once a file."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "hand.xml").write_text(
        f'<mujocoinclude><body name="held">{MJCF_INERTIAL}</body></mujocoinclude>'
    )
    robot = load(tmp_path, mjcf(inner='<include file="parts/hand.xml"/>'))
    assert "held" in robot.frames
    assert "include" not in robot.text
    copy = robot_models.from_text(
        robot.text, "mjcf", name="a", armature=robot.armature, tip="held", home=robot.home, locked={}
    )
    assert copy.text == robot.text
    q = np.array([0.3, 0.4])
    one, other = (pin.crba(r.pinocchio_model(), r.pinocchio_model().createData(), q) for r in (robot, copy))
    np.testing.assert_array_equal(one, other)
    with pytest.raises(robot_models.ModelError, match="included twice"):
        load(tmp_path, mjcf(inner='<include file="parts/hand.xml"/>' * 2))
    with pytest.raises(robot_models.ModelError, match="stand by itself"):
        robot_models.from_text(
            mjcf(inner='<include file="parts/hand.xml"/>'),
            "mjcf",
            name="a",
            armature=[0, 0],
            tip=None,
            home=[0, 0],
            locked={},
        )


def test_locking_in_an_mjcf(tmp_path):
    """A lock welds an MJCF's joint as it does a URDF's."""
    path = tmp_path / "robot.xml"
    path.write_text(mjcf())
    robot = robot_models.load(path, lock={"elbow": 0.5})
    assert robot.joint_names == ("shoulder",)
    assert robot.armature.tolist() == [0.3]


def test_friction_of_an_mjcf_is_noted(tmp_path):
    """Damping and friction loss do not act; a line says so, also for what a run stored."""
    robot = load(tmp_path, mjcf())
    assert any("damping and frictionloss; shoulder" in note for note in robot.notes)
    copy = robot_models.from_text(
        robot.text, "mjcf", name="a", armature=robot.armature, tip="hand", home=robot.home, locked={}
    )
    assert (copy.text, copy.notes) == (robot.text, robot.notes)
    smooth = load(tmp_path, mjcf(joint='<joint name="shoulder" axis="0 1 0" damping="0.0"/>'))
    assert smooth.notes == ()


def test_two_zeros_are_no_range(tmp_path):
    """As in MuJoCo, a range of two zeros is none."""
    robot = load(tmp_path, mjcf(joint='<joint name="shoulder" range="0 0" actuatorfrcrange="0 0"/>'))
    assert robot.position_upper[0] == robot.effort_limit[0] == np.inf
    assert robot.joint_types[0] == "continuous"


def test_the_schema_is_mujocos():
    """Every element and attribute that MuJoCo lists, and no other."""
    import re

    mujoco = pytest.importorskip("mujoco")
    from robot_models.mjcf_schema import _FILE, _split

    listed: list[list[str]] = []
    for line in mujoco.mj_printSchema(False, True).splitlines():
        begins = re.match(r"^( {0,15})([a-zA-Z0-9_()]+) \((.)\)(.*)$", line)
        if begins:
            depth, tag = len(begins[1]) // 3, begins[2].replace("(world)", "")
            listed.append([".." * depth + tag, begins[3], *begins[4].split()])
        elif line.strip():
            listed[-1] += line.split()
    held = [line.split() for line in _FILE.read_text().splitlines()]
    ours = [[*line[:2], *(_split(word)[0] for word in line[2:])] for line in held]
    assert ours == [[*line[:2], *sorted(line[2:])] for line in listed]
