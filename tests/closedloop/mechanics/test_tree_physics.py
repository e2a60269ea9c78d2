"""What holds of the tree's terms whatever any engine computes: derivatives, energy, definiteness, branches."""

from dataclasses import replace

import numpy as np
import pytest
from tree_cases import FIELDS, Own, close, random_model

import robot_models
from closedloop.mechanics.robot.tree import tree_potential_energy


@pytest.mark.parametrize("seed", range(3))
def test_jacobian_and_drift_are_derivatives(seed):
    """J q̇ is the derivative of r along q(t) = q + v t, and drift that of J q̇.

    Central differences of step 1e-5 on functions of order one to ten: truncation and rounding below 1e-8.
    """
    model, _, rng = random_model(seed, joints=6)
    own, h = Own(model, model.tip), 1e-5
    for _ in range(5):
        q, v = rng.uniform(-3.0, 3.0, 6), rng.normal(size=6)
        back, ahead, here = own.terms(q - h * v, v), own.terms(q + h * v, v), own.terms(q, v)
        assert np.max(np.abs((ahead.position - back.position) / (2 * h) - here.jacobian @ v)) < 1e-8
        assert np.max(np.abs((ahead.jacobian - back.jacobian) @ v / (2 * h) - here.drift)) < 1e-8


@pytest.mark.parametrize("seed", range(3))
def test_bias_is_the_change_of_kinetic_energy_and_the_gradient_of_potential_energy(seed):
    """At rest C = ∂U/∂q; in motion q̇·(C(q, q̇) − C(q, 0)) = ½ q̇ᵀḢq̇, which Coriolis terms alone could not break."""
    model, tip, rng = random_model(seed, joints=5)
    own, h = Own(model, tip), 1e-5
    for _ in range(5):
        q, v = rng.uniform(-3.0, 3.0, 5), rng.normal(size=5)
        gravity = own.terms(q, np.zeros(5)).bias
        gradient = [
            np.diff([tree_potential_energy(own.tree, q + x * e, own.work) for x in (-h, h)])[0] / (2 * h)
            for e in np.eye(5)
        ]
        assert close(gravity, gradient, 1e-8)
        change = (own.terms(q + h * v, v).mass_matrix - own.terms(q - h * v, v).mass_matrix) / (2 * h)
        assert v @ (own.terms(q, v).bias - gravity) == pytest.approx(v @ change @ v / 2, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("seed", range(6))
def test_mass_matrix_is_positive_definite(seed):
    """H has positive eigenvalues without any armature."""
    model, tip, rng = random_model(seed, drive_inertia=False)
    own = Own(model, tip)
    for _ in range(5):
        H = own.terms(rng.uniform(-3.0, 3.0, model.n), np.zeros(model.n)).mass_matrix
        assert np.min(np.linalg.eigvalsh(H)) > 0.0


def test_armature_adds_to_the_diagonal_alone():
    """Drive inertia adds to the diagonal of H, and to nothing else."""
    q, v = np.array([0.3, 0.8, -0.2, 1.5]), np.array([0.4, -0.3, 0.2, 0.1])
    model = robot_models.load("wam4")
    ours = Own(model, "tip").terms(q, v)
    bare = Own(robot_models.load("wam4", drive_inertia=False), "tip").terms(q, v)
    assert close(ours.mass_matrix - bare.mass_matrix, np.diag(model.armature))
    for field in FIELDS[1:]:
        assert np.array_equal(getattr(ours, field), getattr(bare, field))


def test_joints_of_different_branches_have_nothing_in_common(robot, random_states):
    """On solo12 H is exactly zero between legs, and J off the leg that carries the tip; whatever was there before."""
    arm = robot("solo12", "HR_FOOT")
    terms = Own(arm.model, arm.tip).terms(random_states(arm, 1, 1)[0].q, np.ones(12))
    same_leg = np.kron(np.eye(4), np.ones((3, 3)))
    assert np.array_equal(terms.mass_matrix != 0.0, same_leg * (terms.mass_matrix != 0.0) != 0.0)
    assert np.count_nonzero(terms.mass_matrix) > 12
    assert np.array_equal(np.any(terms.jacobian != 0.0, axis=0), arm.support != 0.0)


def test_gravity_is_the_models():
    """Without gravity there is no bias at rest and no potential energy."""
    model = replace(robot_models.load("wam4"), gravity=np.zeros(3))
    own = Own(model, "tip")
    assert not np.any(own.terms(model.home, np.zeros(4)).bias)
    assert tree_potential_energy(own.tree, np.array(model.home), own.work) == 0.0
