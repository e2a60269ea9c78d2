"""Frames whose motion a scenario gives, and what loop joints hold onto them: [[mocap]]."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import closedloop as cl
import robot_models
from closedloop.figures.scene.scene import scene_of
from closedloop.mechanics.surface.motion import MOTIONS
from closedloop.record.report.summary import energy_balance

COM, MASS, MOMENTS = np.array([0.1, 0.02, -0.03]), 2.0, np.array([0.01, 0.02, 0.03])
BODY = """<mujoco><worldbody><body name="target" mocap="true" pos=".5 0 1"/>
<body name="hand" pos=".5 0 1"><freejoint/><geom size=".05"/>
 <inertial pos=".1 .02 -.03" mass="2" diaginertia=".01 .02 .03"/></body></worldbody>
<equality><weld name="hold" body1="hand" body2="target" solref="{}"/></equality></mujoco>"""
# Two hinges on a base that is welded to the frame, and a finger that slides out of it.
ARM = """<mujoco><worldbody><body name="target" mocap="true" pos="0 0 .3"/>
<body name="base" pos="0 0 .3"><freejoint/><geom size=".05" mass="1"/>
 <body name="upper"><joint name="J1" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".5"/>
  <body name="lower" pos=".3 0 0"><joint name="J2" axis="0 1 0" damping=".02"/>
   <geom type="capsule" size=".02" fromto="0 0 0 0 0 .2" mass=".3"/></body></body></body></worldbody>
<equality><weld name="hold" body1="target" body2="base"/></equality></mujoco>"""
FINGER = """<mujoco><worldbody><body name="target" mocap="true" pos="0 0 .3"/>
<body name="hand" pos="0 0 .3"><freejoint/><geom size=".02" mass="1"/>
 <body name="finger" pos="0 0 -.1"><joint name="slide" type="slide" axis="0 0 1" stiffness="200"/>
  <geom size=".01" mass=".3"/><site name="tip" pos=".02 0 -.05"/></body></body></worldbody>
