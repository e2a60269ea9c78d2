"""The terms of the equation of motion: Pinocchio's, by two ways through Pinocchio, and right by definition."""

import numpy as np
import pinocchio as pin
import pytest

import closedloop as cl
import robot_models
from closedloop.mechanics.robot.tip import tip_kinematics

# Two summations of the same few dozen products in another order: some hundred roundings of 1e-16 of the largest.
ROUNDING = 1e-13

# name and tip; solo12 has four legs, and its tip is on one of them
ROBOTS = [("planar2", None), ("pointmass3", None), ("wam4", None), ("panda", None), ("solo12", "HR_FOOT")]
IDS = [name for name, _ in ROBOTS]


def close(ours, theirs, tolerance):
    """Whether no entry differs by more than `tolerance` of the largest."""
    theirs = np.asarray(theirs)
    return np.max(np.abs(ours - theirs)) <= tolerance * max(1.0, np.max(np.abs(theirs)))


def fast_path(robot, q, v):
    """Return Jᵣ, r and J̇ᵣq̇ as the compiled step computes them."""
    robot.evaluator(q, v)()
    _, _, joint_jacobian, *link = robot.views
    J, r, drift = np.zeros((3, robot.n)), np.zeros(3), np.zeros(3)
    tip_kinematics(joint_jacobian, tuple(link), robot.tip_offset, robot.gravity, robot.support, J, r, drift)
    return J, r, drift


@pytest.mark.parametrize(("name", "tip"), ROBOTS, ids=IDS)
def test_fast_path_equals_pinocchios_frame_functions(name, tip, robot, random_states):
    """Tip kinematics moved over from the joint's equal those that Pinocchio computes for the frame."""
    arm = robot(name, tip)
    for s in random_states(arm, 30, 0):
        terms = arm.terms(s.q, s.v)
        J, r, drift = fast_path(arm, s.q, s.v)
        assert close(J, terms.jacobian, ROUNDING)
        assert close(r, terms.position, ROUNDING)
        assert close(drift, terms.drift, ROUNDING)


@pytest.mark.parametrize("tip", ["FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"])
def test_joints_of_other_branches_do_not_move_the_tip(tip, robot, random_states):
    """On a branching robot the Jacobian's columns are exactly zero off the path from base to tip, and only there."""
    arm = robot("solo12", tip)
    assert np.count_nonzero(arm.support) == 3
    s = random_states(arm, 1, 1)[0]
    for J in (fast_path(arm, s.q, s.v)[0], arm.terms(s.q, s.v).jacobian):
        moved = np.any(J != 0.0, axis=0)
        assert np.array_equal(moved, arm.support != 0.0)


@pytest.mark.parametrize(("name", "tip"), ROBOTS, ids=IDS)
def test_mass_matrix_and_bias_invert_recursive_newton_euler(name, tip, robot, random_states):
    """H q̈ + C is the torque of `pin.rnea`, whose recursion knows neither matrix, drives included."""
    arm = robot(name, tip)
    model = arm.model.pinocchio_model()
    data = model.createData()
    for s in random_states(arm, 10, 2):
        terms = arm.terms(s.q, s.v)
        acceleration = s.torque
        torque = pin.rnea(model, data, s.q, s.v, acceleration)
        assert close(terms.mass_matrix @ acceleration + terms.bias, torque, 1e-12)
        assert np.array_equal(terms.mass_matrix, terms.mass_matrix.T)


def test_drift_has_no_gravity_in_it(robot):
    """At rest J̇ᵣq̇ is zero: the gravity that the fast path's passes carry is taken out to rounding."""
    for name, tip in ROBOTS:
        arm = robot(name, tip)
        rest = np.zeros(arm.n)
        assert np.max(np.abs(arm.terms(arm.model.home, rest).drift)) < 1e-14
        assert np.max(np.abs(fast_path(arm, np.array(arm.model.home), rest)[2])) < 1e-13


def test_terms_are_read_only_copies(robot):
    """Terms that were handed out can neither be changed nor change when the robot is evaluated again."""
    arm = robot("wam4")
    first = arm.terms([0.1, 1.0, 0.2, 1.5], np.ones(4))
    kept = {name: getattr(first, name).copy() for name in ("mass_matrix", "bias", "position", "jacobian", "drift")}
    arm.terms([0.5, 0.4, 0.3, 0.2], -np.ones(4))
    for name, value in kept.items():
        array = getattr(first, name)
        assert np.array_equal(array, value)
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.mark.parametrize(
    ("q", "v", "words"),
    [
        ([1.0, 2.0], [0.0] * 4, ["q has shape (2,)", "wam4 has 4 joints"]),
        ([0.0] * 4, [0.0] * 5, ["v has shape (5,)"]),
        ([0.0, np.nan, 0.0, 0.0], [0.0] * 4, ["q = ", "nan", "finite"]),
        ([0.0] * 4, [0.0, np.inf, 0.0, 0.0], ["v = ", "inf", "finite"]),
    ],
)
def test_bad_states_are_refused(q, v, words, robot):
    """A state of the wrong length or with NaN in it is refused by name; Pinocchio would let it pass."""
    with pytest.raises(ValueError, match=r"has shape|must be finite") as caught:
        robot("wam4").terms(q, v)
    assert all(word in str(caught.value) for word in words)


def test_tip_must_be_a_frame_of_the_robot():
    """A tip that the robot lacks is refused with the nearest frames."""
    with pytest.raises(cl.ModelError, match=r"wam4 has no frame 'tipp'.*'tip'"):
        cl.Robot(robot_models.load("wam4"), "tipp")


def test_a_single_joint_is_a_robot_too():
    """An arm of one joint keeps its shapes, though Pinocchio hands out its Jacobian as a vector, and it can slide.

    A prismatic joint along x presses on a wall with normal −x: H q̈ = Q − C − f, so f is what the law presses with.
    """
    text = robot_models.load("pointmass3").text
    model = robot_models.from_text(
        text, "urdf", name="slider", armature=[0.0], tip="tip", home=[0.0], locked={"Y": 0.0, "Z": 0.0}
    )  # fmt: skip
    terms = cl.Robot(model).terms([0.1], [0.2])
    assert terms.mass_matrix.shape == (1, 1)
    assert terms.jacobian.tolist() == [[1.0], [0.0], [0.0]]
    changes = {"surface.normal": [-1, 0, 0], "surface.offset": "start", "reference.kind": "hold", "start.q": [0.1]}
    changes |= {"start.v": [0.0], "law.kp": 1.0, "law.kd": 1.0, "law.force": 7.0, "time.duration": 0.01}
    run = cl.simulate(cl.load_scenario("planar2_slide", changes), model=model)
    assert run.contact_force == pytest.approx(np.full(11, 7.0), abs=1e-12)
