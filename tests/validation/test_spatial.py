"""Spatial algebra: the definitions of every operator, as properties of random vectors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from validation.oracle import spatial

ROUNDING = 1e-14  # a dozen products of numbers of order one

seeds = st.integers(0, 2**32 - 1)


def draw_frame(rng):
    """Return a random rotation and position."""
    return spatial.rotation_from_rpy(rng.uniform(-np.pi, np.pi, 3)), rng.uniform(-1.0, 1.0, 3)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_skew_is_the_cross_product(seed):
    """(a×) b is numpy's cross product, batched or not."""
    a, b = np.random.default_rng(seed).normal(size=(2, 4, 3))
    np.testing.assert_allclose((spatial.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=ROUNDING)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_power_is_the_same_in_every_frame(seed):
    """A force taken to base coordinates by X⁻ᵀ and a motion by X make the same power as before."""
    rng = np.random.default_rng(seed)
    rotation, position = draw_frame(rng)
    force, motion = rng.normal(size=(2, 6))
    X = spatial.motion_to_base(rotation, position)
    inverse = spatial.motion_from_base(rotation, position)
    np.testing.assert_allclose(inverse @ X, np.eye(6), atol=ROUNDING)
    assert (inverse.T @ force) @ (X @ motion) == pytest.approx(force @ motion, abs=10 * ROUNDING)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_products_of_carried_vectors_are_constant(seed):
    """(v × m)·f + m·(v ×* f) = 0: carried along together, a motion and a force keep their power."""
    v, m, f = np.random.default_rng(seed).normal(size=(3, 6))
    rate = (spatial.cross_motion(v) @ m) @ f + m @ (spatial.cross_force(v) @ f)
    assert abs(rate) < 20 * ROUNDING
    np.testing.assert_allclose(spatial.cross_motion(v) @ v, 0.0, atol=10 * ROUNDING)
    swapped = spatial.cross_swapped(f)
    np.testing.assert_allclose(swapped @ v, spatial.cross_force(v) @ f, atol=10 * ROUNDING)
    np.testing.assert_allclose(swapped, -swapped.T)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_spatial_inertia_is_the_sum_over_mass_points(seed):
    """½ v·I v is the kinetic energy of the points that make the body, from any frame."""
    rng = np.random.default_rng(seed)
    masses, points = rng.uniform(0.1, 1.0, 6), rng.normal(size=(6, 3))
    centre = masses @ points / masses.sum()
    arms = points - centre
    about_centre = sum(m * spatial.skew(a) @ spatial.skew(a).T for m, a in zip(masses, arms, strict=True))
    rotation, position = draw_frame(rng)
    own = spatial.spatial_inertia(masses.sum(), centre, about_centre)
    inertia = spatial.inertia_to_base(rotation, position, own)
    v = rng.normal(size=6)
    speeds = [v[3:] + np.cross(v[:3], position + rotation @ point) for point in points]
    energy = sum(m * s @ s for m, s in zip(masses, speeds, strict=True)) / 2
    assert v @ inertia @ v / 2 == pytest.approx(energy, rel=100 * ROUNDING)


def test_rpy_turns_about_x_then_y_then_z():
    """A quarter turn about x takes y to z; the later turns are about the axes that stay."""
    quarter = np.pi / 2
    np.testing.assert_allclose(spatial.rotation_from_rpy([quarter, 0, 0]) @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(spatial.rotation_from_rpy([quarter, 0, quarter]) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
