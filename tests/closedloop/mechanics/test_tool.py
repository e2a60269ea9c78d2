"""A tool, a payload, and a controller that is wrong about the arm: terms by hand, and the force that follows."""

import numpy as np
import pinocchio as pin
import pytest
from rounding import within

import closedloop as cl
from closedloop.record.columns.touching import contact_torques
from closedloop.scenario.arm import robot_of

TOOL = {"tool.offset": [0.02, -0.01, 0.12], "tool.mass": 0.8, "tool.centre": [0.01, 0.0, 0.05],
        "tool.inertia": [2e-3, 2.5e-3, 1e-3, 1e-4, 0.0, -2e-4]}  # fmt: skip


def terms_by_hand(scenario, q, v):
    """Return H, C and the tip of the arm with a tool, from those of the arm alone and the motion of the tool."""
    model = cl.prepare(cl.load_scenario("wam_slide")).robot.model
    plain, tool = model.pinocchio_model(), scenario.tool
    data, frame = plain.createData(), plain.getFrameId("tip")
    pin.computeAllTerms(plain, data, q, v)
    H = np.triu(data.M) + np.triu(data.M, 1).T
    pin.forwardKinematics(plain, data, q, v, np.zeros(plain.nv))
    pin.updateFramePlacements(plain, data)
    pose = data.oMf[frame]
    R = pose.rotation
    J = pin.getFrameJacobian(plain, data, frame, pin.LOCAL_WORLD_ALIGNED)
    motion = pin.getFrameVelocity(plain, data, frame, pin.LOCAL_WORLD_ALIGNED)
    drift = pin.getFrameClassicalAcceleration(plain, data, frame, pin.LOCAL_WORLD_ALIGNED)
    arm = R @ np.array(tool.centre)
    w, dw = motion.angular, drift.angular
    across = np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
    Jc, Jw = J[:3] - across @ J[3:], J[3:]
    fall = drift.linear + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)) - plain.gravity.linear
    xx, yy, zz, xy, xz, yz = tool.inertia
    inertia = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
    C = data.nle + tool.mass * Jc.T @ fall + Jw.T @ (inertia @ dw + np.cross(w, inertia @ w))
    return H + tool.mass * Jc.T @ Jc + Jw.T @ inertia @ Jw, C, pose.translation + R @ np.array(tool.offset)


def test_terms_of_an_arm_with_a_tool():
    """H, C and the tip are those of the arm, and of a rigid body that it carries."""
    scenario = cl.load_scenario("wam_slide", TOOL)
    robot = cl.prepare(scenario).robot
    random = np.random.default_rng(3)
    for _ in range(5):
        q, v = random.uniform(-1, 1, 4) + np.array([0, 0.8, 0, 1.0]), random.uniform(-2, 2, 4)
        H, C, tip = terms_by_hand(scenario, q, v)
        found = robot.terms(q, v)
        assert np.allclose(found.mass_matrix, H, rtol=0, atol=1e-12)
        assert np.allclose(found.bias, C, rtol=0, atol=1e-11)
        assert within(64, found.position, tip)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_controller_that_knows_its_tool_holds_the_force(engine):
    """With the tool in its model the paper's law is exact at rest, wherever the tip is; and the file repeats it."""
    run = cl.simulate(cl.load_scenario("wam_slide", TOOL | {"time.duration": 0.4}), engine=engine)
    assert np.allclose(run.contact_force, 10.0, rtol=0, atol=1e-9)
    assert run.model.tools == ()
    assert np.array_equal(cl.simulate(run.scenario, model=run.model, engine=engine).contact_force, run.contact_force)