<equality><weld name="hold" body1="hand" body2="target"/></equality></mujoco>"""
TURNTABLE = {"kind": "turntable", "axis": [0, 0, 1], "centre": [0, 0, 0], "speed": 3.0}
POSES = {
    "kind": "poses", "times": [0.0, 0.2, 0.4, 0.6],
    "poses": [[0, 0, 0.3, 1, 0, 0, 0], [0.02, 0, 0.22, 1, 0.1, 0.1, 0], [0.05, 0.02, 0.1, 1, -0.1, 0.05, 0.1],
              [0.1, 0.02, 0.25, 1, 0, 0.1, 0]],
}  # fmt: skip


def moved(tmp_path, text, motion, tip, changes=None, **sections):
    """The scenario of an MJCF whose mocap body moves so."""
    path = tmp_path / "moved.xml"
    path.write_text(text, encoding="utf-8")
    data = {"robot": {"model": str(path), "tip": tip}, "time": {"duration": 0.05, "integrator": "rk4"}} | sections
    return cl.load_scenario(data | {"mocap": [{"frame": "target", "motion": motion}]}, changes or {})


def simulated(scenario, **options):
    """Its run."""
    return cl.simulate(scenario, progress=False, **options)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_body_on_a_circle_needs_m_omega_squared_r(tmp_path, engine):
    """The weld gives −m ω² r of its centre of mass, the weight, and the moment of both; it starts with the frame."""
    run = simulated(moved(tmp_path, BODY.format("0.02 1"), TURNTABLE, "hand"), engine=engine)
    r = np.array([0.5, 0.0, 0.0]) + COM  # from the axis, in axes that turn with the frame, as a reaction is
    force = MASS * np.array([-9.0 * r[0], -9.0 * r[1], 9.81])
    moment = np.cross(COM, force)  # ω is along a principal axis
    np.testing.assert_allclose(run.loops.reactions, np.tile([*force, *moment], (len(run.time), 1)), atol=1e-12)
    np.testing.assert_allclose(run.v[0], [0, 1.5, 0, 0, 0, 3], atol=1e-14)
    np.testing.assert_allclose(run.q[:, :2], 0.5 * np.column_stack([np.cos(3 * run.time), np.sin(3 * run.time)]))
    assert np.abs(run.loops.errors).max() < 1e-14


def test_a_body_that_follows_poses_needs_what_newton_and_euler_say(tmp_path):
    """The wrench is that of the motion itself, differentiated by differences of fourth order."""
    motion = MOTIONS["poses"](**{k: v for k, v in POSES.items() if k != "kind"})
    run = simulated(moved(tmp_path, BODY.format("0.02 1"), POSES, "hand", {"time.duration": 0.4}))
    frame = cl.prepare(run.scenario).robot.moved[0]
    assert frame.motion == motion
    h, weights = 1e-3, np.array([1, -8, 0, 8, -1]) / 12e-3

    def centre(t):
        turns, shifts = frame.displacements(np.array([t]))
        return turns[0], turns[0] @ (frame.origin + COM) + shifts[0]

    def spin(t):
        return pin.unSkew(
            sum(w * centre(t + k * h)[0] for k, w in zip(range(-2, 3), weights, strict=True)) @ centre(t)[0].T
        )

    def rate(of, t):
        return sum(w * of(t + k * h) for k, w in zip(range(-2, 3), weights, strict=True))

    for row in (150, 250, 330):
        t, turn = run.time[row], centre(run.time[row])[0]
        acceleration = rate(lambda x: rate(lambda y: centre(y)[1], x), t)
        inertia = turn @ np.diag(MOMENTS) @ turn.T
        force = MASS * (acceleration + 9.81 * np.array([0, 0, 1]))
        about = inertia @ rate(spin, t) + np.cross(spin(t), inertia @ spin(t))
        wrench = [*(turn.T @ force), *(turn.T @ (about + np.cross(turn @ COM, force)))]
        np.testing.assert_allclose(run.loops.reactions[row], wrench, atol=2e-5)  # of the differences


def test_what_is_fixed_to_a_frame_is_drawn_where_the_frame_is(tmp_path):
    """A box of the mocap body and an equal one of the hand that is welded to it lie in each other at each row."""
    box = '<geom type="box" size=".05 .02 .1"/>'
    text = (
        BODY.format("0.02 1").replace('<geom size=".05"/>', box).replace('pos=".5 0 1"/>', f'pos=".5 0 1">{box}</body>')
    )
    scene = scene_of(simulated(moved(tmp_path, text, TURNTABLE, "hand", {"time.duration": 0.2})))
    assert len(scene.shapes) == 2
    for row in (0, 70, len(scene.run) - 1):
        axes, origins = scene.joint_places(row)
        one, other = (s.vertices @ axes[s.joint].T + origins[s.joint] for s in scene.shapes)
        np.testing.assert_allclose(one, other, atol=1e-7)
    turned = 3.0 * 0.2
    np.testing.assert_allclose(one.mean(axis=0), [0.5 * np.cos(turned), 0.5 * np.sin(turned), 1.0], atol=1e-7)


def test_a_frame_is_overridden_by_its_name(tmp_path):
    """As a contact or a body is; a name that is none is refused with those that there are."""
    given = {"mocap.target.motion.speed": 5.0}
    scenario = moved(tmp_path, BODY.format("0.02 1"), TURNTABLE, "hand", given)
    assert scenario.mocap[0].motion.speed == 5.0
    assert scenario.replace({"mocap.target.motion.speed": -1.0}).mocap[0].motion.speed == -1.0
    with pytest.raises(cl.ScenarioError, match=r"there is no mocap 'targets'; there are 'target' \(0\)"):
        scenario.replace({"mocap.targets.motion.speed": 1.0})


def test_an_arm_on_a_base_that_moves_is_one_on_a_base_at_rest_with_its_acceleration_as_gravity(tmp_path):
    """With a base that shifts and does not turn, q̈ of the hinges is Pinocchio's of the arm alone with g − a(t)."""
    motion = POSES | {"poses": [[*pose[:3], 1, 0, 0, 0] for pose in POSES["poses"]]}
    run = simulated(moved(tmp_path, ARM, motion, "lower", {"time.duration": 0.3, "robot.friction": True}))
    alone = robot_models.load(run.scenario.robot.model, lock=["base"]).pinocchio_model()
    for row in (0, 120, 300):
        alone.gravity.linear = np.array([0, 0, -9.81]) - run.acceleration[row, :3]
        torque = np.array([0.0, -0.02 * run.v[row, 7]])
        wanted = pin.aba(alone, alone.createData(), run.q[row, 7:], run.v[row, 6:], torque)
        np.testing.assert_allclose(run.acceleration[row, 6:], wanted, atol=1e-10)
    assert np.abs(run.acceleration[120, :3]).max() > 1.0
    assert np.abs(run.loops.errors).max() < 1e-14


