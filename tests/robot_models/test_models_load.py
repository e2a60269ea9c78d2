"""What the loader hands out: the same dynamics as the file, whole, read-only and repeatable."""

import pickle
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_texts import INERTIAL, LIMIT, arm, joint, link, mjcf, urdf

import closedloop as cl
import robot_models
from robot_models import described
from robot_models.collision import collision_shapes, digest_of

ARRAYS = ("armature", "position_lower", "position_upper", "velocity_limit", "effort_limit", "home", "gravity")


def dynamics(model, q, v):
    """Return the mass matrix and the bias."""
    upper = np.triu(pin.crba(model, model.createData(), q))
    return upper + np.triu(upper, 1).T, pin.nonLinearEffects(model, model.createData(), q, v).copy()


def again(robot):
    """Return the robot rebuilt from what a run file would hold."""
    return robot_models.from_text(
        robot.text,
        robot.format,
        name=robot.name,
        armature=robot.armature.tolist(),
        tip=robot.tip,
        home=robot.home.tolist(),
        locked=dict(robot.locked),
        gravity=robot.gravity.tolist(),
        description=robot.description,
        source=robot.source,
    )


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file and returns its path."""

    def write(text, name="robot.urdf"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_digest_is_of_all_that_a_run_reads(tmp_path):
    """Another mass, drive, loop, home or collision mesh is another robot; another description or folder is not."""
    shipped_folder = Path(robot_models.__file__).parent / "four_bar"
    text, sidecar = ((shipped_folder / f"four_bar.{kind}").read_text() for kind in ("urdf", "toml"))
    mesh = '<collision><geometry><mesh filename="a.stl"/></geometry></collision></link>'
    text, sidecar = text.replace("</link>", mesh, 1), re.sub("source = .*", "", sidecar)

    def digest(text=text, sidecar=sidecar, stl=b"solid", where="here"):
        folder = tmp_path / where
        folder.mkdir(exist_ok=True)
        (folder / "a.urdf").write_text(text)
        (folder / "a.toml").write_text(sidecar)
        (folder / "a.stl").write_bytes(stl)
        return digest_of(robot_models.load(str(folder / "a.urdf")))

    base = digest()
    assert digest(where="there") == base
    assert digest(sidecar=re.sub("description = .*", 'description = "mine"', sidecar)) == base
    others = [digest(text=re.sub('mass value="[^"]*"', 'mass value="1.25"', text)), digest(stl=b"another")]
    for old, new in (('drives = ["J1"]', 'drives = ["J2"]'), ("J1 = 1.77042", "J1 = 1.77043"), ('"hinge"', '"point"')):
        assert old in sidecar
        others.append(
            digest(sidecar=sidecar.replace(old, new).replace("axis", "# axis" if new == '"point"' else "axis"))
        )
    assert base not in others
    assert len(set(others)) == 5


@pytest.mark.parametrize("name", [*robot_models.shipped_names(), "panda", "ur5", "kinova", "talos_arm"])
@pytest.mark.parametrize("drive_inertia", [True, False])
def test_round_trip_is_bit_identical(name, drive_inertia):
    """Text, lock and armature give the very same dynamics, by from_text and by pickle."""
    robot = robot_models.load(name, drive_inertia=drive_inertia)
    rng = np.random.default_rng(1)
    for copy in (again(robot), pickle.loads(pickle.dumps(robot))):
        for field in ARRAYS:
            np.testing.assert_array_equal(getattr(copy, field), getattr(robot, field))
            assert not getattr(copy, field).flags.writeable
        for field in ("name", "format", "text", "joint_names", "joint_types", "tip", "frames", "locked"):
            assert getattr(copy, field) == getattr(robot, field)
        for _ in range(5):
            q, v = rng.uniform(-2, 2, (2, robot.n))
            for one, other in zip(
                dynamics(robot.pinocchio_model(), q, v),
                dynamics(copy.pinocchio_model(), q, v),
                strict=True,
            ):
                np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", robot_models.shipped_names())
def test_shipped_robots_are_complete(name):
    """A shipped robot has a tip, a home inside its limits, a description, a source and shapes to look at."""
    robot = robot_models.load(name)
    assert robot.name == name
    assert robot.tip in robot.frames
    assert robot.description
    assert robot.source
    assert np.all((robot.position_lower <= robot.home) & (robot.home <= robot.position_upper))
    assert "<visual>" in robot.text
    model = robot.pinocchio_model()
    assert model.nq == model.nv == robot.n == len(robot.joint_names) == len(robot.joint_types)
    assert tuple(model.names)[1:] == robot.joint_names
    np.testing.assert_array_equal(model.armature, robot.armature)
    np.testing.assert_array_equal(model.gravity.linear, robot.gravity)


def test_models_are_the_callers_own():
    """A model that is changed leaves the robot, and the next model, as they were."""
    robot = robot_models.load("planar2")
    robot.pinocchio_model().gravity.linear = np.zeros(3)
    np.testing.assert_array_equal(robot.pinocchio_model().gravity.linear, [0, 0, -9.81])
    with pytest.raises(ValueError, match="read-only"):
        robot.armature[0] = 1.0


@pytest.mark.parametrize("name", robot_models.shipped_names())
def test_what_was_inspected_still_passes(name):
    """The list of inspected texts holds the shipped ones, and they do pass."""
    from robot_models import urdf as reader

    text = described.path_of(name).read_text()
    assert described.PASSED[name] == described.digest(text)
    reader.inspect(reader.read(text, name), name, ())


def test_one_byte_more_is_inspected_again():
    """The memory is of bytes, and of the joints that were locked."""
    text = described.path_of("wam4").read_text()
    assert described.has_passed(text, ())
    assert described.has_passed(text, ["J1"])
    assert not described.has_passed(text + " ", ())
    panda = robot_models.load("panda")
    assert described.has_passed(panda.text, panda.locked)
    assert not described.has_passed(panda.text, ["panda_finger_joint2"])


def run(code):
    """Run code in a fresh interpreter and return what it prints."""
    root = Path(robot_models.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=True)
    return done.stdout.strip()


def test_imports_are_lazy():
    """The package itself imports no engine, and a shipped robot needs no inspection and no robot table."""
    heavy = ("pinocchio", "yourdfpy", "trimesh", "example_robot_data")
    asked = f"print([m for m in {heavy} if m in sys.modules])"
    told = run(f"import sys, robot_models; {asked}; robot_models.load('wam4'); {asked}")
    assert told.splitlines() == ["[]", "['pinocchio']"]


@given(q=st.lists(st.floats(-3, 3), min_size=2, max_size=2), v=st.lists(st.floats(-5, 5), min_size=2, max_size=2))
def test_continuous_joints_are_one_variable(q, v):
    """The same H and bias as Pinocchio's own joint on the circle, and no bounds."""
    q, v = np.array(q), np.array(v)
    robot, own = _continuous()
    model = robot.pinocchio_model()
    circle = np.column_stack([np.cos(q), np.sin(q)]).ravel()
    for mine, theirs in zip(dynamics(model, q, v), dynamics(own, circle, v), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-13)


