"""The wrench at the wrist against Pinocchio's recursion and statics; gravity in any direction."""

import json

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from rounding import within

import closedloop as cl
from closedloop.figures.export.files import write_csv
from closedloop.figures.export.mjcf import write_mjcf
from closedloop.figures.motion import has_tool

TOOL = {"tool.offset": [0.02, -0.01, 0.12], "tool.mass": 0.8, "tool.centre": [0.01, 0.0, 0.05],
        "tool.inertia": [2e-3, 2.5e-3, 1e-3, 1e-4, 0.0, -2e-4]}  # fmt: skip
SHORT = {"time.duration": 0.6, "reference.start": 0.0, "reference.speed": 0.05, "reference.stop": 0.5,
         "friction": {"kind": "coulomb", "coefficient": 0.2}}  # fmt: skip


def with_a_joint_at_the_wrist(run):
    """Return the arm of a run with one more joint at its tip's frame, that carries the tool and the payload."""
    model, tool, payload = run.model.pinocchio_model(), run.scenario.tool, run.scenario.model_error.payload
    frame = model.frames[model.getFrameId(run.model.tip)]
    joint = model.addJoint(frame.parentJoint, pin.JointModelRZ(), frame.placement, "wrist")
    xx, yy, zz, xy, xz, yz = tool.inertia
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    body = pin.Inertia(tool.mass, np.array(tool.centre), tensor)
    body = body + pin.Inertia(payload, np.array(tool.offset), np.zeros((3, 3)))
    model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return model, joint


@pytest.mark.parametrize("tool", [{}, TOOL, TOOL | {"model_error.payload": 0.3}])
def test_the_wrist_wrench_is_that_of_a_recursion(tool):
    """Newton and Euler from the tip to a joint put where the sensor is, the contact as an external force."""
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT | tool))
    model, joint = with_a_joint_at_the_wrist(run)
    data, offset = model.createData(), np.array(run.scenario.tool.offset)
    assert np.max(np.abs(run.acceleration)) > 0.1
    assert np.max(np.abs(run.friction_force)) > 1.0
    for k in range(0, len(run), 50):
        q, v, a = (np.append(x[k], 0.0) for x in (run.q, run.v, run.acceleration))
        pin.forwardKinematics(model, data, q)
        turned = data.oMi[joint].rotation.T @ run.tip_force[k]
        outside = pin.StdVec_Force([pin.Force.Zero()] * model.njoints)
        outside[joint] = pin.Force(turned, np.cross(offset, turned))
        pin.rnea(model, data, q, v, a, outside)
        assert np.allclose(run.wrist_wrench[k], data.f[joint].vector, rtol=0, atol=1e-11)


def axis_of(joint):
    """Return the axis of a joint of Pinocchio's that turns about x, y or z, in its own axes."""
    return np.eye(3)["XYZ".index(joint.shortname().removeprefix("JointModelR"))]


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_joint_carries_what_hangs_on_it(engine):
    """Of each joint the force is m (a − g) of the bodies outward less that on the tip; the moment is that of momentum.

    Along its axis the moment is Q less the drive's own inertia.
    """
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT | TOOL), engine=engine)
    robot = cl.prepare(run.scenario).robot
    _, _, _, model, data = robot.passes
    wrenches = {name: run.joint_wrench(name, "world") for name in run.model.joint_names}
    for k in range(0, len(run), 100):
        q, v, a = run.q[k].copy(), run.v[k].copy(), run.acceleration[k].copy()
        pin.centerOfMass(model, data, q, v, a)
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        rate = data.dhg.angular.copy()
        pin.centerOfMass(model, data, q, v, a)
        for j, name in enumerate(run.model.joint_names, 1):
            turn = data.oMi[j].rotation
            needed = data.mass[j] * (turn @ data.acom[j] - model.gravity.linear) - run.tip_force[k]
            assert np.allclose(wrenches[name][k, :3], needed, rtol=0, atol=1e-9)
            axis = turn @ axis_of(model.joints[j])
            drives = run.torque[k, j - 1] - run.model.armature[j - 1] * a[j - 1]
            assert wrenches[name][k, 3:] @ axis == pytest.approx(drives, abs=1e-9)
        first = wrenches[run.model.joint_names[0]][k]
        arms = [place - data.com[0] for place in (data.oMi[1].translation, run.position[k])]
        moment = first[3:] + np.cross(arms[0], first[:3]) + np.cross(arms[1], run.tip_force[k])
        assert np.allclose(moment, rate, rtol=0, atol=1e-9)


