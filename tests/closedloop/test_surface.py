"""The plane: its normal, its offset, and which side is which."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import closedloop as cl

COMPONENTS = st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3).filter(lambda n: max(map(abs, n)) > 1e-3)


@given(COMPONENTS, st.floats(1e-290, 1e290))
def test_any_length_of_normal_is_the_same_normal(normal, length):
    """A normal of any length gives the unit normal of its direction, without over- or underflow."""
    unit = cl.Plane.of(normal, 0.0).normal
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-15)
    scaled = [length * x for x in normal]
    assert np.allclose(cl.Plane.of(scaled, 0.0).normal, unit, rtol=0, atol=1e-15)
    assert np.allclose(np.cross(unit, np.array(normal) / max(map(abs, normal))), 0.0, atol=1e-15)


@pytest.mark.parametrize("normal", [[0, 0, 5e-324], [0, 0, 1.7e308], [1.7e308, -1.7e308, 1.7e308], [1e-320, 0, 0]])
def test_normals_at_the_end_of_the_number_range(normal):
    """The smallest and largest numbers there are make unit normals, too."""
    assert np.linalg.norm(cl.Plane.of(normal, 0.0).normal) == pytest.approx(1.0, abs=1e-15)


@given(COMPONENTS, st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3), st.floats(-1.0, 1.0))
def test_gap_is_the_distance_out_of_the_surface(normal, point, out):
    """The gap of a point on the plane is zero, and a move along +n adds its length: positive is off the surface."""
    plane = cl.Plane.through(point, normal)
    assert plane.gap(point) == pytest.approx(0.0, abs=1e-15)
    assert plane.gap(np.array(point) + out * plane.normal) == pytest.approx(out, abs=1e-14)


def test_offset_refers_to_the_unit_normal():
    """The offset is the distance from the base origin, whatever the normal's length."""
    assert cl.Plane.of([0, 0, 7], 0.25).gap([3.0, -1.0, 1.0]) == pytest.approx(0.75)


def test_normal_is_read_only():
    """A plane cannot be bent."""
    with pytest.raises(ValueError, match="read-only"):
        cl.Plane.of([0, 0, 1], 0.0).normal[0] = 1.0


@pytest.mark.parametrize(
    ("normal", "offset", "words"),
    [
        ([0, 0, 0], 0.0, "no direction"),
        ([0, 0], 0.0, "three finite numbers"),
        ([0, 0, np.nan], 0.0, "three finite numbers"),
        ([0, np.inf, 0], 0.0, "three finite numbers"),
        ([0, 0, 1], np.nan, "surface.offset"),
        ([0, 0, 1], -np.inf, "surface.offset"),
    ],
)
def test_no_plane_is_refused(normal, offset, words):
    """A normal without direction and numbers that are none are refused by name."""
    with pytest.raises(cl.ScenarioError, match=words):
        cl.Plane.of(normal, offset)
