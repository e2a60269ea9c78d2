"""The two robots whose dynamics can be written down: Pinocchio must agree with the pen."""

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_models
from robot_models.planar2 import closed_form

# Entries are below 100 and every one is a handful of products: a few units in the last place of the largest.
ROUNDING = 5e-14

PAIR = st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0))


@cache
def built(name, drive_inertia=True):
    """Return Pinocchio's model of a robot, made once for all examples."""
    return robot_models.load(name, drive_inertia=drive_inertia).pinocchio_model()


def symmetric(upper):
    """Return a matrix from its upper triangle."""
    return np.triu(upper) + np.triu(upper, 1).T


@pytest.mark.parametrize("drive_inertia", [True, False])
@given(q=PAIR, v=PAIR)
def test_planar2_is_its_closed_form(drive_inertia, q, v):
    """H, C, r, J and J̇q̇ of the URDF are those of the textbook equations."""
    model = built("planar2", drive_inertia)
    q, v = np.array(q), np.array(v)
    data, frame = model.createData(), model.getFrameId("tip")
    truth = closed_form.terms(q, v, drive_inertia=drive_inertia)
    np.testing.assert_allclose(symmetric(pin.crba(model, data, q)), truth.mass_matrix, atol=ROUNDING)
    np.testing.assert_allclose(pin.nonLinearEffects(model, data, q, v), truth.bias, atol=ROUNDING)
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
    np.testing.assert_allclose(J, truth.jacobian, atol=ROUNDING)
    pin.forwardKinematics(model, data, q, v, np.zeros(2))
    pin.updateFramePlacements(model, data)
    np.testing.assert_allclose(data.oMf[frame].translation, truth.position, atol=ROUNDING)
    drift = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    np.testing.assert_allclose(drift, truth.drift, atol=ROUNDING)


@given(q=PAIR, v=PAIR)
def test_closed_form_is_consistent_with_itself(q, v):
    """J is the derivative of r, J̇q̇ that of J along v, and C does half the work of Ḣ, by differences."""
    q, v, h = np.array(q), np.array(v), 1e-6
    here = closed_form.terms(q, v)
    ahead, behind = closed_form.terms(q + h * v, v), closed_form.terms(q - h * v, v)
    np.testing.assert_allclose((ahead.position - behind.position) / (2 * h), here.jacobian @ v, atol=1e-8)
    np.testing.assert_allclose((ahead.jacobian - behind.jacobian) / (2 * h) @ v, here.drift, atol=1e-8)
    # Ḣ − 2C is skew, so the bias without gravity does half the work of Ḣ.
    gravity = closed_form.terms(q, np.zeros(2)).bias
    rate = (ahead.mass_matrix - behind.mass_matrix) / (2 * h)
    np.testing.assert_allclose(v @ (here.bias - gravity), 0.5 * v @ rate @ v, atol=2e-7)


@given(q=st.tuples(*[st.floats(-9.0, 9.0)] * 3), v=st.tuples(*[st.floats(-9.0, 9.0)] * 3))
def test_pointmass3_is_newtons_second_law(q, v):
    """H = m 1, C = (0, 0, m g), r = q, J = 1, exactly."""
    model = built("pointmass3")
    q, v, data = np.array(q), np.array(v), model.createData()
    np.testing.assert_array_equal(symmetric(pin.crba(model, data, q)), 2.0 * np.eye(3))
    np.testing.assert_allclose(pin.nonLinearEffects(model, data, q, v), [0, 0, 2.0 * 9.81], atol=1e-14)
    frame = model.getFrameId("tip")
    np.testing.assert_array_equal(
        pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[:3], np.eye(3)
    )
    pin.framesForwardKinematics(model, data, q)
    np.testing.assert_array_equal(data.oMf[frame].translation, q)
