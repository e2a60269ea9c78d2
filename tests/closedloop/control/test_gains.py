"""Gains that a step cannot carry: the bound is the closed form's, and runs go wrong where it says."""

import math

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.mechanics.closure.baumgarte import amplification, linear_step
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.scenario.modes import GROWING, Feedback, feedbacks, gains_fault, growth

H = 0.001
# Where 1 + z + z²/2 + z³/6 + z⁴/24 is 1 again, z < 0: the limit of RK4 on the real axis.
RK4_REAL = 2.785293563405282


def damper(rate, stiffness=0.0):
    """Return the feedback of a damper (and a spring) on one mass."""
    return Feedback("spring", "damper", np.array([[stiffness]]), np.array([[rate]]))


def fault(name, changes):
    """Return what is said of the gains of a scenario."""
    scenario = cl.load_scenario(name, changes)
    return gains_fault(scenario, cl.Robot(robot_models.load(scenario.robot.model), scenario.robot.tip))


@pytest.mark.parametrize(
    ("integrator", "hold", "most"),
    [
        ("semi_implicit_euler", 0, 2.0),
        ("explicit_euler", 0, 2.0),
        ("rk4", 0, RK4_REAL),
        ("rk4", 1, 2.0),
        ("semi_implicit_euler", 3, 2.0),
        ("dop853", 2, 2.0),
    ],
)
def test_most_that_a_step_damps(integrator, hold, most):
    """A damper alone is carried up to D h = 2, with RK4 to 2.785, and held over a sample to D T = 2."""
    rate = most / (H * max(hold, 1))
    assert growth(damper(0.999 * rate), integrator, H, hold) <= GROWING
    assert growth(damper(1.001 * rate), integrator, H, hold) > GROWING


def test_semi_implicit_carries_a_spring_and_a_damper_up_to_their_sum():
    """z² − (2 − c − k) z + 1 − c has its roots within the circle while 2 c + k < 4, c = D h, k = K h²."""
    for c in (0.0, 0.5, 1.5):
        k = 4.0 - 2.0 * c
        assert growth(damper(c / H, 0.999 * k / H**2), "semi_implicit_euler", H) <= GROWING
        assert growth(damper(c / H, 1.001 * k / H**2), "semi_implicit_euler", H) > GROWING


def test_a_step_of_its_own_choice_carries_anything():
    """An integrator that chooses its steps takes those that the gains ask for, unless the torque is held."""
    assert growth(damper(1e9), "dop853", H) == 1.0
    assert growth(damper(1e9), "dop853", H, 1) > 1.0


@pytest.mark.parametrize("name", INTEGRATORS)
def test_step_of_several_is_that_of_each(name):
    """The map of two decoupled directions has the eigenvalues of the stabiliser's two maps, which are of one each."""
    first, second = amplification(name, 0.7, 0.5), amplification(name, 0.2, 0.3)
    K, D = np.diag([0.25, 0.09]), np.diag([0.7, 0.12])
    both = linear_step(INTEGRATORS[name], np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -D]]))
    apart = np.concatenate([np.linalg.eigvals(first), np.linalg.eigvals(second)])
    assert np.sort_complex(np.linalg.eigvals(both)) == pytest.approx(np.sort_complex(apart), abs=1e-12)


UR5 = {
    "robot.model": "ur5", "robot.tip": "tool0", "start.v": None, "start.q": [0, -1.2, 1.6, -1.9, -1.57, 0],
    "law.kp": 100.0, "time.duration": 1.0,
}  # fmt: skip


@pytest.mark.parametrize(("share", "wrong"), [(0.5, []), (0.98, ["resolution"]), (1.05, ["gains"])])
def test_runs_go_wrong_where_the_bound_says(share, wrong):
    """A ur5 whose damper is half of what its step carries runs well; just below, its wrist rings; above, shakes loose.

    Just below, a step makes −0.96 of a decay to 0.14: the run ends, and is no good run.
    """
    scenario = cl.load_scenario("wam_slide", UR5 | {"law.kd": 30.0})
    (feedback,) = feedbacks(scenario, cl.Robot(robot_models.load("ur5"), "tool0"))
    kd = 30.0 * 2.0 / (H * np.max(np.linalg.eigvals(feedback.damping).real))
    changes = UR5 | {"law.kd": share * float(kd)}
    said = fault("wam_slide", changes)
    try:
        verdict = cl.simulate(cl.load_scenario("wam_slide", changes)).summary()["verdict"]
    except cl.DivergenceError as stopped:
        verdict = stopped.run.summary()["verdict"]
    assert [problem["name"] for problem in verdict["problems"]][: len(wrong) or None] == wrong
    assert (said != "") == (wrong == ["gains"])
    if said:
        assert verdict["problems"][0] == {"name": "gains", "at": None, "text": said}
        assert said.startswith("law.kd[5] (joint wrist_3_joint) times time.step is 2.1 times the inertia")


