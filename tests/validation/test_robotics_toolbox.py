"""The Robotics Toolbox beside the oracle: Eqs. 26-27, and H by the method that the paper compares its own with."""

import numpy as np
import pytest

import robot_models
from validation.oracle import Oracle, dynamics, kinematics
from validation.states import random_robot

ROUNDING = 1e-12
ROBOTS = {
    "wam4": lambda: robot_models.load("wam4"),
    "ur5": lambda: robot_models.load("ur5"),
    "random tree": lambda: random_robot(3),
}


def toolbox(robot):
    """Return the toolbox's engine for a robot, or skip with the line that installs it."""
    pytest.importorskip("roboticstoolbox", reason='pip install "roboticstoolbox-python>=1.5"')
    from validation.engines.robotics_toolbox import RoboticsToolbox

    return RoboticsToolbox(robot, robot.tip)


def both(name):
    """Return the toolbox, the oracle, q and q̇ of a robot by name."""
    robot = ROBOTS[name]()
    made = toolbox(robot)
    q, v = np.random.default_rng(1).normal(size=(2, made.n))
    return made, Oracle.from_model(robot), q, v


@pytest.mark.parametrize("name", ROBOTS)
def test_jacobians(name):
    """J₀ of Eq. 26 and Jₙ of Eq. 27, made from the spatial J of Eq. 25, are jacob0 and jacobe."""
    made, oracle, q, _ = both(name)
    rotation = kinematics.tip_rotation(oracle.tree, oracle.pose(q), oracle.tip)
    J_0, J_n = kinematics.toolbox_jacobians(oracle.spatial_jacobian(q), oracle.position(q), rotation)
    theirs_0, theirs_n = made.toolbox_jacobians(q)
    np.testing.assert_allclose(theirs_0, J_0, atol=ROUNDING)
    np.testing.assert_allclose(theirs_n, J_n, atol=ROUNDING)
    assert np.abs(J_0 - J_n).max() > 0.1  # the two are not the same thing
    np.testing.assert_allclose(J_0[3:], oracle.jacobian(q), atol=ROUNDING)


@pytest.mark.parametrize("name", ROBOTS)
def test_coriolis_and_gravload(name):
    """coriolis(q, q̇) q̇ + gravload(q), by passes at unit speeds, is the C of one Newton-Euler pass."""
    made, oracle, q, v = both(name)
    C = oracle.bias(q, v)
    np.testing.assert_allclose(made.coriolis_and_gravity(q, v), C, atol=ROUNDING * np.abs(C).max())


@pytest.mark.parametrize("seed", range(8))
def test_mass_matrix_by_newton_euler(seed):
    """H a column a Newton-Euler pass (Walker and Orin) equals H by composite bodies, drives included."""
    robot = random_robot(seed)
    oracle = Oracle.from_model(robot)
    q = np.random.default_rng(seed).normal(size=oracle.tree.size)
    pose = oracle.pose(q)
    H = dynamics.mass_matrix(oracle.tree, pose)
    columns = dynamics.mass_matrix_by_newton_euler(oracle.tree, pose)
    np.testing.assert_allclose(columns, H, atol=ROUNDING * np.abs(H).max())
    # Newton-Euler with the weight left in is off by gravity's torque in every column.
    weighed = dynamics.inverse_dynamics(oracle.tree, pose, 0.0 * q, np.eye(q.size)[0])
    assert np.abs(weighed - H[:, 0]).max() > 1e-3