def test_the_frame_of_a_wrench_turns_it_alone():
    """In the joint's own axes, the base's and those of a frame it has one size, and is its turned self."""
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT | {"time.duration": 0.02}))
    own, base, tip = (run.joint_wrench("J3", frame) for frame in ("joint", "world", "tip"))
    robot = cl.prepare(run.scenario).robot
    axes = robot.tip_axes(run.q)
    for part in (slice(0, 3), slice(3, 6)):
        assert np.allclose(np.einsum("kij,kj->ki", axes, tip[:, part]), base[:, part], rtol=0, atol=1e-10)
        assert np.allclose(np.linalg.norm(own[:, part], axis=1), np.linalg.norm(base[:, part], axis=1), atol=1e-10)
    recorded = cl.simulate(run.scenario, record={"elbow": (lambda run: run.joint_wrench("J3"), "N | N m")})
    assert np.array_equal(recorded["elbow"], own)


def test_contacts_of_links_are_part_of_what_hangs_on_a_joint():
    """On four feet each leg's joint carries the force of its foot: along the axis it is the drive's torque."""
    run = cl.simulate(cl.load_scenario("quadruped", {"time.duration": 0.05}))
    assert np.max(run.link_forces) > 10.0
    q = run.model.joint_names
    legs = [j for j, kind in enumerate(run.model.joint_types) if kind == "revolute"]
    model = run.model.pinocchio_model()
    assert len(legs) >= 8
    for j in legs:
        joint = model.joints[model.getJointId(q[j])]
        axis = axis_of(joint)
        drives = run.torque[:, j] - run.model.armature[j] * run.acceleration[:, j] + run.joint_friction[:, j]
        assert np.allclose(run.joint_wrench(q[j])[:, 3:] @ axis, drives, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("joint", "frame", "words"),
    [("J9", "joint", r"joint = 'J9': must be one of J1, J2, J3, J4"), ("J1", "hand", "hand")],
)
def test_a_wrench_at_no_joint_is_refused(joint, frame, words):
    """One line with the joints that there are."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.002}))
    with pytest.raises(cl.ClosedLoopError, match=words):
        run.joint_wrench(joint, frame)


@pytest.mark.parametrize("name", ["delta", "stewart"])
def test_loop_joints_are_part_of_what_hangs_on_a_joint(name):
    """With what they carry, each joint of the tree has what its drive gives along its axis; one without a drive none.

    A gear would be a part of that. The rods' own joints carry their forces.
    """
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.01}))
    model = run.model.pinocchio_model()
    for j, joint in enumerate(run.model.joint_names):
        kind = model.joints[model.getJointId(joint)].shortname().removeprefix("JointModel")
        along = "RP".index(kind[0]), "XYZ".index(kind[1])
        drives = run.torque[:, j] - run.model.armature[j] * run.acceleration[:, j] + run.joint_friction[:, j]
        found = run.joint_wrench(joint)[:, 3 * (1 - along[0]) + along[1]]
        assert np.allclose(found, drives, rtol=0, atol=1e-12)
    carried = np.abs(run.loops.reactions).max()
    assert carried > 0.1
    with pytest.raises(cl.ScenarioError, match=r"must be one of .*; what loop joints carry is in run\.loops"):
        run.joint_wrench(run.model.loops[0].name)


def test_the_command_line_records_a_wrench(command_line, tmp_path):
    """--record wrench:JOINT is a column of run.nc, with its unit; one at no joint is refused first."""
    options = ["wam_slide", "--time.duration", "0.01", "--no-figures", "--out", str(tmp_path / "out")]
    assert command_line(*options, "--record", "wrench:J4", "--record", "wrench:J2@world").status == 0
    run = cl.load_run(tmp_path / "out" / "run.nc")
    assert np.array_equal(run["wrench_J4"], run.joint_wrench("J4"))
    assert np.array_equal(run["wrench_J2_world"], run.joint_wrench("J2", "world"))
    assert run.units("wrench_J4") == "N | N m"
    assert "must be one of J1, J2, J3, J4" in command_line(*options[:4], "--record", "wrench:J9").refusal(2)


def test_a_hanging_tool_weighs_on_the_wrist():
    """At rest, off the surface: m g upwards and its moment about the wrist, in the axes of the tip's frame."""
    changes = TOOL | {"surface.contact": "unilateral", "surface.gap": 0.1, "time.duration": 0.05, "law.force": 0.0,
                      "reference": {"kind": "hold"}, "robot.gravity": [1.0, 2.0, -9.0]}  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    assert np.max(np.abs(run.v)) < 1e-9
    model = run.model.pinocchio_model()
    data = model.createData()
    pin.framesForwardKinematics(model, data, run.q[-1])
    turn = data.oMf[model.getFrameId(run.model.tip)].rotation
    force = turn.T @ (-0.8 * np.array([1.0, 2.0, -9.0]))
    expected = [*force, *np.cross([0.01, 0.0, 0.05], force)]
    assert np.allclose(run.wrist_wrench[-1], expected, rtol=0, atol=1e-6)
    assert run.summary()["wrist"]["max_force"] == pytest.approx(np.linalg.norm(force), abs=1e-6)