@pytest.mark.parametrize("side", ["link", "against"])
def test_a_tool_does_not_move_the_frame_that_a_contact_names(side):
    """The point, or the plane, is in the frame of the robot's file, whatever is fixed to it; and so is its force."""
    other = {"link": "against", "against": "link"}[side]
    contact = {"name": "c", side: "tip", other: "world", "at": [0.01, 0.02, 0.03], "normal": [0, 0.6, 0.8]}
    contact["through"] = [0.0, 0.0, -2.0]
    plain, tooled = (
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.001, "contact": [contact]} | tool))
        for tool in ({}, {"tool.offset": TOOL["tool.offset"]})
    )
    assert plain.link_gaps[0, 0] != 0.0
    assert tooled.link_gaps[0, 0] == pytest.approx(plain.link_gaps[0, 0], abs=1e-14)


def test_the_torque_of_a_contact_on_a_link_with_a_tool():
    """The torques that follow from the columns are those with which H q̈ + C = Q + Jᵀ F."""
    contact = {"name": "c", "link": "tip", "normal": [0, 0, 1], "compliance": {"kind": "kelvin_voigt"}}
    contact["through"] = (cl.prepare(cl.load_scenario("wam_slide")).surface.origin + np.array([0, 0, 1e-3])).tolist()
    changes = {"time.duration": 0.002, "robot.stops": True, "contact": [contact], "surface.kind": "none"}
    run = cl.simulate(cl.load_scenario("wam_slide", changes | TOOL | {"reference.kind": "hold", "law.force": 0.0}))
    assert run.link_forces.min() > 5.0
    robot = robot_of(run.scenario, run.model)
    torque = robot.needed_torque(run.q, run.v, run.acceleration, np.zeros((len(run), 3))) - run.torque
    found = contact_torques(
        run.scenario, run.model.pinocchio_model(), run.time, run.q, run.link_forces, run.link_frictions
    )
    np.testing.assert_allclose(found, torque, atol=1e-9)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_an_unknown_payload_presses_with_its_weight(engine):
    """A mass m at the tip that the controller does not know of presses with m g more, where the arm is at rest."""
    m = 0.3
    run = cl.simulate(
        cl.load_scenario("wam_slide", {"model_error.payload": m, "time.duration": 6.0, "reference": {"kind": "hold"},
                                       "law.pd_start": 0.0}),
        engine=engine,
    )  # fmt: skip
    robot = robot_of(run.scenario, run.model)
    q, zero = run.q[-1], np.zeros(4)
    terms, plain = robot.terms(q, zero), cl.prepare(cl.load_scenario("wam_slide")).robot.terms(q, zero)
    assert np.allclose(terms.bias - plain.bias, m * 9.81 * terms.jacobian[2], rtol=0, atol=1e-12)
    expected = run.torque[-1] - terms.bias  # of an arm at rest these are the torques that f balances
    assert np.allclose(expected, -run.contact_force[-1] * terms.jacobian[2], rtol=0, atol=1e-3)
    law = plain.bias - np.array([900.0, 900, 400, 300]) * (q - run.reference_position[-1]) - 10.0 * terms.jacobian[2]
    assert np.allclose(run.torque[-1], law, rtol=0, atol=1e-3)


def test_wrong_masses_are_what_the_law_reads():
    """κ times the masses: the law's C is κ that of the arm, and its H less the drives likewise; the arm's are true."""
    seen = {}

    def spy(x):
        seen["H"], seen["C"], seen["q"], seen["v"] = x.H.copy(), x.C.copy(), x.q.copy(), x.v.copy()
        return x.C - 10.0 * x.A[0]

    changes = {"model_error.masses": 1.2, "model_error.payload": 0.5, "time.duration": 0.01}
    run = cl.simulate(cl.load_scenario("wam_slide", changes), law=spy)
    plain = cl.prepare(cl.load_scenario("wam_slide")).robot
    terms, drives = plain.terms(seen["q"], seen["v"]), np.diag(plain.model.armature)
    assert np.allclose(seen["C"], 1.2 * terms.bias, rtol=0, atol=1e-12)
    assert np.allclose(seen["H"], 1.2 * (terms.mass_matrix - drives) + drives, rtol=0, atol=1e-12)
    true = robot_of(run.scenario, run.model).terms(run.q[-1], run.v[-1])
    left = true.mass_matrix @ run.acceleration[-1] + true.bias - run.torque[-1]
    assert np.allclose(left, run.contact_force[-1] * true.jacobian[2], rtol=0, atol=1e-9)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_controller_wrong_about_the_normal_presses_along_its_own(engine):
    """A tip that sticks is held by f = F cos α and friction F sin α, in the direction of the tilt."""
    tilt = {"model_error.normal": 0.2, "model_error.normal_towards": 1.0, "friction.kind": "coulomb",
            "friction.coefficient": 0.5, "time.duration": 0.05}  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", tilt), engine=engine)
    assert np.allclose(run.contact_force, 10.0 * np.cos(0.2), rtol=0, atol=1e-9)
    assert np.allclose(
        run.friction_force[:, :2], 10.0 * np.sin(0.2) * np.array([np.cos(1), np.sin(1)]), rtol=0, atol=1e-7
    )
    turn = run.scenario.model_error.tilt()
    assert within(16, turn @ turn.T, np.eye(3))