@cache
def _continuous():
    text = arm(
        shoulder=joint("shoulder", "base", "upper", kind="continuous", axis="0.6 0 0.8", limit=""),
        elbow=joint("elbow", "upper", "fore", kind="continuous"),
    )
    robot = robot_models.from_text(text, "urdf", name="c", armature=[0, 0], tip="tip", home=[0, 0], locked={})
    return robot, pin.buildModelFromXML(text)


def test_continuous_joints_have_no_bounds():
    """No <limit> is no limit at all; bounds in a continuous joint's <limit> are ignored, effort is kept."""
    robot, own = _continuous()
    assert own.nq == 4
    assert robot.joint_types == ("continuous", "continuous")
    np.testing.assert_array_equal(robot.position_upper, [np.inf, np.inf])
    np.testing.assert_array_equal(robot.position_lower, [-np.inf, -np.inf])
    np.testing.assert_array_equal(robot.velocity_limit, [np.inf, 2.0])
    np.testing.assert_array_equal(robot.effort_limit, [np.inf, 5.0])


def test_a_limit_of_zero_is_no_limit(write):
    """A URDF must give effort and velocity, so 0 is how "not known" is written; what is known stays."""
    unknown = LIMIT.replace('effort="5" velocity="2"', 'effort="0" velocity="0.0"')
    robot = robot_models.load(write(arm(elbow=joint("elbow", "upper", "fore", limit=unknown))))
    np.testing.assert_array_equal(robot.effort_limit, [5.0, np.inf])
    np.testing.assert_array_equal(robot.velocity_limit, [2.0, np.inf])
    np.testing.assert_array_equal(robot.position_upper, [1.0, 1.0])


