"""The paper's loop by hand: what must be true of every slide, and the behaviour that the paper describes."""

import numpy as np
import pytest

import robot_models
from validation.oracle import Law, Oracle, simulate_slide
from validation.oracle.engine import Closure

N, STEP = np.array([0.0, 0.0, 1.0]), 0.001
START = np.array([np.pi / 2, 1.0, 0.0, 2.0])
GAINS = {"kp": np.array([900.0, 900.0, 400.0, 300.0]), "kd": np.array([60.0, 60.0, 30.0, 20.0])}


@pytest.fixture(scope="module")
def wam():
    """Return the arm of the paper."""
    return Oracle.from_model(robot_models.load("wam4"))


def slide(arm, *, rows=801, start=0.1, stop=0.5, speed=0.018, **options):
    """Slide along y from `start` to `stop`, the reference by integrating least-norm rates of a line."""
    q_des, v_des = np.zeros((rows, 4)), np.zeros((rows, 4))
    q = START.copy()
    for k in range(rows):
        q_des[k] = q
        if start <= k * STEP < stop:
            v_des[k] = np.linalg.pinv(arm.jacobian(q)) @ [0.0, speed, 0.0]
            q = q + STEP * np.linalg.pinv(arm.jacobian(q + STEP * v_des[k] / 2)) @ [0.0, speed, 0.0]
    law = options.pop("law", Law(**GAINS, force=10.0, start=start))
    closure = Closure(**{"stabiliser": (0.707, STEP), "normal": N} | options)
    return simulate_slide(arm, q=START, v=np.zeros(4), q_des=q_des, v_des=v_des, step=STEP, law=law, closure=closure)


@pytest.fixture(scope="module")
def run(wam):
    """Return 0.8 s of the paper's slide."""
    return slide(wam)


def test_rests_under_the_wanted_force(run):
    """Until the motion starts the arm stands still and is pressed by exactly what the law asks for."""
    before = run.time < 0.1
    np.testing.assert_allclose(run.contact_force[before], 10.0, rtol=1e-13)
    np.testing.assert_allclose(run.q[before], np.broadcast_to(START, (100, 4)), atol=1e-13)


def test_motion_disturbs_the_force_and_the_force_recovers(run):
    """The steps of the reference's rate make the force dip at the start and overshoot at the stop."""
    f = run.contact_force
    assert 8.0 < f[100] == f.min() < 9.5
    assert 11.0 < f[500] == f.max() < 13.0
    assert abs(f[499] - 10.0) < 0.05
    assert abs(f[-1] - 10.0) < 0.05
    assert np.abs(run.closure_error).max() < 1e-9
    assert abs(run.position[-1, 1] - run.position[0, 1] - 0.018 * 0.4) < 1e-3


def test_drifts_without_the_stabiliser(wam, run):
    """Solving ë = 0 alone leaves the plane by what the integrator truncates; the stabiliser does not."""
    free = slide(wam, stabiliser=None)
    assert np.abs(free.closure_error).max() > 50 * np.abs(run.closure_error).max()
    assert np.abs(free.closure_error).max() < 1e-5


def test_rows_belong_together(wam, run):
    """Each row satisfies the equations of motion and the law at its own state, and leads to the next row."""
    np.testing.assert_allclose(run.v[1:], run.v[:-1] + STEP * run.acceleration[:-1], atol=1e-16)
    np.testing.assert_allclose(run.q[1:], run.q[:-1] + STEP * run.v[1:], atol=1e-16)
    for k in (0, 99, 100, 150, 800):
        q, v, f = run.q[k], run.v[k], run.contact_force[k]
        needed = wam.pushed_inverse_dynamics(q, v, run.acceleration[k], f * N)
        np.testing.assert_allclose(run.torque[k], needed, atol=1e-11)
        assert run.closure_rate[k] == pytest.approx(N @ wam.jacobian(q) @ v, abs=1e-15)
        np.testing.assert_array_equal(run.position[k], wam.position(q))


def test_other_force_other_press(wam):
    """At rest the force is the one that is asked for, whatever it is and whatever the step."""
    law = Law(**GAINS, force=25.0, start=1.0)
    np.testing.assert_allclose(slide(wam, rows=20, law=law).contact_force, 25.0, rtol=1e-13)


def test_normal_must_have_length_one(wam):
    """A normal of another length would scale the force in silence."""
    with pytest.raises(ValueError, match="length one"):
        slide(wam, rows=1, normal=2 * N)