def test_wrong_figures_of_friction_are_those_of_the_compensation():
    """A factor on all of them is the compensation with the figures multiplied, to the bit."""
    given = {"compensation.kind": "model", "compensation.kinetic": 0.4, "time.duration": 0.02, "law.pd_start": 0.01,
             "compensation.joint_coulomb": [0.1, 0.2, 0.3, 0.4], "reference.start": 0.0}  # fmt: skip
    wrong = cl.simulate(cl.load_scenario("wam_slide", given | {"model_error.friction": 0.5}))
    halves = {"compensation.kinetic": 0.2, "compensation.joint_coulomb": [0.05, 0.1, 0.15, 0.2]}
    assert np.array_equal(wrong.torque, cl.simulate(cl.load_scenario("wam_slide", given | halves)).torque)
    assert not np.array_equal(wrong.torque, cl.simulate(cl.load_scenario("wam_slide", given)).torque)


REFUSED = {
    "no figures": ({"model_error.friction": 0.5}, "the compensation 'none' has no friction values that could be wrong"),
    "upright": ({"model_error.normal": 3.0}, "model_error.normal = 3.0: must be at most 1.5 rad"),
    "no such body": ({"tool.mass": 1.0, "tool.inertia": [1.0, 0.1, 0.1, 0, 0, 0]}, "principal moments"),
    "negative": ({"tool.mass": -1.0}, "tool.mass = -1.0: must not be negative"),
    "no mass": ({"model_error.masses": 0.0}, "model_error.masses = 0.0: must be greater than 0"),
    "no tip": ({"robot.tip": "hand", "tool.mass": 1.0}, "has no frame 'hand'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """Each with the key or the reason."""
    changes, words = REFUSED[case]
    with pytest.raises(cl.ClosedLoopError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "surface",
    [
        {"surface.kind": "sphere", "surface.radius": 0.3, "surface.inside": True},
        {"surface.kind": "cylinder", "surface.radius": 0.3, "surface.inside": True, "surface.axis": [1, 0, 0]},
        {"surface.kind": "implicit", "surface.expression": "z - x*x/0.6 + y*y"},
    ],
    ids=lambda surface: surface["surface.kind"],
)
def test_a_round_tool_larger_than_a_hollow_is_refused(surface):
    """Where the surface is hollow with 0.3 m a tool of 0.31 m does not fit, one of 0.29 m does; a ball takes any."""
    quick = {"time.step": 0.01, "time.duration": 1.5, "reference.stop": 1.0, "stabiliser.time_constant": "auto"}
    cl.prepare(cl.load_scenario("wam_slide", surface | quick | {"tool.radius": 0.29}))
    with pytest.raises(cl.ScenarioError, match=r"tool\.radius = 0\.31: .* hollow with a radius of 0\.3 m") as refused:
        cl.prepare(cl.load_scenario("wam_slide", surface | quick | {"tool.radius": 0.31}))
    assert "\n" not in str(refused.value)
    cl.prepare(cl.load_scenario("wam_sphere", quick | {"tool.radius": 5.0}))