@pytest.mark.parametrize("value", [0.0, 0.7, -2.0])
def test_locked_joints_are_welded(write, value):
    """Locking is Pinocchio's reduced model: for a whole arm, and at any value."""
    robot = robot_models.load(write(arm()), lock={"elbow": value})
    assert robot.joint_names == ("shoulder",)
    assert dict(robot.locked) == {"elbow": value}
    whole = pin.buildModelFromXML(robot.text)
    reduced = pin.buildReducedModel(whole, [whole.getJointId("elbow")], np.array([0.0, value]))
    for q in (-1.0, 0.3):
        q, v = np.array([q]), np.array([2.0])
        for one, other in zip(dynamics(robot.pinocchio_model(), q, v), dynamics(reduced, q, v), strict=True):
            np.testing.assert_array_equal(one, other)


def test_locked_by_name_is_locked_at_home(write):
    """Names alone lock at the home posture; the sidecar's own lock is replaced by one that is given."""
    path = write(arm())
    write("[home]\nelbow = 0.4\n[lock]\nshoulder = 0.1\n", "robot.toml")
    assert dict(robot_models.load(path).locked) == {"shoulder": 0.1}
    assert dict(robot_models.load(path, lock=["elbow"]).locked) == {"elbow": 0.4}


MIMIC = '<mimic joint="shoulder" multiplier="-0.5" offset="0.2"/>'


def test_mimicking_joint_is_bound_by_a_gear(write):
    """It has no drive, and starts where the gear has it; a lock takes the gear's place, or holds its other side."""
    path = write(arm(elbow=joint("elbow", "upper", "fore", extra=MIMIC)))
    write("[home]\nshoulder = 0.4\n", "robot.toml")
    robot = robot_models.load(path)
    (gear,) = robot.loops
    assert (gear.type, gear.joints, gear.polynomial) == ("gear", ("elbow", "shoulder"), (0.2, -0.5, 0.0, 0.0, 0.0))
    assert (robot.joint_names, robot.drives) == (("shoulder", "elbow"), ("shoulder",))
    np.testing.assert_array_equal(robot.home, [0.4, 0.0])
    assert robot_models.load(path, lock=["elbow"]).loops == ()
    (held,) = robot_models.load(path, lock={"shoulder": 0.4}).loops
    assert (held.joints, held.polynomial[0]) == (("elbow",), 0.0)
    again = robot_models.from_text(
        robot.text, "urdf", name="again", armature=[0, 0], tip="tip", home=robot.home, locked={},
        loops=[gear.as_table()], drives=robot.drives,
    )  # fmt: skip
    assert (again.loops, again.drives) == (robot.loops, robot.drives)