@pytest.mark.slow
def test_what_a_frame_does_is_in_the_balance_of_energy_through_impacts(tmp_path):
    """A finger on a hand that moves bounces on a surface, or on a box; what is left is of the fourth order."""
    on_surface = {
        "surface": {"kind": "plane", "offset": 0.05, "contact": "unilateral"}, "impact": {"restitution": 0.6},
        "friction": {"kind": "coulomb", "coefficient": 0.2},
    }  # fmt: skip
    box = '<body name="box" pos=".05 0 .05"><freejoint/><geom type="box" size=".05 .05 .05" mass=".5"/></body>'
    on_box = {"contact": [
        {"link": "tip", "against": "box", "through": [0, 0, 0.05], "friction": 0.4, "restitution": 0.6},
        {"link": "box", "at": "collision", "friction": 0.5},
    ]}  # fmt: skip
    cases = ((FINGER, on_surface, 0.3), (FINGER.replace("</worldbody>", box + "</worldbody>"), on_box, 0.21))
    for text, more, end in cases:
        left = []
        for step in (1e-3, 5e-4):
            run = simulated(moved(tmp_path, text, POSES, "tip", {"time.duration": end, "time.step": step}, **more))
            assert sum(event.kind == "impact" for event in run.events) >= 3
            assert run.summary()["energy_lost_in_impacts"] > 0.01
            left.append(np.abs(energy_balance(run)[0]).max())
        assert left[0] < 1e-8
        assert left[1] < left[0] / 8.0


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "dop853"])
def test_other_integrators_follow_the_frame_too(tmp_path, integrator):
    """They have the hinges' motion of rk4 within their own errors."""
    runs = [
        simulated(moved(tmp_path, ARM, POSES, "lower", {"time.duration": 0.2, "time.integrator": name}))
        for name in ("rk4", integrator)
    ]
    np.testing.assert_allclose(runs[1].q, runs[0].q, atol=5e-3 if integrator != "dop853" else 1e-8)
    assert np.abs(runs[1].loops.errors).max() < 1e-14


def test_mujocos_soft_weld_is_behind_the_rigid_one_by_its_softness(tmp_path):
    """MuJoCo gives a mocap body no velocity, so its weld drags: by v times the damper over the spring, 2 solref."""
    scenario = moved(tmp_path, BODY.format("0.02 1"), TURNTABLE, "hand", {"time.duration": 0.3})
    end = simulated(scenario).q[-1, :3]
    for solref in (0.03, 0.01):
        model = mujoco.MjModel.from_xml_string(BODY.format(f"{solref} 1"))
        model.opt.timestep = 1e-4
        data = mujoco.MjData(model)
        data.qvel[:] = [0, 1.5, 0, 0, 0, 3]
        for _ in range(3000):
            angle = 3.0 * (data.time + 1e-4)
            data.mocap_pos[0] = [0.5 * np.cos(angle), 0.5 * np.sin(angle), 1.0]
            data.mocap_quat[0] = [np.cos(0.5 * angle), 0, 0, np.sin(0.5 * angle)]
            mujoco.mj_step(model, data)
        assert np.linalg.norm(data.qpos[:3] - end) == pytest.approx(1.5 * 2.0 * solref, rel=0.02)


def test_a_derivative_is_that_of_differences(tmp_path):
    """The kinetic energy of a body on a circle grows with the square of the speed."""
    scenario = moved(tmp_path, BODY.format("0.02 1"), TURNTABLE, "hand", {"time.duration": 0.01})
    found = cl.gradient(scenario, ["mocap.0.motion.speed"], of=["max_kinetic_energy"])
    value, slope = found.value["max_kinetic_energy"], found.derivative["max_kinetic_energy"]["mocap.0.motion.speed"]
    assert slope == pytest.approx(2.0 * value / 3.0, rel=1e-6)


