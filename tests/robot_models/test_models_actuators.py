"""The torque limits of an MJCF are what MuJoCo's actuators give at most."""

import mujoco
import numpy as np
import pytest
from model_texts import load, mjcf

import closedloop as cl
import robot_models

CLASSES = (
    '<default><motor ctrlrange="-3 3" gear="2"/>'
    '<default class="servo"><position kp="10" forcerange="-4 5"/></default>'
    '<default class="weak"><general forcerange="-1 1"/></default></default>'
)


def driven(actuators, head="", joint='<joint name="shoulder"/>'):
    """Return a text of one joint with actuators."""
    return mjcf(head=head, joint=joint, tail=f"<actuator>{actuators}</actuator>" if actuators else "")


LIMITED = {
    "forcerange of a position servo": (driven('<position joint="shoulder" kp="5" forcerange="-7 7"/>'), 7.0),
    "times its gear": (driven('<position joint="shoulder" kp="5" forcerange="-7 7" gear="-3"/>'), 21.0),
    "ctrlrange of a motor": (driven('<motor joint="shoulder" ctrlrange="-2 2" gear="50"/>'), 100.0),
    "the smaller of both": (driven('<motor joint="shoulder" ctrlrange="-2 2" forcerange="-1.5 1.5" gear="4"/>'), 6.0),
    "general with a gain": (driven('<general joint="shoulder" ctrlrange="-1 1" gainprm="30"/>'), 30.0),
    "the joint's own": (driven("", joint='<joint name="shoulder" actuatorfrcrange="-9 9"/>'), 9.0),
    "the joint's, below": (
        driven('<motor joint="shoulder" ctrlrange="-20 20"/>', "", '<joint name="shoulder" actuatorfrcrange="-9 9"/>'),
        9.0,
    ),
    "two that add up": (
        driven('<motor joint="shoulder" ctrlrange="-2 2"/><velocity joint="shoulder" kv="1" forcerange="-3 3"/>'),
        5.0,
    ),
    "defaults of a shortcut": (driven('<motor joint="shoulder"/>', CLASSES), 6.0),
    "defaults of a class": (driven('<position joint="shoulder" class="servo"/>', CLASSES), 8.0),
    "defaults of another tag": (driven('<motor joint="shoulder" class="weak"/>', CLASSES), 2.0),
    "a servo of the class as general": (driven('<general joint="shoulder" class="servo"/>', CLASSES), 8.0),
    "in the parent's axes": (driven('<motor jointinparent="shoulder" ctrlrange="-2 2"/>'), 2.0),
    "none: a range switched off": (driven('<motor joint="shoulder" ctrlrange="-2 2" ctrllimited="false"/>'), np.inf),
    "none: the set-point of a servo": (driven('<position joint="shoulder" ctrlrange="-2 2" kp="9"/>'), np.inf),
    "none: an integrator": (driven('<general joint="shoulder" ctrlrange="-2 2" dyntype="integrator"/>'), np.inf),
    "none: one of two": (
        driven('<motor joint="shoulder" ctrlrange="-2 2"/><velocity joint="shoulder" kv="1e9"/>'), np.inf
    ),
    "none: the joint's switched off": (
        driven("", joint='<joint name="shoulder" actuatorfrcrange="-9 9" actuatorfrclimited="false"/>'), np.inf
    ),
}  # fmt: skip


@pytest.mark.parametrize(("text", "limit"), LIMITED.values(), ids=LIMITED)
def test_torque_limits_are_those_of_the_actuators(tmp_path, text, limit):
    """MuJoCo, whose actuators are asked for far too much either way, gives the limit and no more."""
    robot = load(tmp_path, text)
    assert robot.effort_limit[0] == limit
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    given = []
    for sign in (1.0, -1.0):
        data.ctrl[:] = sign * 1e6 * np.sign(model.actuator_gear[:, 0])
        data.act[:] = sign * 1e6
        data.qpos[:] = data.qvel[:] = -sign * 1e6  # servos push, too
        mujoco.mj_forward(model, data)
        given.append(abs(float(data.qfrc_actuator[0])))
    if model.nu:
        assert min(given) == limit if np.isfinite(limit) else min(given) >= 1e6
    again = robot_models.from_text(
        robot.text, "mjcf", name="again", armature=robot.armature, tip=robot.tip, home=robot.home, locked={}
    )
    assert again.effort_limit[0] == limit


def test_a_range_of_one_direction_has_its_larger_bound(tmp_path):
    """A muscle pulls in one direction: its bound there is the limit, not 0, which is none."""
    assert load(tmp_path, driven('<motor joint="shoulder" ctrlrange="0 4"/>')).effort_limit[0] == 4.0
    assert load(tmp_path, driven('<motor joint="shoulder" ctrlrange="-4 0"/>')).effort_limit[0] == 4.0


@pytest.mark.parametrize("key", ["forcerange", "ctrlrange"])
def test_a_reversed_range_is_none_with_a_warning(tmp_path, key):
    """As to MuJoCo, with the actuator and the key."""
    robot = load(tmp_path, driven(f'<motor name="m" joint="shoulder" {key}="2 -2"/>'))
    assert robot.effort_limit[0] == np.inf
    assert any(f"actuator 'm': {key} 2 -2 is invalid" in line for line in robot.warnings)


