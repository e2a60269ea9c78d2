"""An MJCF means to Pinocchio what it means to MuJoCo, or is refused."""

import gc
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from model_texts import MJCF_INERTIAL, load, mjcf

import robot_models
from robot_models import mjcf as reader
from robot_models.coordinates import in_pinocchios_order, normalised

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


CUBE = '<asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .2 0 0 0 .3 .1 .2 .3"/></asset>'
# One for each thing that files of real robots have.
SAME |= {
    "three joints of a body": mjcf(
        joint='<joint name="shoulder" axis="0 1 0" pos=".1 0 0"/><joint name="b" type="slide" axis="1 1 0" '
        'armature=".3"/><joint name="c" pos="0 .2 .1"/>'
    ),
    "a body and joints without names": mjcf(
        inner=f'<body pos="0 .1 0"><joint/>{MJCF_INERTIAL}<body pos="0 0 .2"><joint type="ball"/>{MJCF_INERTIAL}<site/>'
        "</body></body>"
    ),
    "ref": mjcf(
        joint='<joint name="shoulder" axis="0 1 0" pos=".1 .2 0" ref="30"/><joint type="slide" name="b" ref=".2"/>'
    ),
    "frame and replicate": mjcf(
        inner=f'<frame pos="0 0 1" euler="10 20 30"><body name="k" pos="0 1 0"><joint name="l"/>{MJCF_INERTIAL}</body>'
        f'</frame><replicate count="3" euler="0 0 40"><body name="r" pos=".1 0 0"><joint name="s"/>{MJCF_INERTIAL}'
        "</body></replicate>"
    ),
    "several defaults": mjcf(
        head='<default><joint armature=".2"/></default><default><joint damping="3"/></default>'
    ),
    "inertia from geoms": mjcf(
        head='<compiler inertiafromgeom="true"/>',
        inner='<geom size=".1"/><geom type="box" size=".1 .2 .3" pos="1 0 0"/>',
    ).replace("</body></body></body>", '<geom size=".2"/></body><geom size=".1"/></body></body>'),
    "inertia from a mesh": mjcf(head=CUBE, inertial='<geom type="mesh" mesh="m" pos="0 .1 0" euler="10 0 0"/>'),
    "geoms without contact": mjcf(inertial='<geom size="0.1" contype="0" conaffinity="0"/>'),
    "free body, with a limit that is none": mjcf(
        head='<default><joint limited="true"/></default>',
        world='<body name="box" pos="1 2 3" euler="10 20 30"><joint type="free" name="f" limited="false"/>'
        f"{MJCF_INERTIAL}</body>",
        joint='<joint name="shoulder" range="-90 90"/>',
    ).replace('<joint name="elbow"', '<joint name="elbow" limited="false"'),
    "axes turned to the principal ones": mjcf(
        world=f'<body name="box" pos="1 2 3"><freejoint align="true"/>{MJCF_INERTIAL}</body>'
    ),
    "a site on a body that is fixed to a fixed body": mjcf(
        base='<body name="base" pos="0.3 0 1" euler="15 0 0"><body name="p" pos="0 .1 0" euler="0 30 0">'
        '<body name="deep" pos=".2 0 0" euler="10 0 0"><site name="mark" pos="0 0 .1"/></body></body>'
    ),
    "mocap body": mjcf(world='<body name="target" mocap="true" pos="1 0 0"><geom size=".1"/></body>'),
    "fixed axes of Euler angles": mjcf(head='<compiler eulerseq="XYZ"/>'),
    "no gravity by a flag": mjcf(head='<option><flag gravity="disable"/></option>'),
    "what does no work": mjcf(
        inner='<camera name="c"/><light/>',
        tail='<contact><exclude body1="upper" body2="base"/></contact><sensor><jointpos joint="elbow"/></sensor>',
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SAME)
def test_agrees_with_mujoco(tmp_path, case):
    """The same mass matrix, bias and places of bodies as MuJoCo's, in its order, from the file and from our text."""
    robot = load(tmp_path, SAME[case])
    model = robot.pinocchio_model()
    theirs = mujoco.MjModel.from_xml_string(SAME[case])
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=theirs.nq), rng.normal(size=theirs.nv)
    q = normalised(q, robot.joint_types, "q")
    data, own = model.createData(), in_pinocchios_order(q, robot.joint_types)
    upper = np.triu(pin.crba(model, data, own))
    H = upper + np.triu(upper, 1).T
    C = pin.nonLinearEffects(model, data, own, v)
    pin.framesForwardKinematics(model, data, own)
    assert len(robot.home) == theirs.nq
    for their in (theirs, mujoco.MjModel.from_xml_string(robot.text)):
        their_data = mujoco.MjData(their)
        their_data.qpos[:], their_data.qvel[:] = q, v
        mujoco.mj_forward(their, their_data)
        full = np.column_stack([_mass_column(their, their_data, k) for k in range(their.nv)])
        np.testing.assert_allclose(H, full, atol=1e-11)
        np.testing.assert_allclose(C, their_data.qfrc_bias, atol=1e-11)
        bodies = {their.body(b).name: their_data.xpos[b] for b in range(their.nbody)}
        sites = {their.site(s).name: their_data.site_xpos[s] for s in range(their.nsite)}
        places = {name: place for name, place in (bodies | sites).items() if name not in ("", "world")}
        assert set(places) <= set(robot.frames)
        for name, place in places.items():
            np.testing.assert_allclose(data.oMf[model.getFrameId(name)].translation, place, atol=1e-13)
        single = their.jnt_type > 1
        at = their.jnt_dofadr[single]
        bounded = their.jnt_limited[single].astype(bool)
        np.testing.assert_array_equal(np.isfinite(robot.position_upper[at]), bounded)
        np.testing.assert_allclose(robot.position_upper[at][bounded], their.jnt_range[single][bounded, 1], rtol=1e-12)
    again = robot_models.from_text(
        robot.text, "mjcf", name="again", armature=robot.armature, tip=robot.tip, home=robot.home, locked={}
    )
    assert again.text == robot.text
    np.testing.assert_array_equal(pin.nonLinearEffects(again.pinocchio_model(), model.createData(), own, v), C)


