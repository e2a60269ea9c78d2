"""Forces from outside, [[external_force]], against closed forms and Pinocchio; what the force sensor feels of them."""

import numpy as np
import pinocchio as pin
import pytest

import closedloop as cl

# A free box of 2 kg, with principal moments from its edges, far from everything and without weight.
BOX = {
    "robot": {"model": "none", "gravity": [0, 0, 0]}, "stabiliser": {"kind": "none"},
    "body": [{"name": "box", "shape": "box", "edges": [0.3, 0.2, 0.1], "mass": 2.0}],
    "time": {"duration": 0.5, "step": 0.01, "integrator": "rk4"},
}  # fmt: skip
# It begins and ends between rows.
PUSH = {"link": "box", "force": [3.0, -1.0, 2.0], "start": 0.1234, "duration": 0.2111}
SLIDE = {"time.duration": 0.6, "reference.start": 0.0, "reference.speed": 0.05, "reference.stop": 0.5}


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4", "dop853"])
def test_the_impulse_of_a_force_is_exact(engine, integrator):
    """A free body gets F Δt/m, wherever between rows the force begins and ends; its work is the energy that it has."""
    if integrator == "dop853" and engine == "compiled":
        pytest.skip("dop853 has one engine")
    scenario = cl.load_scenario(BOX | {"external_force": [PUSH]}).replace({"time.integrator": integrator})
    run = cl.simulate(scenario, engine=engine)
    speed = np.array(PUSH["force"]) * PUSH["duration"] / 2.0
    np.testing.assert_allclose(run.v[-1, :3], speed, rtol=1e-9)
    assert not np.any(run.v[:13])  # until row 0.12
    if integrator != "semi_implicit_euler":
        assert run.summary()["max_energy_residual"] < 1e-9


def test_a_moment_turns_a_body():
    """About a principal axis ω = M t/I; of a force off the centre the moment is r × F."""
    box = np.array([0.3, 0.2, 0.1])
    inertia = 2.0 / 12.0 * (np.sum(box**2) - box**2)
    for axis in range(3):
        forces = [{"link": "box", "moment": (0.01 * np.eye(3)[axis]).tolist(), "axes": "box"}]
        run = cl.simulate(cl.load_scenario(BOX | {"external_force": forces}))
        np.testing.assert_allclose(run.v[-1, 3:], 0.5 * 0.01 / inertia[axis] * np.eye(3)[axis], atol=1e-12)
    off = {"link": "box", "at": [0.1, 0.0, 0.0], "force": [0.0, 0.3, 0.0], "axes": "box"}
    run = cl.simulate(cl.load_scenario(BOX | {"external_force": [off]}))
    np.testing.assert_allclose(run.v[-1, 5], 0.5 * 0.03 / inertia[2], rtol=1e-12)


def test_joints_carry_a_force_in_the_axes_of_a_frame_that_is_turned_on_its_link():
    """Along its axis each joint has what its drive gives, whatever frame the force and its moment are in."""
    force = {"force": [10.0, -20.0, 30.0], "moment": [1.0, 2.0, -3.0], "axes": "panda_hand"}
    run = cl.simulate(cl.load_scenario("panda_slide", {"time.duration": 0.02, "external_force": [force]}))
    model = run.model.pinocchio_model()
    turned = model.frames[model.getFrameId("panda_hand")].placement.rotation
    assert np.max(np.abs(turned - turned.T)) > 0.5
    for j, name in enumerate(run.model.joint_names):
        drive = run.torque[:, j] - run.model.armature[j] * run.acceleration[:, j]
        np.testing.assert_allclose(run.joint_wrench(name)[:, 5], drive, atol=1e-9)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_the_torque_is_that_of_jacobians(engine):
    """H q̈ + C − Jᵣᵀ F − Q is Jᵀ w of Pinocchio's frames: of the tool's tip, of a link in another's axes."""
    forces = [
        {"at": [0.01, 0.0, 0.02], "force": [1.0, -2.0, 3.0], "moment": [0.1, 0.2, -0.3]},
        {"link": "link2", "at": [0.0, 0.1, 0.2], "force": [4.0, 0.0, -1.0], "moment": [0.0, 0.5, 0.0], "axes": "link3"},
    ]
    scenario = cl.load_scenario("wam_slide", SLIDE | {"tool.offset": [0.0, 0.02, 0.1], "external_force": forces})
    run = cl.simulate(scenario, engine=engine)
    robot = cl.prepare(run.scenario).robot
    missing = robot.needed_torque(run.q, run.v, run.acceleration, run.tip_force) - run.torque
    model = run.model.pinocchio_model()
    data = model.createData()
    for k in range(0, len(run), 100):
        pin.computeJointJacobians(model, data, run.q[k])
        pin.updateFramePlacements(model, data)
        torque = np.zeros(4)
        for force, frame, more in zip(forces, (run.model.tip, "link2"), ([0.0, 0.02, 0.1], np.zeros(3)), strict=True):
            number = model.getFrameId(frame)
            axes = np.eye(3) if "axes" not in force else data.oMf[model.getFrameId(force["axes"])].rotation
            F, M = axes @ force["force"], axes @ force["moment"]
            jacobian = pin.getFrameJacobian(model, data, number, pin.LOCAL_WORLD_ALIGNED)
            arm = data.oMf[number].rotation @ (np.array(force["at"]) + more)
            torque += jacobian[:3].T @ F + jacobian[3:].T @ (M + np.cross(arm, F))
        np.testing.assert_allclose(missing[k], torque, atol=1e-9)