def test_joints_without_an_actuator_have_no_drive(tmp_path):
    """Where a file has actuators, they are all its drives; a fixed tendon drives its joints by its coefficients."""
    assert load(tmp_path, mjcf()).driven.all()
    one = load(tmp_path, driven('<motor joint="shoulder"/>'))
    assert one.driven.tolist() == [True, False]
    tendon = (
        '<tendon><fixed name="t"><joint joint="shoulder" coef="2"/><joint joint="elbow" coef="-0.5"/></fixed></tendon>'
    )
    both = load(tmp_path, mjcf(tail=f'{tendon}<actuator><motor tendon="t" ctrlrange="-3 3" gear="4"/></actuator>'))
    assert both.driven.all()
    np.testing.assert_allclose(both.effort_limit, [24.0, 6.0])
    assert both.undriven @ [2.0, -0.5] == pytest.approx([0.0], abs=1e-15)
    assert both.undriven @ both.undriven.T == pytest.approx(np.eye(1))
    motors = '<actuator><motor tendon="t" gear="4"/><motor joint="elbow"/></actuator>'
    assert len(load(tmp_path, mjcf(tail=tendon + motors)).undriven) == 0  # the two together give any torque


def test_an_actuator_that_pulls_no_joint_is_left_out_with_a_warning(tmp_path):
    """A thruster at a site is named; the joint's drive is there."""
    robot = load(tmp_path, driven('<motor name="jet" site="touch" gear="0 0 1 0 0 0"/><motor joint="shoulder"/>'))
    assert any("actuator 'jet' acts on a site and is left out" in line for line in robot.warnings)
    assert robot.driven.tolist() == [True, False]


def test_a_file_whose_actuators_pull_no_joint_drives_none(tmp_path):
    """As of a copter: said, kept by a run's file, no law has a torque; nor where all joints with a drive are held."""
    thrust = '<motor name="jet" site="touch" gear="0 0 1 0 0 0"/>'
    robot = load(tmp_path, driven(thrust))
    assert not robot.driven.any()
    assert len(robot.undriven) == robot.n
    assert any("no joint has a drive" in line for line in robot.warnings)
    (tmp_path / "copter.xml").write_text(driven(thrust))
    (tmp_path / "run.toml").write_text(
        '[robot]\nmodel = "copter.xml"\ntip = "touch"\n[law]\nkind = "impedance"\n[time]\nduration = 0.01\n'
    )
    run = cl.simulate(cl.load_scenario(tmp_path / "run.toml"))
    assert run.v.any()
    assert not run.torque.any()
    run.save(tmp_path / "run.nc")
    assert not cl.load_run(tmp_path / "run.nc").model.driven.any()
    (tmp_path / "one.xml").write_text(driven('<motor joint="shoulder"/>'))
    assert robot_models.load(tmp_path / "one.xml", lock=["shoulder"]).driven.tolist() == [False]


def test_drives_of_several_joints_give_what_their_forces_give(tmp_path):
    """Of any torque the part along their rows acts, in MuJoCo's model too, and the rest of it does not."""
    tendons = "".join(
        f'<fixed name="{name}">' + "".join(f'<joint joint="{j}" coef="{c}"/>' for j, c in parts.items()) + "</fixed>"
        for name, parts in {"t": {"a": 1.0, "b": -0.5, "c": 0.7}, "u": {"b": 1.0, "c": 2.0}}.items()
    )
    body = '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>'
    links = "".join(f'<body pos=".3 0 0"><joint name="{j}" axis="0 1 0"/>{body}' for j in "abcd") + 4 * "</body>"
    actuators = '<motor name="t" tendon="t" gear="3"/><motor name="u" tendon="u"/><motor name="d" joint="d"/>'
    text = f"<mujoco><worldbody>{links}</worldbody><tendon>{tendons}</tendon><actuator>{actuators}</actuator></mujoco>"
    robot = load(tmp_path, text)
    again = robot_models.from_text(
        robot.text, "mjcf", name="again", armature=robot.armature, tip=robot.tip, home=robot.home, locked={}
    )
    np.testing.assert_array_equal(again.undriven, robot.undriven)
    assert again.drives is robot.drives is None
    rows, asked = (
        np.array([[1.0, -0.5, 0.7, 0.0], [0.0, 1.0, 2.0, 0.0], [0, 0, 0, 1.0]]),
        np.array([3.0, 1.0, -2.0, 1.0]),
    )
    given = rows.T @ np.linalg.solve(rows @ rows.T, rows @ asked)
    scenario = cl.load_scenario({"robot": {"model": str(tmp_path / "robot.xml")}, "time": {"duration": 0.01}})
    run = cl.simulate(scenario, law=lambda x: asked, progress=False)
    np.testing.assert_allclose(run.torque, np.tile(given, (len(run), 1)), atol=1e-14)
    stepped = cl.Simulator(scenario)
    stepped.step(asked)
    np.testing.assert_array_equal(stepped.run().torque[0], run.torque[0])
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[:] = np.linalg.solve(rows @ rows.T, rows @ asked) / [3.0, 1.0, 1.0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(run.acceleration[0], data.qacc, rtol=1e-10)
    with pytest.raises(cl.ScenarioError, match="one drive pulls a, b, c"):
        cl.simulate(
            scenario.replace({"transmission.stiffness": 100.0, "transmission.motor_inertia": 0.1}), progress=False
        )
