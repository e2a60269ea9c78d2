"""Closures: the rows of a loop joint are the derivatives of its error, and its forces have the right sign."""

import numpy as np
import pytest

from validation.oracle import Oracle, closure, kinematics
from validation.oracle.closure import point_fixed, point_on_line, point_on_plane, weld
from validation.states import random_robot, random_state

ROUNDING = 1e-12  # sums and products over a dozen joints; derivatives by complex step add nothing


def draw(seed, **options):
    """Return an oracle and a random state."""
    robot = random_robot(seed, **options)
    oracle = Oracle(robot.tree, robot.tip)
    return oracle, *random_state(robot, np.random.default_rng(seed)), np.random.default_rng(seed + 1)


def loop_joint(kind, oracle, q, rng, base):
    """Return a loop joint that is closed at q."""
    pose = oracle.pose(q)
    r, axes = oracle.position(q), kinematics.tip_rotation(oracle.tree, pose, "tip")
    if base is not None:
        turned = kinematics.tip_rotation(oracle.tree, pose, base)
        r, axes = turned.T @ (r - kinematics.tip_position(oracle.tree, pose, base)), turned.T @ axes
    normal = rng.normal(size=3)
    return {
        "plane": lambda: point_on_plane("tip", normal, normal @ r / np.linalg.norm(normal), base),
        "line": lambda: point_on_line("tip", r, normal, base),
        "point": lambda: point_fixed("tip", r, base),
        "weld": lambda: weld("tip", r, axes, base),
    }[kind]()


SIZES = {"plane": 1, "line": 2, "point": 3, "weld": 6}


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("base", [None, "link0"])
@pytest.mark.parametrize("kind", SIZES)
def test_rows_are_derivatives_of_the_error(kind, base, seed):
    """A q̇ = ė and A q̈ + drift = ë, for every loop joint, closed on the ground and on another moving link."""
    oracle, q, v, rng = draw(seed, joints=5)
    joint = loop_joint(kind, oracle, q, rng, base)
    rows = closure.loop_rows(oracle.tree, oracle.pose(q), v, joint)
    assert rows.A.shape == (SIZES[kind], 5) == (joint.size, 5)
    np.testing.assert_allclose(rows.error, 0.0, atol=1e-14)
    a, step = rng.normal(size=5), 1e-40

    def at(t):
        pose = oracle.pose(q + t * v + t * t * a / 2)
        return closure.loop_rows(oracle.tree, pose, v + t * a, joint)

    scale = max(1.0, np.abs(rows.drift).max(), np.abs(rows.A).max())
    moved = at(step * 1j)
    np.testing.assert_allclose(moved.error.imag / step, rows.rate, atol=ROUNDING * scale)
    np.testing.assert_allclose(moved.rate.imag / step, rows.A @ a + rows.drift, atol=ROUNDING * scale)


@pytest.mark.parametrize("seed", range(6))
def test_free_motion_does_no_work_on_the_closure(seed):
    """Whatever the force R f across the loop joint, motions that the joint allows take no power from it."""
    oracle, q, v, rng = draw(seed, joints=8)
    joint = loop_joint("line", oracle, q, rng, None)
    rows = closure.loop_rows(oracle.tree, oracle.pose(q), v, joint)
    allowed = v - np.linalg.pinv(rows.A) @ rows.rate
    r = oracle.position(q)
    R = closure.constraint_matrix(joint.normals, r)
    f = rng.normal(size=2)
    torque = closure.closure_torque(R, oracle.spatial_jacobian(q), f)
    np.testing.assert_allclose(torque, rows.A.T @ f, atol=ROUNDING)
    assert abs(torque @ allowed) < ROUNDING * np.abs(torque).max() * max(1.0, np.abs(allowed).max())


def test_general_rows_reduce_to_the_plane():
    """Rᵀ J = nᵀ Jᵣ (Eq. 8 and Eq. 13) and Rᵀ J̇q̇ + Ṙᵀ J q̇ = nᵀ J̇ᵣq̇ (Eq. 18)."""
    oracle, q, v, _ = draw(2, joints=6)
    n, pose, r = np.array([0.0, 0.6, 0.8]), oracle.pose(q), oracle.position(q)
    J = oracle.spatial_jacobian(q)
    R = closure.constraint_matrix(n[None], r)
    np.testing.assert_allclose(R.T @ J, n[None] @ oracle.jacobian(q), atol=ROUNDING)
    R_dot = closure.constraint_matrix_rate(n[None], r, kinematics.point_velocity(J @ v, r), np.zeros(3))
    body = oracle.tree.frame("tip").body
    drift = R.T @ kinematics.spatial_drift(oracle.tree, pose, v, body) + R_dot.T @ (J @ v)
    np.testing.assert_allclose(drift, n @ oracle.drift(q, v), atol=ROUNDING)


def test_a_pressed_arm_is_pushed_back():
    """A torque that presses the tip into the surface, Jᵣᵀ n (−10), is answered by f = +10 along +n."""
    oracle, q, v, _ = draw(4, joints=6)
    n, v = np.array([0.0, 0.0, 1.0]), 0.0 * v
    A, C = n @ oracle.jacobian(q), oracle.bias(q, v)
    a, f = closure.solve_bordered(oracle.mass_matrix(q), C + A * -10.0 - C, A, 0.0)
    assert f[0] == pytest.approx(10.0, rel=ROUNDING)
    np.testing.assert_allclose(a, 0.0, atol=1e-10)


def test_an_approaching_tip_is_thrown_back():
    """An impact with ė < 0 has p > 0 along +n; it stops ė at ε = 0, and reverses ė and keeps T at ε = 1."""
    oracle, q, v, _ = draw(5, joints=6)
    n = np.array([0.0, 0.0, 1.0])
    H, A = oracle.mass_matrix(q), n @ oracle.jacobian(q)
    v = v * -np.sign(A @ v)
    plastic, p = closure.impulse(H, v, A)
    assert p[0] > 0.0
    assert A @ plastic == pytest.approx(0.0, abs=ROUNDING)
    elastic, twice = closure.impulse(H, v, A, 1.0)
    assert twice[0] == pytest.approx(2.0 * p[0], rel=ROUNDING)
    assert A @ elastic == pytest.approx(-(A @ v), rel=ROUNDING)
    assert oracle.kinetic_energy(q, elastic) == pytest.approx(oracle.kinetic_energy(q, v), rel=ROUNDING)


def test_stabilised_closure_obeys_its_equation():
    """With b_s of Eq. 23, ë + s_v ė + s_p e = 0 whatever e and ė are."""
    oracle, q, v, rng = draw(6, joints=6)
    n, d = np.array([0.0, 0.0, 1.0]), 0.3
    terms, gains = oracle.terms(q, v), closure.stabiliser_gains(0.707, 0.01)
    assert gains == (pytest.approx(141.4), pytest.approx(1e4))
    e = closure.closure_error(n, d, terms.position)
    rate = closure.closure_rate(n, terms.jacobian, v)
    b = closure.stabilised_drift(n @ terms.drift, e, rate, gains)
    a, _ = closure.solve_bordered(terms.mass_matrix, rng.normal(size=6), n @ terms.jacobian, b)
    second = closure.closure_acceleration(n, terms.jacobian, terms.drift, a)
    assert second + gains[0] * rate + gains[1] * e == pytest.approx(0.0, abs=ROUNDING * gains[1])


def test_directions_without_length_are_refused():
    """A normal or a line needs a direction."""
    with pytest.raises(ValueError, match="no direction"):
        point_on_plane("tip", np.zeros(3), 0.0)
