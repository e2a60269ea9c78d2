"""The identities hold for the oracle and for Pinocchio, and each fails when a flaw is planted."""

import numpy as np
import pytest
from budget import seeds
from pinocchio_reference import PinocchioEngine

import robot_models
from validation.identities import IDENTITIES, Residual, check_all, draw_sample, unanswered
from validation.oracle import Oracle
from validation.states import random_robot, random_state

FLAW = 1e-6  # relative; far below what a plot would show, four decades above the loosest tolerance


class Flawed:
    """An engine with one method spoilt."""

    def __init__(self, engine, method, spoil):
        self.engine, self.method, self.spoil = engine, method, spoil

    def __getattr__(self, name):
        """Pass everything on but the spoilt method."""
        found = getattr(self.engine, name)
        return (lambda *args: self.spoil(found(*args))) if name == self.method else found


class ByDifferences:
    """An engine that cannot take complex numbers."""

    complex_step = False

    def __init__(self, engine):
        self.engine = engine

    def __getattr__(self, name):
        """Pass everything on."""
        return getattr(self.engine, name)


def skewed(result):
    """Return a result with every entry off by its own small factor."""
    result = np.asarray(result)
    return result * (1.0 + FLAW * np.linspace(1.0, 2.0, result.size).reshape(result.shape))


def not_definite(H):
    """Return H without its smallest eigenvalue."""
    values, vectors = np.linalg.eigh(H)
    return H - 1.0001 * values[0] * np.outer(vectors[:, 0], vectors[:, 0])


# What each identity must notice. The methods that it uses and that are not listed cannot be judged by it: an
# impact or a press is consistent with whatever Jacobian or drift it was computed from.
FLAWS = [
    ("symmetric", "mass_matrix", skewed),
    ("positive_definite", "mass_matrix", not_definite),
    ("kinetic_energy_is_quadratic", "mass_matrix", skewed),
    ("kinetic_energy_is_quadratic", "kinetic_energy", skewed),
    ("inverse_undoes_forward", "forward_dynamics", skewed),
    ("inverse_undoes_forward", "inverse_dynamics", skewed),
    ("inverse_dynamics_is_affine", "mass_matrix", skewed),
    ("inverse_dynamics_is_affine", "bias", skewed),
    ("inverse_dynamics_is_affine", "inverse_dynamics", skewed),
    ("gravity_is_gradient", "gravity_term", skewed),
    ("gravity_is_gradient", "potential_energy", skewed),
    ("bias_follows_from_mass_matrix", "mass_matrix", skewed),
    ("bias_follows_from_mass_matrix", "bias", skewed),
    ("bias_follows_from_mass_matrix", "gravity_term", skewed),
    ("coriolis_matrix_is_skew", "mass_matrix", skewed),
    ("coriolis_matrix_is_skew", "coriolis_matrix", skewed),
    ("coriolis_matrix_gives_bias", "coriolis_matrix", skewed),
    ("coriolis_matrix_gives_bias", "bias", skewed),
    ("coriolis_matrix_gives_bias", "gravity_term", skewed),
    ("jacobian_is_derivative", "position", skewed),
    ("jacobian_is_derivative", "jacobian", skewed),
    ("drift_is_derivative", "jacobian", skewed),
    ("drift_is_derivative", "drift", skewed),
    ("power_balance", "mass_matrix", skewed),
    ("power_balance", "bias", skewed),
    ("power_balance", "gravity_term", skewed),
    ("power_balance", "position", skewed),
    ("power_balance", "jacobian", skewed),
    ("closure_does_no_work", "mass_matrix", skewed),
    ("closure_does_no_work", "bias", skewed),
    ("closure_does_no_work", "gravity_term", skewed),
    ("closure_does_no_work", "position", skewed),
    ("closure_does_no_work", "jacobian", skewed),
    ("closure_holds", "jacobian", skewed),
    ("closure_holds", "drift", skewed),
    ("force_can_be_applied", "mass_matrix", skewed),
    ("force_can_be_applied", "bias", skewed),
    ("force_can_be_applied", "jacobian", skewed),
    ("force_can_be_applied", "pushed_inverse_dynamics", skewed),
    ("impulse_momentum", "mass_matrix", skewed),
    ("impulse_momentum", "kinetic_energy", skewed),
]