@pytest.mark.parametrize("missing", ["lower", "upper", "effort", "velocity", "limit"])
def test_a_missing_limit_is_none(write, missing):
    """urdfdom reads a missing bound as zero, which no maker means."""
    limit = "" if missing == "limit" else re.sub(f'{missing}="[^"]*"', "", LIMIT)
    robot = robot_models.load(write(arm(elbow=joint("elbow", "upper", "fore", limit=limit))))
    found = {
        "lower": -robot.position_lower[1], "upper": robot.position_upper[1], "effort": robot.effort_limit[1],
        "velocity": robot.velocity_limit[1],
    }  # fmt: skip
    for key, value in found.items():
        assert (value == np.inf) == (missing in (key, "limit"))


def test_odd_inertias_are_named_and_move(write):
    """A link that breaks the triangle inequality, one without mass between joints, and a joint that moves no mass."""
    odd = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="3" ixy="0" ixz="0" iyz="0"/></inertial>'
    robot = robot_models.load(write(arm(fore=link("fore", odd))))
    assert any("'fore': its inertia tensor breaks the triangle inequality" in line for line in robot.warnings)
    empty = '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
    between = robot_models.load(write(arm(upper=link("upper", empty))))
    assert between.n == 2
    assert any("'upper' moves and has a mass of 0 kg" in line for line in between.warnings)
    idle = robot_models.load(write(arm(fore=link("fore", ""))))
    assert (idle.joint_names, dict(idle.locked)) == (("shoulder",), {"elbow": 0.0})
    assert any("'elbow' moves no mass: it is held at 0" in line for line in idle.warnings)


def test_a_xacro_template_is_expanded(tmp_path):
    """By xacrodoc: properties, macros and arguments; what it cannot expand is refused in one line."""
    pytest.importorskip("xacrodoc")
    text = arm().replace(
        '<robot name="sample">',
        """<robot name="sample" xmlns:xacro="http://ros.org/wiki/xacro">
    <xacro:property name="long" value="${0.25 * 2}"/>
    <xacro:macro name="hand" params="name"><link name="${name}"/></xacro:macro>""",
    )
    text = text.replace('<link name="tip"></link>', '<xacro:hand name="tip"/>').replace("0 0 0.5", "0 0 ${long}")
    (tmp_path / "robot.urdf.xacro").write_text(text)
    (tmp_path / "plain.urdf").write_text(arm())
    found, plain = (robot_models.load(tmp_path / name) for name in ("robot.urdf.xacro", "plain.urdf"))
    assert "xacro:" in text
    assert (found.joint_names, found.frames, found.tip) == (plain.joint_names, plain.frames, "tip")
    q = np.array([0.3, 0.4])
    terms = [pin.crba(each.pinocchio_model(), each.pinocchio_model().createData(), q) for each in (found, plain)]
    np.testing.assert_array_equal(*terms)
    (tmp_path / "wrong.xacro").write_text(text.replace("0.25 * 2", "nothing"))
    with pytest.raises(robot_models.ModelError, match=r"wrong\.xacro: xacrodoc cannot expand it: .*nothing") as told:
        robot_models.load(tmp_path / "wrong.xacro")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", ["package://my_arm/meshes/a.stl", "../meshes/a.stl", "file://../meshes/a.stl"])
def test_meshes_are_found_in_the_package_and_beside(tmp_path, name):
    """A package is a folder of its name above the URDF; no file from elsewhere is opened."""
    import trimesh

    (tmp_path / "my_arm" / "meshes").mkdir(parents=True)
    (tmp_path / "my_arm" / "urdf").mkdir()
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "my_arm" / "meshes" / "a.stl")
    shape = f'<collision><geometry><mesh filename="{name}"/></geometry></collision>'
    path = tmp_path / "my_arm" / "urdf" / "robot.urdf"
    path.write_text(arm(tip=link("tip", shape)))
    (mesh,) = collision_shapes(robot_models.load(path), "tip")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1.0, 2.0, 3.0])
    path.write_text(arm(tip=link("tip", shape.replace("my_arm", "other").replace("../", "../../"))))
    with pytest.raises(robot_models.ModelError, match="is not there"):
        collision_shapes(robot_models.load(path), "tip")