def test_the_step_that_is_named_would_do():
    """The line ends with a step that carries the gains, and one a tenth longer does not."""
    gains = {"law.kd": [60.0, 60.0, 30.0, 380.0], "stabiliser.time_constant": "auto", "time.duration": 8.0}
    step = float(fault("wam_slide", gains).split("take time.step below ")[1].removesuffix(" s"))
    for share, clean in ((1.0, True), (1.1, False)):
        near = 8.0 / round(8.0 / (share * step))
        assert (fault("wam_slide", gains | {"time.step": near}) == "") == clean


@pytest.mark.parametrize(
    ("name", "changes", "key"),
    [
        ("wam_slide", {"law.kd": [60.0, 60.0, 30.0, 380.0]}, r"law.kd[3] (joint J4) times time.step"),
        ("wam_slide", {"law.kp": [900.0, 900.0, 400.0, 1e6]}, "law.kp times the square of time.step"),
        ("wam_slide", {"law.sample_period": 0.01}, "law.kd[2] (joint J3) times law.sample_period"),
        ("wam_slide", {"law.kd": 1e12}, "law.kd[2] (joint J3) times time.step is 1.16e+10 times the inertia"),
        ("joint_friction", {"law.kd": 300.0}, "law.kd["),
        ("wam_hybrid_friction", {"law.damping": 1e4}, "law.damping times law.sample_period"),
        ("panda_wipe", {"law.motion_damping": 2500.0}, "law.motion_damping times law.sample_period is 2.5, where 2 is"),
        ("panda_wipe", {"law.posture_damping": 2500.0}, "law.posture_damping times law.sample_period"),
        (
            "wam_edge",
            {"law": {"kind": "hybrid", "kp": 1.0, "kd": 1.0, "approach_damping": RK4_REAL / H + 1.0}},
            "law.approach_damp",
        ),
        ("wam_edge", {"law": {"kind": "impedance", "normal_damping": 1e5}}, "law.normal_damping times time.step"),
    ],
)
def test_every_gain_is_named_by_its_key(name, changes, key):
    """Of each law, the gain that the step cannot carry."""
    assert fault(name, changes).startswith(key)


def test_gains_beyond_all_floats_are_no_arithmetic():
    """What a gain makes of a tiny inertia may be infinite: one line, no warning of numpy's or word of LAPACK's."""
    scenario = cl.load_scenario("wam_slide")
    heavy = scenario.model_copy(update={"law": scenario.law.model_copy(update={"kd": 1.7e308})})  # beyond the bounds
    line = gains_fault(heavy, cl.Robot(robot_models.load("wam4"), "tip"))
    assert line == "law.kp or law.kd is too large for any step"


@pytest.mark.parametrize("name", cl.shipped_scenarios())
def test_shipped_gains_are_carried(name):
    """No shipped scenario is warned of, nor with steps of 2 ms."""
    assert fault(name, {}) == fault(name, {"time.step": 0.002, "stabiliser": {"kind": "none"}}) == ""


def test_what_the_step_is_not_to_blame_for():
    """Negative gains drive an arm away at any step; gains that never act, and a singular inertia, are not judged."""
    assert fault("wam_slide", {"law.kd": -300.0}) == ""
    assert fault("wam_slide", {"law.kp": -1e7, "law.kd": 0.0}) == ""
    assert fault("wam_slide", {"law.kd": 300.0, "law.pd_start": 9.0}) == ""
    assert fault("wam_slide", {"law.kd": 300.0}) != ""


def test_a_tip_that_may_leave_is_judged_free():
    """Where the surface cannot hold the tip, the arm moves along the normal too, with less inertia."""
    scenario = cl.load_scenario("planar2_slide", {"law.kd": 10.0})
    robot = cl.Robot(robot_models.load("planar2"), "tip")
    (held,) = feedbacks(scenario, robot)
    (free,) = feedbacks(cl.load_scenario("planar2_slide", {"law.kd": 10.0, "surface.contact": "unilateral"}), robot)
    rates = [np.sort(np.linalg.eigvals(x.damping).real) for x in (held, free)]
    assert rates[0][0] == pytest.approx(0.0, abs=1e-12 * rates[0][1])  # nothing moves along the normal
    assert rates[0][1] < rates[1][1]
    assert math.prod(rates[1]) > 0.0
