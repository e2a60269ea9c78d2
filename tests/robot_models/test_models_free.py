"""Joints that turn freely: what is read of them, from MJCF and URDF, and what a model says of them."""

import pickle

import numpy as np
import pytest

import robot_models
from robot_models.coordinates import in_pinocchios_order
from robot_models.errors import ModelError

MJCF = """<mujoco><worldbody><body name="base" pos="1 2 3" quat="2 0 0 2"><freejoint/>
<inertial mass="2" pos="0.01 0.02 0.03" diaginertia="0.01 0.02 0.025"/>
<body name="arm" pos="0.1 0 0"><joint name="wrist" type="ball"/>
<inertial mass="1" pos="0 0 0.1" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>{more}</mujoco>"""

INERTIA = '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<robot name="r"><link name="world"/>
<link name="base"><inertial><origin xyz="0.01 0.02 0.03"/><mass value="2"/>{
    INERTIA.format(0.01, 0.02, 0.025)
}</inertial></link> <link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>{
    INERTIA.format(0.01, 0.01, 0.01)
}</inertial></link> <joint name="base" type="floating"><parent link="world"/><child link="base"/></joint>
<joint name="wrist" type="spherical"><parent link="base"/><child link="arm"/><origin xyz="0.1 0 0"/></joint></robot>"""

NAMES = ("base_x", "base_y", "base_z", "base_wx", "base_wy", "base_wz", "wrist_wx", "wrist_wy", "wrist_wz")
POSITIONS = (*NAMES[:3], *(f"base_q{k}" for k in "wxyz"), *(f"wrist_q{k}" for k in "wxyz"))


def written(tmp_path, text, suffix):
    """Return the path of a file with this text."""
    path = tmp_path / f"robot{suffix}"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_both_formats_say_the_same_mechanism(tmp_path):
    """Names, types and terms are those of the text, whichever format it has."""
    import pinocchio as pin

    models = [
        robot_models.load(written(tmp_path, MJCF.format(more=""), ".xml")),
        robot_models.load(written(tmp_path, URDF, ".urdf")),
    ]
    for model in models:
        assert model.joint_names == NAMES
        assert model.coordinate_names == POSITIONS
        assert model.joint_types == ("prismatic",) * 3 + ("ball",) * 6
        assert (model.bodies, model.balls) == ((0,), (3, 6))
        assert not model.driven.any()
        assert {"base", "arm"} <= set(model.frames)
    mechanisms = [model.pinocchio_model() for model in models]
    q = pin.randomConfiguration(mechanisms[0], -np.ones(11), np.ones(11))
    H = [pin.crba(m, m.createData(), q) for m in mechanisms]
    assert np.abs(H[0] - H[1]).max() < 1e-14


def test_home_is_where_the_body_is_written_or_the_keyframe(tmp_path):
    """A keyframe has MuJoCo's order; a quaternion of any length becomes one of length one."""
    half = np.sqrt(0.5)
    written_there = [1, 2, 3, half, 0, 0, half, 1, 0, 0, 0]
    model = robot_models.load(written(tmp_path, MJCF.format(more=""), ".xml"))
    assert np.abs(model.home - written_there).max() < 1e-15
    key = '<keyframe><key name="home" qpos="4 5 6 0 3 0 0 1 0 0 1"/></keyframe>'
    model = robot_models.load(written(tmp_path, MJCF.format(more=key), ".xml"))
    assert np.abs(model.home - [4, 5, 6, 0, 1, 0, 0, half, 0, 0, half]).max() < 1e-15
    again = robot_models.from_text(
        model.text, "mjcf", name="robot", armature=model.armature, tip=model.tip, home=model.home, locked={}
    )
    assert np.array_equal(again.home, model.home)
    assert again.joint_names == pickle.loads(pickle.dumps(model)).joint_names == NAMES


@pytest.mark.parametrize(("suffix", "text"), [(".xml", MJCF.format(more="")), (".urdf", URDF)])
@pytest.mark.parametrize(("held", "left"), [("wrist", slice(0, 6)), ("base", slice(6, 9))])
def test_what_turns_freely_is_held_as_the_file_has_it(suffix, text, held, left, tmp_path):
    """Held, it leaves a robot whose H is the rest of that of the free one there; it cannot be held elsewhere."""
    import pinocchio as pin

    path, H = written(tmp_path, text, suffix), []
    free, rest = robot_models.load(path), robot_models.load(path, lock=[held])
    assert rest.joint_names == free.joint_names[left]
    assert rest.locked == {held: 0.0}
    for model in (free, rest):
        mechanism = model.pinocchio_model()
        H.append(
            np.triu(pin.crba(mechanism, mechanism.createData(), in_pinocchios_order(model.home, model.joint_types)))
        )
    assert np.abs(H[0][left, left] - H[1]).max() < 1e-12
    again = robot_models.from_text(
        rest.text, rest.format, name="r", armature=rest.armature, tip=rest.tip, home=rest.home, locked=rest.locked
    )
    assert again.joint_names == rest.joint_names
    with pytest.raises(ModelError, match="what turns freely is held as the file has it"):
        robot_models.load(path, lock={held: 0.1})


def test_a_joint_of_its_links_name_can_be_held(tmp_path):
    """Pinocchio finds the frame of a joint by its name alone, and a link may have the same one."""
    text = "".join(
        f'<link name="{name}"><inertial><mass value="2"/>{INERTIA.format(1, 1, 1)}</inertial></link><joint '
        f'name="{name}" type="continuous"><parent link="{parent}"/><child link="{name}"/></joint>'
        for name, parent in (("one", "ground"), ("two", "one"))
    )
    path = written(tmp_path, f'<robot name="r"><link name="ground"/>{text}</robot>', ".urdf")
    assert robot_models.load(path, lock={"one": 0.1}).joint_names == ("two",)
