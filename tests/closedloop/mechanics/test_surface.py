"""The plane: its normal, its offset, and which side is which."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rounding import within
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.mechanics.surface.placed import contact_frame

COMPONENTS = st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3).filter(lambda n: max(map(abs, n)) > 1e-3)


@given(COMPONENTS, st.floats(1e-290, 1e290))
def test_any_length_of_normal_is_the_same_normal(normal, length):
    """A normal of any length gives the unit normal of its direction, without over- or underflow."""
    unit = cl.Plane.of(normal, 0.0).normal
    assert within(16, np.linalg.norm(unit), 1.0)
    scaled = [length * x for x in normal]
    assert within(16, cl.Plane.of(scaled, 0.0).normal, unit)
    assert np.allclose(np.cross(unit, np.array(normal) / max(map(abs, normal))), 0.0, atol=1e-15)


@pytest.mark.parametrize("normal", [[0, 0, 5e-324], [0, 0, 1.7e308], [1.7e308, -1.7e308, 1.7e308], [1e-320, 0, 0]])
def test_normals_at_the_end_of_the_number_range(normal):
    """The smallest and largest numbers there are make unit normals, too."""
    assert within(16, np.linalg.norm(cl.Plane.of(normal, 0.0).normal), 1.0)


@given(COMPONENTS, st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3), st.floats(-1.0, 1.0))
def test_gap_is_the_distance_out_of_the_surface(normal, point, out):
    """The gap of a point on the plane is zero, and a move along +n adds its length: positive is off the surface."""
    plane = cl.Plane.through(point, normal)
    assert plane.gap(point) == pytest.approx(0.0, abs=1e-15)
    assert within(64, plane.gap(np.array(point) + out * plane.normal), out, point)


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


@given(COMPONENTS)
def test_contact_frame_is_right_handed_and_begins_with_the_normal(normal):
    """Rows n, t1, t2 are orthonormal and right-handed, for normals everywhere."""
    n = cl.Plane.of(normal, 0.0).normal
    frame = contact_frame(n)
    assert np.array_equal(frame[0], n)
    rounding = 2e-15  # of three products and of the normal's own length
    assert np.allclose(frame @ frame.T, np.eye(3), rtol=0, atol=rounding)
    assert np.allclose(np.cross(frame[0], frame[1]), frame[2], rtol=0, atol=rounding)


@pytest.mark.parametrize("tilt", [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_contact_frame_near_the_vertical(tilt, side):
    """Normals a hair off ±z have an orthonormal frame to rounding, and those near +z that of the level surface."""
    n = cl.Plane.of([0.6 * tilt, 0.8 * tilt, side], 0.0).normal
    frame = contact_frame(n)
    assert within(16, frame @ frame.T, np.eye(3))
    assert within(16, np.linalg.det(frame), 1.0)
    if side > 0:
        assert np.allclose(frame[1:], [[1, 0, 0], [0, 1, 0]], rtol=0, atol=2 * tilt)


def test_contact_frame_of_a_level_surface_is_that_of_the_base():
    """On a level surface t1 is +x and t2 is +y, exactly; upside down t1 stays +x."""
    assert np.array_equal(contact_frame([0, 0, 1]), [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert np.array_equal(contact_frame([0, 0, -1]), [[0, 0, -1], [1, 0, 0], [0, -1, 0]])


@given(st.floats(-2.9, 2.9), st.floats(-np.pi, np.pi))
def test_contact_frame_is_turned_no_more_than_the_normal(tilt, heading):
    """The frame's rotation from that of a level surface is by the angle of n from +z about n's horizontal normal."""
    axis = np.array([-np.sin(heading), np.cos(heading), 0.0])
    n = np.array([np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), np.cos(tilt)])
    turn = Rotation.from_rotvec(tilt * axis)
    assert within(64, contact_frame(n)[1:], turn.apply([[1, 0, 0], [0, 1, 0]]))