def draw(seed, **options):
    """Return a random robot and a sample of it."""
    robot = random_robot(seed, **options)
    rng = np.random.default_rng(seed)
    return robot, draw_sample(*random_state(robot, rng), rng)


def failed(engine, sample):
    """Return the residuals of the identities that do not hold."""
    return {name: residual for name, residual in check_all(engine, sample).items() if not residual.passed}


@pytest.mark.parametrize("seed", seeds(16, 60))
def test_oracle(seed):
    """All identities hold for the oracle on a random robot."""
    robot, sample = draw(seed)
    oracle = Oracle.from_model(robot)
    assert not unanswered(oracle)
    assert not failed(oracle, sample)


@pytest.mark.parametrize("name", ["planar2", "wam4", "panda", "ur5", "kinova"])
def test_oracle_on_a_real_robot(name):
    """All identities hold on a robot that people use, drives included."""
    robot = robot_models.load(name)
    oracle = Oracle.from_model(robot)
    low, high = np.maximum(robot.position_lower, -np.pi), np.minimum(robot.position_upper, np.pi)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        sample = draw_sample(rng.uniform(low, high), rng.normal(size=len(low)), rng)
        assert not failed(oracle, sample)


@pytest.mark.parametrize("seed", seeds(5, 20))
def test_oracle_by_differences(seed):
    """They hold by differences too, within the looser tolerance."""
    robot, sample = draw(seed)
    assert not failed(ByDifferences(Oracle.from_model(robot)), sample)


@pytest.mark.parametrize("seed", seeds(8, 20))
def test_pinocchio(seed):
    """They hold for Pinocchio, on robots without drive inertia, whose kinetic energy it gets right."""
    robot, sample = draw(seed, drive_inertia=False)
    engine = PinocchioEngine(robot, robot.tip)
    assert not unanswered(engine)
    assert not failed(engine, sample)


@pytest.mark.parametrize("complex_step", [True, False], ids=["complex", "differences"])
@pytest.mark.parametrize(("identity", "method", "spoil"), FLAWS, ids=lambda value: getattr(value, "__name__", value))
def test_a_planted_flaw_is_noticed(identity, method, spoil, complex_step):
    """With one method off by a millionth, the identity fails; without, it holds."""
    robot, sample = draw(11, branching=False, kinds=("revolute", "prismatic", "revolute"))
    engine = Oracle(robot.tree, robot.tip)
    engine = engine if complex_step else ByDifferences(engine)
    check, needs = IDENTITIES[identity]
    assert method in needs
    assert check(engine, sample).passed
    assert not check(Flawed(engine, method, spoil), sample).passed


def test_every_identity_has_a_flaw():
    """No identity is without a negative control."""
    assert {identity for identity, _, _ in FLAWS} == set(IDENTITIES)


def test_unanswered_names_what_is_missing():
    """An engine that lacks a method is told which identities that leaves open; the others run."""

    class Less:
        complex_step = True
        position = jacobian = staticmethod(lambda q: q)

    missing = unanswered(Less())
    assert "jacobian_is_derivative" not in missing
    assert missing["drift_is_derivative"] == ("drift",)


def test_nan_does_not_pass():
    """An engine that answers NaN fails."""
    assert not Residual(float("nan"), 1.0, "").passed
    robot, sample = draw(0)
    spoilt = Flawed(Oracle(robot.tree, robot.tip), "drift", lambda result: result * np.nan)
    assert "drift_is_derivative" in failed(spoilt, sample)