def test_the_wrench_is_exported_and_found_again(tmp_path):
    """CSV and pandas have it, with its units; a saved run works it out to the same bits; it is read-only."""
    run = cl.simulate(cl.load_scenario("wam_slide", TOOL | {"time.duration": 0.02}))
    again = cl.load_run(run.save(tmp_path / "run.nc"))
    assert np.array_equal(again.wrist_wrench, run.wrist_wrench)
    assert not run.wrist_wrench.flags.writeable
    (file,) = write_csv(run, tmp_path / "run.csv")
    table = np.genfromtxt(file, delimiter=",", names=True, deletechars="")
    assert np.array_equal(table["wrist_wrench_fz_[N]"], run.wrist_wrench[:, 2])
    assert np.array_equal(table["wrist_wrench_mx_[N_m]"], run.wrist_wrench[:, 3])
    assert np.array_equal(table["tip_force_z_[N]"], run.tip_force[:, 2])
    assert np.array_equal(run.to_pandas()["wrist_wrench[my]"], run.wrist_wrench[:, 4])
    assert json.dumps(run.summary()["wrist"])


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_gravity_turned_is_the_base_turned(engine):
    """An arm on a wall: with gravity and surface seen from its base, its first joint turned like them, all is equal.

    The first joint of the arm turns about gravity's direction only if gravity is vertical; so gravity is laid into the
    horizontal plane, and it and everything else are turned about the first joint's axis.
    """
    turn = 0.7
    R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    common = {"time.duration": 0.3, "reference.start": 0.05, "reference.stop": 0.25, "law.kp": 0.0, "law.kd": 20.0}
    start, fall, along = np.array([1.5707963267948966, 1.0, 0.0, 2.0]), np.array([9.0, 1.0, 3.0]), [0.0, 1.0, 0.0]
    runs = [
        cl.simulate(
            cl.load_scenario("wam_slide", common | {
                "robot.gravity": list(turned @ fall), "start.q": [angle + start[0], *start[1:]],
                "reference.direction": list(turned @ along),
            }), engine=engine,
        ) for turned, angle in ((np.eye(3), 0.0), (R, turn))
    ]  # fmt: skip
    level, turned = runs
    assert np.allclose(turned.q - [turn, 0, 0, 0], level.q, rtol=0, atol=1e-12)
    assert np.allclose(turned.contact_force, level.contact_force, rtol=0, atol=1e-8)
    assert np.allclose(turned.torque, level.torque, rtol=0, atol=1e-8)
    assert np.allclose(turned.wrist_wrench, level.wrist_wrench, rtol=0, atol=1e-8)
    assert turned.summary()["max_energy_residual"] < 1e-3