TIPS = {
    "the last link": ("", "tip"),
    "a tool": (joint("t", "fore", "my_tcp", kind="fixed", limit="") + link("my_tcp", ""), "my_tcp"),
    "a gripper's frame": (joint("t", "tip", "gripper_frame", kind="fixed", limit="") + link("gripper_frame", "")
                          + joint("u", "tip", "z_mount", kind="fixed", limit="") + link("z_mount", ""),
                          "gripper_frame"),
    "not a range sensor": (joint("t", "tip", "hand_range_link", kind="fixed", limit="")
                           + link("hand_range_link", ""), "tip"),
    "not a sensor": (joint("t", "tip", "imu_link", kind="fixed", limit="") + link("imu_link", ""), "tip"),
    "not a finger": (
        joint("finger_1", "tip", "f1", origin="0 0 1") + link("f1") + joint("finger_2", "f1", "f2") + link("f2"), "tip"
    ),
    "not a shorter chain": (joint("z", "base", "z_arm") + link("z_arm"), "tip"),
}  # fmt: skip


@pytest.mark.parametrize("case", TIPS)
def test_the_default_tip(write, case):
    """The frame of a tool, or the end of the longest chain without its fingers and sensors."""
    more, tip = TIPS[case]
    assert robot_models.load(write(arm(plus=more))).tip == tip


def test_the_default_tip_of_a_gripper_ends_its_longest_finger(tmp_path):
    """A body that fingers alone move has its tip at the end of the longest, whichever is written last."""
    bar = '<inertial mass="1" pos="0 0 .1" diaginertia=".01 .01 .01"/>'
    outer = (
        f'<body name="outer"><joint name="finger_1"/>{bar}<body name="end"><joint name="finger_2"/>{bar}</body></body>'
    )
    inner = f'<body name="inner"><joint name="finger_3"/>{bar}</body>'
    path = tmp_path / "gripper.xml"
    path.write_text(f"<mujoco><worldbody>{outer}{inner}</worldbody></mujoco>")
    assert robot_models.load(path).tip == "end"


def test_sidecar_speaks_for_a_users_robot(write):
    """Drive inertia, tip, home and words come from my.toml beside my.urdf; the switch still switches."""
    path = write(arm())
    write(
        'description = "d"\nsource = "s"\ntip = "fore"\n[home]\nelbow = 9.0\n[drive_inertia]\nelbow = 0.25\n',
        "robot.toml",
    )
    robot = robot_models.load(path)
    assert (robot.name, robot.description, robot.source, robot.tip) == ("robot", "d", "s", "fore")
    np.testing.assert_array_equal(robot.armature, [0.0, 0.25])
    np.testing.assert_array_equal(robot.home, [0.0, 1.0])  # moved into the limits
    assert not robot_models.load(str(path), drive_inertia=False).armature.any()


def test_axes_are_made_unit(write):
    """A non-unit axis means its direction: in Pinocchio, and in the text that other readers get."""
    long = robot_models.load(write(arm(elbow=joint("elbow", "upper", "fore", axis="0 0 2.5", kind="prismatic"))))
    unit = robot_models.load(write(arm(elbow=joint("elbow", "upper", "fore", kind="prismatic", axis="0 0 1"))))
    assert "2.5" not in long.text
    q, v = np.array([0.3, 0.4]), np.array([1.0, 2.0])
    for one, other in zip(dynamics(long.pinocchio_model(), q, v), dynamics(unit.pinocchio_model(), q, v), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-14)
    assert unit.text == arm(elbow=joint("elbow", "upper", "fore", kind="prismatic", axis="0 0 1"))


def rough_path(write, dynamic):
    """Return the path of the sample arm with friction in its elbow."""
    return write(arm(elbow=joint("elbow", "upper", "fore", axis="0 0 1", extra=dynamic)))


