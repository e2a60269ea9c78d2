"""Frames, normals and motors of parts that shipped scenarios leave at zero or in line with the axes."""

from types import SimpleNamespace

import numpy as np
from rounding import within
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.control.drives import TransmissionSection, transmission_constants
from closedloop.mechanics.surface.along import shape_at
from closedloop.record.columns.touching import Touching
from closedloop.simulation.prepare import prepare


def test_a_joint_without_a_drive_has_no_motor():
    """Its armature, if the robot's file has one, is no motor's."""
    driven, names = np.array([True, False, True, True]), ("a", "b", "c", "d")
    loose = SimpleNamespace(
        n=4, name="loose", joint_names=names, driven=driven, armature=np.full(4, 0.3), shared_drives=()
    )
    inertia = transmission_constants(TransmissionSection(stiffness=1e4), loose)
    np.testing.assert_array_equal(inertia, [[1e4, 0, 1e4, 1e4], [0] * 4, [0.3, 0, 0.3, 0.3], [0] * 4, [0] * 4])


def test_a_normal_turns_at_right_angles_to_itself_though_the_point_leaves_the_surface():
    """Of an ellipsoid, whose φ bends along its normal too; ṅ is that of differences."""
    changes = {"surface.kind": "ellipsoid", "reference.kind": "hold"}
    problem = prepare(cl.load_scenario("panda_slide", changes))
    shape, r = shape_at(problem.surface), np.asarray(problem.surface.origin)
    velocity, h = np.array([0.3, -0.2, 0.5]), 1e-6
    n, rate, _, _ = shape(r, velocity)
    assert abs(n @ velocity) > 0.1
    assert abs(n @ rate) < 1e-14
    turned = (shape(r + h * velocity, velocity)[0] - shape(r - h * velocity, velocity)[0]) / (2.0 * h)
    np.testing.assert_allclose(rate, turned, atol=1e-8)


def test_the_force_of_a_contact_on_a_turned_link_with_turned_axes():
    """The surface is asked at the point in its own axes, and its frame is turned back to the base's."""
    axes, plane, point, frame = (Rotation.random(random_state=seed).as_matrix() for seed in range(4))
    origins, at, origin = np.array([[0.0, 0, 0], [1.0, 2, 3], [-1.0, 0.5, 2]]), np.array([0.1, 0.2, 0.3]), np.ones(3)
    asked = []

    def touching(r, t):
        asked.append(r)
        return frame

    contact = Touching("c", 1, at, 2, axes, origin, SimpleNamespace(frame_at_rest=touching), np.zeros(7))
    place, force = contact.force(3.0, np.array([0.5, -0.7]), np.array([np.eye(3), point, plane]), origins)
    np.testing.assert_allclose(place, origins[1] + point @ at, atol=1e-14)
    np.testing.assert_allclose(origins[2] + plane @ (origin + axes.T @ asked[0]), place, atol=1e-14)
    np.testing.assert_allclose(force, plane @ axes.T @ frame.T @ [3.0, 0.5, -0.7], atol=1e-14)
    bare = Touching("c", 1, at, 2, axes, origin, None, np.zeros(7))
    force = bare.force(3.0, np.array([0.5, -0.7]), np.array([np.eye(3), point, plane]), origins)[1]
    assert within(64, force, plane @ axes.T @ [3.0, 0.5, -0.7])
