"""The ground truth is judged by itself: fifty digits that satisfy the equations they come from."""

import time

import numpy as np
import pytest

import robot_models
from robot_models.planar2 import closed_form
from validation.engines import CannotBuild
from validation.engines.loop import ClosedLoop
from validation.states import random_robot

sympy = pytest.importorskip("sympy", reason='pip install "sympy>=1.13" "mpmath>=1.3"')
mpmath = pytest.importorskip("mpmath", reason='pip install "sympy>=1.13" "mpmath>=1.3"')

from validation.engines.symbolic import (  # noqa: E402
    BITS,
    Symbolic,
)

Q, V, TORQUE = np.array([[0.3, 0.7, -0.4], [1.0, -0.5, 0.4], [3.0, 2.0, -1.0]])


@pytest.fixture(scope="module")
def arm():
    """Return the truth of a spatial arm of three joints with random axes, offsets, tensors and gravity."""
    robot = random_robot(3, joints=3, branching=False)
    return Symbolic(robot, robot.tip)


def test_is_derived_in_no_time():
    """Polynomials take a third of a second of this process; expressions that are not gathered take minutes."""
    robot = random_robot(11, joints=3, branching=False, kinds=("revolute",))
    began = time.process_time()
    Symbolic(robot, robot.tip)
    assert time.process_time() - began < 10.0


def test_mass_matrix_and_bias_belong_together(arm):
    """C follows from H and U: against differences of step 1e-20, which fifty digits can bear."""
    with mpmath.workprec(BITS):
        h, q = mpmath.mpf(10) ** -20, [mpmath.mpf(float(x)) for x in Q]

        def along(k, name, step):
            return arm.exact(name, np.array([x + step * (i == k) for i, x in enumerate(q)], dtype=object))

        slopes = [(along(k, "mass_matrix", h) - along(k, "mass_matrix", -h)) / (2 * h) for k in range(3)]
        v = mpmath.matrix(V.tolist())
        gravity = arm.exact("bias", Q, np.zeros(3))
        rate = sum((slopes[k] * v[k] for k in range(3)), mpmath.zeros(3))
        wanted = rate * v - mpmath.matrix([(v.T * slope * v)[0] / 2 for slope in slopes]) + gravity
        assert mpmath.norm(arm.exact("bias", Q, V) - wanted) < mpmath.mpf(10) ** -35
        J = arm.exact("jacobian", Q)
        for k in range(3):
            column = (along(k, "position", h) - along(k, "position", -h)) / (2 * h)
            assert mpmath.norm(J[:, k] - column) < mpmath.mpf(10) ** -35
        turning = [(along(k, "jacobian", h) - along(k, "jacobian", -h)) / (2 * h) for k in range(3)]
        drift = sum((turning[k] * v * v[k] for k in range(3)), mpmath.zeros(3, 1))
        assert mpmath.norm(arm.exact("drift", Q, V) - drift) < mpmath.mpf(10) ** -35


def test_solution_satisfies_equation_24_in_fifty_digits(arm):
    """H q̈ + C = Q + Aᵀ f and A q̈ = b, and the impact likewise."""
    n, b = np.array([0.0, 0.6, 0.8]), 0.25
    with mpmath.workprec(BITS):
        H, C, J = arm.exact("mass_matrix", Q), arm.exact("bias", Q, V), arm.exact("jacobian", Q)
        A = mpmath.matrix(n.tolist()).T * J
        a, f = arm.exact("constrained", Q, V, TORQUE, n, b)
        assert mpmath.norm(H * a + C - mpmath.matrix(TORQUE.tolist()) - A.T * f) < mpmath.mpf(10) ** -50
        assert abs((A * a)[0] - b) < mpmath.mpf(10) ** -50
        after, p = arm.exact("impulse", Q, V, n, 0.5)
        v = mpmath.matrix(V.tolist())
        assert mpmath.norm(H * (after - v) - A.T * p) < mpmath.mpf(10) ** -50
        assert abs((A * after)[0] + (A * v)[0] / 2) < mpmath.mpf(10) ** -50


def test_closed_form_of_the_planar_arm():
    """The textbook's equations of the two-link arm, written without any of this."""
    planar = robot_models.load("planar2")
    truth, q, v = Symbolic(planar, "tip"), np.array([0.6, -1.4]), np.array([0.7, -1.1])
    wanted = closed_form.terms(q, v)
    for name, arguments in {"mass_matrix": (q,), "bias": (q, v), "jacobian": (q,), "drift": (q, v)}.items():
        np.testing.assert_allclose(getattr(truth, name)(*arguments), getattr(wanted, name), rtol=2e-15, atol=1e-17)


def test_bounds_everyones_rounding():
    """The simulator's own f is within its rounding of the truth, not only of another engine in doubles."""
    wam = robot_models.load("wam4")
    truth, loop, rng = Symbolic(wam, "tip"), ClosedLoop(wam, "tip"), np.random.default_rng(0)
    for _ in range(5):
        q, v, torque = rng.uniform(-1, 1, (3, 4))
        a, f = truth.constrained(q, v, torque, np.array([0.0, 0.0, 1.0]), 0.0)
        mine, g = loop.constrained(q, v, torque, np.array([0.0, 0.0, 1.0]), 0.0)
        size = np.abs(a).max() + abs(f)
        np.testing.assert_allclose(mine, a, atol=1e-12 * size)
        assert g == pytest.approx(f, abs=1e-12 * size)


def test_reads_doubles_as_doubles():
    """The truth counts the double nearest to the decimal text, as every engine does: one ulp would be seen."""
    planar = robot_models.load("planar2")
    with mpmath.workprec(BITS):
        r = Symbolic(planar, "tip").exact("position", np.zeros(2))
        assert r[0] == mpmath.mpf(0.4) + mpmath.mpf(0.3)


def test_refuses_what_would_take_long_or_be_wrong():
    """Many joints and locked ones are refused by name."""
    ur5, panda = robot_models.load("ur5"), robot_models.load("panda")
    with pytest.raises(CannotBuild, match="6 joints"):
        Symbolic(ur5, ur5.tip)
    with pytest.raises(CannotBuild, match="7 joints"):
        Symbolic(panda, panda.tip)