def test_damping_and_friction_of_a_urdf_do_not_act(write):
    """Friction belongs to the scenario: the same motion with and without <dynamics>."""
    dynamic = '<dynamics damping="3" friction="2"/>'
    plain = robot_models.load(write(arm())).pinocchio_model()
    rough = robot_models.load(write(arm(elbow=joint("elbow", "upper", "fore", axis="0 0 1", extra=dynamic))))
    assert "friction (<dynamics>; elbow) does not act" in rough.notes[0]
    assert again(rough).notes == rough.notes
    assert pickle.loads(pickle.dumps(rough)).notes == rough.notes
    assert robot_models.load(rough_path(write, dynamic), lock=["elbow"]).notes[0].startswith("effort")
    rough = rough.pinocchio_model()
    assert rough.damping[1] == 3
    q, v = np.array([0.3, 0.4]), np.array([1.0, 2.0])
    for one, other in zip(dynamics(plain, q, v), dynamics(rough, q, v), strict=True):
        np.testing.assert_array_equal(one, other)
    assert robot_models.load(write(arm())).notes == (
        "effort and velocity limits of the robot's file do not act on the motion; "
        "the verdict names joints that exceed them",
    )
    accelerations = [pin.aba(m, m.createData(), q, v, np.zeros(2)) for m in (plain, rough)]
    np.testing.assert_array_equal(*accelerations)


def test_massless_frames_and_intermediate_links_are_fine(write):
    """A welded frame and a link between two joints may be massless, as in a spherical joint."""
    text = urdf(
        link("base", ""),
        link("between", ""),
        link("end", INERTIAL),
        link(
            "flag",
            '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>',
        ),
        joint("a", "base", "between"),
        joint("b", "between", "end", axis="1 0 0"),
        joint("c", "end", "flag", kind="fixed", limit=""),
    )
    robot = robot_models.load(write(text))
    assert robot.n == 2
    assert robot.tip == "flag"


def test_a_link_may_have_the_name_of_a_joint(write):
    """Pinocchio has both in one list: the joint's frame is called otherwise, and the link can be asked for."""
    same = cl.Robot(robot_models.load(write(arm(elbow=joint("fore", "upper", "fore", axis="0 0 1")))), "fore")
    other = cl.Robot(robot_models.load(write(arm())), "fore")
    assert same.model.frames == other.model.frames == ("base", "upper", "fore", "tip")
    for one, two in zip(same.terms([0.3, 0.2], [1, 2]), other.terms([0.3, 0.2], [1, 2]), strict=True):
        np.testing.assert_array_equal(one, two)
    assert same.link_below("fore")[0] == other.link_below("elbow")[0] == "upper"


def test_home_is_inside_the_limits(write):
    """Zero where it is allowed, else the middle."""
    away = LIMIT.replace('lower="-1"', 'lower="0.5"')
    robot = robot_models.load(write(arm(elbow=joint("elbow", "upper", "fore", limit=away))))
    np.testing.assert_array_equal(robot.home, [0.0, 0.75])


def test_a_declaration_that_is_damaged_makes_no_noise(write, caplog):
    """XML of version ".0" is read, by every reader: one printed that it tries another way."""
    text = arm()[arm().index("<robot") :]
    assert robot_models.load(write(f'<?xml version=".0"?>\n{text}')).n == robot_models.load(write(text)).n
    assert not caplog.records  # which a program without handlers prints


def test_the_root_decides_the_format(write):
    """A URDF in an .xml file is a URDF."""
    assert robot_models.load(write(arm(), "robot.xml")).format == "urdf"
    assert robot_models.load(write(mjcf(), "robot.urdf")).format == "mjcf"


def test_exports():
    """The package exports what it promises, and its errors share the project's root."""
    for name in robot_models.__all__:
        assert hasattr(robot_models, name)
    assert issubclass(robot_models.ModelError, robot_models.ClosedLoopError)
    assert issubclass(robot_models.ModelError, ValueError)