CEILING, WALL = np.diag([1.0, -1.0, -1.0]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.mark.parametrize(("gravity", "turned"), [([0.0, 0.0, 9.81], CEILING), ([0.0, -9.81, 0.0], WALL)])
def test_an_arm_on_a_ceiling_or_a_wall_is_one_with_a_turned_base(gravity, turned):
    """H and C of both engines are those of the arm whose base is turned instead, under gravity straight down."""
    robot = cl.prepare(cl.load_scenario("wam_slide", {"robot.gravity": gravity})).robot
    assert np.array_equal(robot.model.gravity, gravity)
    model = cl.prepare(cl.load_scenario("wam_slide")).robot.model.pinocchio_model()
    model.jointPlacements[1] = pin.SE3(turned, np.zeros(3)) * model.jointPlacements[1]
    data, random = model.createData(), np.random.default_rng(1)
    assert within(64, turned @ gravity, model.gravity.linear)
    for _ in range(3):
        q, v = random.uniform(-1, 1, 4), random.uniform(-2, 2, 4)
        terms, bias = robot.terms(q, v), pin.nonLinearEffects(model, data, q, v)
        assert np.allclose(terms.bias, bias, rtol=0, atol=1e-12)
        pin.crba(model, data, q)
        assert np.allclose(np.triu(terms.mass_matrix), np.triu(data.M), rtol=0, atol=1e-12)


def test_gravity_that_is_no_vector_is_refused():
    """One line with the key."""
    faults = {"must be three numbers": ([0, 0], [[1.0, 2.0, 3.0]]), "finite": ([0, 0, float("nan")],),
              "at most": ([0, 0, 1e9],)}  # fmt: skip
    for words, wrong in ((words, each) for words, several in faults.items() for each in several):
        with pytest.raises(cl.ScenarioError, match=words) as caught:
            cl.load_scenario("wam_slide", {"robot.gravity": wrong})
        assert len(caught.value.faults) == 1
        assert "robot.gravity" in str(caught.value)


def test_a_tool_has_a_figure():
    """Force, moment and turn are drawn for an arm with a tool, and only then written."""
    short = {"time.duration": 0.02, "name": "with_a_tool"}
    run, without = (cl.simulate(cl.load_scenario("wam_slide", short | tool)) for tool in (TOOL, {}))
    panels = cl.figures.tool(run).axes
    assert [len(axes.lines) for axes in panels[:2]] >= [3, 3]
    assert np.array_equal(panels[0].lines[2].get_ydata(), run.wrist_wrench[:, 2])
    assert np.array_equal(panels[2].lines[0].get_ydata(), run.tool_angle)
    assert has_tool(run)
    assert not has_tool(without)


@pytest.mark.parametrize("joint", ["J2", "J4"])
def test_a_joint_carries_what_mujocos_sensors_read(joint, tmp_path):
    """In MuJoCo force and torque sensors at the joint of the same arm, in the same motion, under the same contact."""
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT))
    (scene,) = write_mjcf(run, tmp_path / "scene.xml")
    spec = mujoco.MjSpec.from_file(str(scene))
    at = spec.body(joint).add_site(name="sensor", pos=[0, 0, 0])
    for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE):
        spec.add_sensor(name=kind.name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=at.name)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    data, found = mujoco.MjData(model), run.joint_wrench(joint)
    for k in range(0, len(run), 100):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = run.q[k], run.v[k], run.torque[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        arm = run.position[k] - data.xipos[model.body("J4").id]
        data.xfrc_applied[model.body("J4").id] = [*run.tip_force[k], *np.cross(arm, run.tip_force[k])]
        mujoco.mj_forward(model, data)
        assert np.allclose(data.qacc, run.acceleration[k], rtol=0, atol=1e-5)
        assert np.allclose(data.sensordata, found[k], rtol=0, atol=1e-6)