def _mass_column(model, data, k):
    unit, column = np.zeros(model.nv), np.zeros(model.nv)
    unit[k] = 1.0
    mujoco.mj_mulM(model, data, column, unit)
    return column


def test_what_does_no_work_is_left_out_with_a_warning(tmp_path):
    """One line each, that names it; a plain arm has none."""
    said = " ".join(load(tmp_path, SAME["what does no work"]).warnings)
    for word in ("cameras", "lights", "sensors", "exclude"):
        assert word in said
    assert "'target'" not in said
    assert any("mocap bodies" in line and "target" in line for line in load(tmp_path, SAME["mocap body"]).warnings)
    assert load(tmp_path, mjcf()).warnings == []
    reversed_range = mjcf(joint='<joint name="shoulder" range="1 -1"/>')
    assert any("'shoulder'" in line and "range" in line for line in load(tmp_path, reversed_range).warnings)
    comp = mjcf(base='<body name="base" gravcomp="1">')
    assert any("gravcomp" in line and "base" in line for line in load(tmp_path, comp).warnings)


def test_meshes_that_are_only_drawn_need_not_be_there(tmp_path):
    """MuJoCo opens every file; of a mesh from which no inertia follows, and of a texture, nothing is needed here."""
    head = (
        '<asset><mesh name="m" file="gone.stl"/><texture name="t" type="2d" file="gone.png"/>'
        '<material name="k" texture="t"/></asset>'
    )
    robot = load(tmp_path, mjcf(head=head, inner='<geom type="mesh" mesh="m" material="k"/>'))
    assert robot.joint_names == ("shoulder", "elbow")


def test_attached_models_are_read(tmp_path):
    """A model of its own file hangs where it is attached, with the prefix of its names."""
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><worldbody><body name="palm"><joint name="turn"/>{MJCF_INERTIAL}</body></worldbody></mujoco>'
    )
    text = mjcf(
        head='<asset><model name="hand" file="hand.xml"/></asset>',
        inner='<body name="mount" pos="0 0 .3"><attach model="hand" body="palm" prefix="h_"/></body>',
    )
    robot = load(tmp_path, text)
    assert "h_turn" in robot.joint_names
    assert {"mount", "h_palm"} <= set(robot.frames)


def test_nothing_is_written_beside_the_file(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of to a file in the current folder; here it is a warning of the model."""
    monkeypatch.chdir(tmp_path)
    robot = load(tmp_path, mjcf(head='<compiler settotalmass="9"/>'))
    assert any("settotalmass" in line for line in robot.warnings)
    assert [path.name for path in tmp_path.iterdir()] == ["robot.xml"]


def test_a_model_in_which_nothing_moves_is_read(tmp_path):
    """It has no joints; a robot of it is refused by name."""
    from closedloop import Robot

    robot = load(tmp_path, "<mujoco><worldbody><body name='a'/></worldbody></mujoco>")
    assert (robot.n, robot.tip) == (0, None)
    with pytest.raises(robot_models.ModelError, match="has no joint that moves"):
        Robot(robot)


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
    with pytest.raises(robot_models.ModelError, match="already included"):
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


def test_threads_read_files_at_once():
    """A batch does. What shows warnings is the process's: it stayed that of another thread, and hid them for good."""
    texts = [mjcf(tail=f'<size nuserdata="{k}"/>') for k in range(40)]
    before, threshold = (list(warnings.filters), mujoco.get_mju_user_warning()), gc.get_threshold()

    def pause(phase, info):
        time.sleep(0)  # lets another thread run

    gc.callbacks.append(pause)
    gc.set_threshold(20)
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda text: reader.read(text, "a file", None), texts))
    finally:
        gc.set_threshold(*threshold)
        gc.callbacks.remove(pause)
    assert found == [reader.read(text, "a file", None) for text in texts]
    assert (warnings.filters, mujoco.get_mju_user_warning()) == before
    with pytest.warns(UserWarning, match="is heard"):
        warnings.warn("is heard", stacklevel=1)