def test_what_the_joints_cannot_follow_stops_the_run(tmp_path):
    """Two hinges in a plane are pulled out of it, or beyond their reach."""
    text = ARM.replace("<freejoint/>", "").replace('body1="target" body2="base"', 'body1="lower" body2="target"')
    for motion in (POSES, {"kind": "conveyor", "velocity": [0, 0.1, 0]}):
        with pytest.raises(cl.SimulationError, match="the joints cannot follow a \\[\\[mocap\\]\\]"):
            simulated(moved(tmp_path, text, motion, "lower"))


WRONG = {
    "no frame": (
        {"mocap.0.frame": "nope"},
        "mocap.0.frame = 'nope': must be a frame of the robot that is fixed to the",
    ),
    "a link": (
        {"mocap.0.frame": "lower"},
        "mocap.0.frame = 'lower': must be a frame of the robot that is fixed to the",
    ),
    "no kind": ({"mocap.0.motion.kind": "turn"}, "mocap[0].motion.kind = 'turn': must be 'belt' or 'breathing' or"),
    "no speed": ({"mocap.0.motion.speed": 0.0}, "mocap[0].motion.speed = 0.0: must not be zero"),
    "a velocity": ({"start.v": [0.1, *[0.0] * 7]}, "start.v: the loops would open, by"),
    "a path": (
        {"reference.kind": "line", "reference.direction": [1, 0, 0], "reference.speed": 0.1, "reference.stop": 0.04},
        "reference.kind = 'line': inverse kinematics follows no path",
    ),
    "its point": ({"contact": [{"link": "target"}]}, "link 'target' moves as a [[mocap]] says: name it as against"),
    "its plane": ({"contact": [{"link": "lower", "against": "target"}]}, "give the contact that motion too"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_is_said_in_a_line(tmp_path, case):
    """Each is refused before the run, with its key."""
    changes, said = WRONG[case]
    sections = {key: changes[key] for key in changes if key == "contact"}
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(moved(tmp_path, ARM, TURNTABLE, "lower", changes if not sections else {}, **sections))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_frame_that_nothing_holds_onto_is_refused(tmp_path):
    """In an MJCF it is the equality that is missing; without the [[mocap]] one is left out, as is said."""
    with pytest.raises(cl.ScenarioError, match="no loop joint holds onto it"):
        cl.prepare(moved(tmp_path, ARM.partition("<equality>")[0] + "</mujoco>", TURNTABLE, "lower"))
    (tmp_path / "moved.xml").write_text(ARM, encoding="utf-8")
    model = robot_models.load(tmp_path / "moved.xml")
    assert model.loops == ()
    assert any("[[mocap]]" in line and "'hold'" in line for line in model.warnings)


def test_a_frame_of_a_urdf_moves_too_and_a_run_is_read_back(tmp_path):
    """A link that a fixed joint holds in the world is the frame of a [[closed_loop]]; reactions follow from a file."""
    (tmp_path / "slide.urdf").write_text(
        '<robot name="slide"><link name="world"/><link name="anchor"/><link name="cart"><inertial><mass value="2"/>'
        '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="fix" type="fixed"><parent link="world"/><child link="anchor"/></joint>'
        '<joint name="x" type="prismatic"><parent link="world"/><child link="cart"/><axis xyz="1 0 0"/>'
        '<limit effort="10" velocity="1"/></joint></robot>',
        encoding="utf-8",
    )
    (tmp_path / "slide.toml").write_text('[[closed_loop]]\ntype = "point"\nframes = ["cart", "anchor"]\n')
    scenario = cl.load_scenario(
        {
            "robot": {"model": str(tmp_path / "slide.urdf")}, "time": {"duration": 0.4},
            "mocap": [{"frame": "anchor", "motion": {
                "kind": "poses", "times": [0.0, 0.4], "poses": [[0, 0, 0, 1, 0, 0, 0], [0.1, 0, 0, 1, 0, 0, 0]],
            }}],
        }
    )  # fmt: skip
    run = simulated(scenario)
    s = run.time / 0.4
    np.testing.assert_allclose(run.q[:, 0], 0.1 * s**3 * (10 - 15 * s + 6 * s**2), atol=1e-15)
    np.testing.assert_allclose(
        run.loops.reactions[:, 0], 2.0 * 0.1 / 0.16 * (60 * s - 180 * s**2 + 120 * s**3), atol=1e-11
    )
    run.save(tmp_path / "run.nc")
    again = cl.load_run(tmp_path / "run.nc")
    np.testing.assert_array_equal(again.loops.reactions, run.loops.reactions)