@pytest.mark.parametrize("name", ["wam_slide", "delta"])
def test_the_work_of_a_force_is_booked(name):
    """The energy that it gives is energy supplied: the balance closes with the order of the scheme, a force in it."""
    push = [{"force": [2.0, 0.5, 1.0], "start": 0.1, "duration": 0.15}]
    options = {"time.duration": 0.3, "time.integrator": "rk4", "stabiliser.time_constant": 0.01}
    off = []
    for step in (1e-3, 5e-4):
        summary = cl.simulate(cl.load_scenario(name, options | {"external_force": push, "time.step": step})).summary()
        off.append(summary["max_energy_residual"] / summary["energy_exchanged"])
        assert summary["max_kkt_residual"] < 1e-12
    assert off[0] < 1e-8
    assert off[1] < off[0] / 12.0


def test_the_surface_bears_what_lifts_less():
    """Along the normal of a rigid plane a push changes f by its own size, and nothing else; the sensor feels both."""
    lift = [{"force": [0.0, 0.0, 3.0], "start": 0.2, "duration": 0.1}]
    options = SLIDE | {"time.duration": 0.4}
    plain, lifted = (
        cl.simulate(cl.load_scenario("wam_slide", options | more)) for more in ({}, {"external_force": lift})
    )
    there = (plain.time > 0.1999) & (plain.time < 0.2999)
    np.testing.assert_allclose(plain.contact_force - lifted.contact_force, np.where(there, 3.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(lifted.measured_force, plain.contact_force, atol=1e-9)
    np.testing.assert_allclose(lifted.wrist_wrench, plain.wrist_wrench, atol=1e-9)
    elsewhere = cl.simulate(cl.load_scenario("wam_slide", options | {"external_force": [lift[0] | {"link": "link3"}]}))
    np.testing.assert_allclose(elsewhere.measured_force, elsewhere.contact_force, atol=1e-12)


def test_a_mass_behind_the_sensor_is_felt():
    """The reading is (F − m r̈) along the normal and the tangents, also along a normal that the law is wrong about."""
    options = SLIDE | {"sensor.mass": 0.7, "sensor.axes": 3, "reference.speed": 0.1, "time.duration": 0.2}
    run = cl.simulate(cl.load_scenario("wam_touchdown", options | {"reference": {"kind": "hold"}, "surface.gap": 0.01}))
    robot = cl.prepare(run.scenario).robot
    rate = np.array([
        robot.terms(q, v).jacobian @ a + robot.terms(q, v).drift
        for q, v, a in zip(run.q, run.v, run.acceleration, strict=True)
    ])  # fmt: skip
    assert np.max(np.abs(rate)) > 0.5
    normal = np.sum(run.surface_normal * (run.tip_force - 0.7 * rate), axis=1)
    np.testing.assert_allclose(run.measured_force[1:], normal[1:], atol=1e-9)


def test_joints_carry_what_pushes_beyond_them():
    """The reaction at a joint has the push on what hangs on it: along the axis it is the drive's torque alone."""
    push = [
        {"link": "link3", "at": [0.0, 0.1, 0.1], "force": [3.0, 2.0, 1.0], "moment": [0.1, 0.0, 0.2]},
        {"force": [1, 2, 0]},
    ]
    run = cl.simulate(cl.load_scenario("wam_slide", SLIDE | {"time.duration": 0.05, "external_force": push}))
    model = run.model.pinocchio_model()
    for j, name in enumerate(run.model.joint_names):
        axis = np.eye(3)["XYZ".index(model.joints[j + 1].shortname()[-1])]
        drives = run.torque[:, j] - run.model.armature[j] * run.acceleration[:, j]
        np.testing.assert_allclose(run.joint_wrench(name)[:, 3:] @ axis, drives, atol=1e-9)


def test_a_batch_has_the_same_pushes():
    """Each run of a batch, in lanes or not, is that of `simulate`."""
    pushes = [[{"force": [f, 0.0, 1.0], "start": 0.1, "duration": 0.1}] for f in (0.0, 2.0, 4.0)]
    scenario = cl.load_scenario("wam_slide", SLIDE)
    table = cl.simulate_batch(scenario, {"external_force": pushes})
    for push, error in zip(pushes, table["rms_path_error"].to_pylist(), strict=True):
        run = cl.simulate(scenario.replace({"external_force": push}), engine="compiled")
        assert error == pytest.approx(run.summary()["rms_path_error"], rel=1e-12)
    assert len(set(table["rms_path_error"].to_pylist())) == 3


# A law that reads its sensor, on an arm with gears, which is pushed.
PUSHED = SLIDE | {
    "time.duration": 0.3, "law.force_feedback": 0.3, "law.pd_start": 0.0, "sensor.mass": 0.5,
    "belief.normal_noise": 1e-3, "sensor.filter_time_constant": 0.01,
    "external_force": [{"force": [1.0, 2.0, 3.0], "start": 0.1, "duration": 0.1004}],
}  # fmt: skip
GEARS = {
    "transmission.stiffness": 5e3, "transmission.damping": 10.0, "transmission.backlash": [0.0, 1e-3, 0.0, 1e-3],
    "transmission.load_friction": 0.05, "joint_friction.kind": "coulomb_viscous", "joint_friction.kinetic": 0.1,
    "joint_friction.viscous": 0.5,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "keys"),
    [
        ({}, ("sensor.mass", "belief.normal_noise", "external_force.0.force", "external_force.0.duration")),
        (GEARS, ("transmission.backlash", "transmission.load_friction", "external_force.0.moment")),
    ],
)
def test_derivatives_by_the_keys_of_what_disturbs(changes, keys):
    """They are the differences of runs on both sides; and a batch of such runs has the values of each alone."""
    scenario = cl.load_scenario("wam_slide", PUSHED | changes)
    found = cl.gradient(scenario, list(keys), of=["rms_force_error"])
    value = cl.simulate(scenario, engine="compiled").summary()["rms_force_error"]
    assert found.value["rms_force_error"] == pytest.approx(value, rel=1e-9)
    for key in keys:
        own = np.asarray(_value(scenario, key))
        step = 1e-4 * max(float(np.max(np.abs(own))), 0.01)
        sides = []
        for sign in (-1.0, 1.0):
            moved = own + sign * step * np.eye(own.size)[-1].reshape(own.shape)
            sides.append(moved.tolist())
        table = cl.simulate_batch(scenario, {key: sides})["rms_force_error"].to_pylist()
        alone = [cl.simulate(scenario.replace({key: side}), engine="compiled") for side in sides]
        assert table == pytest.approx([run.summary()["rms_force_error"] for run in alone], rel=1e-10)
        expected = (table[1] - table[0]) / (2.0 * step)
        derivative = np.ravel(found.derivative["rms_force_error"][key])[-1]
        assert derivative == pytest.approx(expected, rel=2e-2, abs=1e-6), key


def _value(scenario, key):
    """Return the value of a dotted key."""
    value = scenario.model_dump()
    for part in key.split("."):
        value = value[int(part) if part.isdigit() else part]
    return value


@pytest.mark.parametrize(
    ("force", "words"),
    [
        ({"link": "hand"}, r"external_force\[0\]\.link names no frame of wam4, 'hand'"),
        ({"link": "world"}, r"external_force\[0\]\.link = 'world': no joint moves it"),
        ({"axes": "hand"}, r"external_force\[0\]\.axes names no frame"),
        ({"force": [1.0, 2.0]}, r"external_force\[0\]\.force = .*: must be three numbers"),
        ({"duration": 0.0}, r"external_force\[0\]\.duration = 0.0: must be greater than 0"),
    ],
)
def test_a_force_on_nothing_is_refused(force, words):
    """One line names the key."""
    with pytest.raises(cl.ScenarioError, match=words):
        cl.simulate(cl.load_scenario("wam_slide", {"external_force": [force], "time.duration": 0.01}))
