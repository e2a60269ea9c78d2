"""A body with flat faces and rounded edges: its distance, its edges, and a point that slides over one."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.surface.kinds.polyhedron import Polyhedron
from closedloop.mechanics.surface.motions.none import NoMotion
from closedloop.mechanics.surface.placed import PlacedSurface

BLOCK = ((1.0, 0.0, 0.0, 0.02), (2.0, 0.0, 2.0, 0.02))  # a wall at x = 20 mm, a chamfer x + z = 10 mm


def block(**more):
    """Return the surface of a block with its top at z = 0."""
    return PlacedSurface.of(Polyhedron(faces=BLOCK, **more), NoMotion(), np.zeros(3))


@pytest.mark.parametrize(
    ("at", "gap", "normal"),
    [
        ((-0.02, 0.1, 0.003), 0.003, (0.0, 0.0, 1.0)),
        ((0.025, 0.0, -0.05), 0.005, (1.0, 0.0, 0.0)),
        ((0.016, 0.0, -0.002), 0.004 / np.sqrt(2.0), (np.sqrt(0.5), 0.0, np.sqrt(0.5))),
        ((-0.02, 0.0, -0.001), -0.001, (0.0, 0.0, 1.0)),
    ],
)
def test_faces_are_flat(at, gap, normal):
    """Off its edges it is the distance from the nearest face, with that face's normal."""
    now = block().touching(np.array(at))
    assert now.gap == pytest.approx(gap, abs=1e-12)
    assert now.frame[0] == pytest.approx(normal, abs=1e-9)


def test_faces_that_lie_further_out():
    """`oversize` moves the other faces, and not the one at whose point the origin is."""
    on = block(oversize=0.001)
    assert on.touching(np.array([0.025, 0.0, -0.05])).gap == pytest.approx(0.004, abs=1e-12)
    assert on.touching(np.array([-0.02, 0.0, 0.003])).gap == pytest.approx(0.003, abs=1e-12)


def test_an_edge_has_the_radius_that_it_says():
    """Where two faces meet at 2 α the radius of curvature is s cos α/sin² α."""
    s = 0.0002
    for normal, half in (((1.0, 0.0, 0.0, 0.02), np.pi / 4.0), ((1.0, 0.0, 1.0, 0.02), np.pi / 8.0)):
        section = Polyhedron(faces=(normal,), rounding=s).resolved() | {"rounding": s, "oversize": 0.0}
        n = np.array(section["faces"]).reshape(2, 4)
        ridge = np.linalg.solve(np.vstack([n[:, [0, 2]]]), n[:, 3] - s * np.log(2.0))
        par = type("Par", (), {name: np.array(value) for name, value in section.items()})
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        p = np.array([ridge[0], 0.0, ridge[1]])
        assert Polyhedron.level(p, par, gradient, hessian) == pytest.approx(0.0, abs=1e-15)
        across = np.cross(gradient / np.linalg.norm(gradient), [0.0, 1.0, 0.0])
        curvature = across @ hessian @ across / np.linalg.norm(gradient)
        assert 1.0 / curvature == pytest.approx(s * np.cos(half) / np.sin(half) ** 2, rel=1e-9)


@pytest.mark.parametrize(
    ("face", "why"),
    [
        ([0, 0, 0, 0.1], r"\[0.0, 0.0, 0.0, 0.1\]: its normal must not be zero"),
        ([1, 0, 0, 0.001], r"\[1.0, 0.0, 0.0, 0.001\]: is 0.001 m outside the origin: must be 0.002 m, 20 times"),
    ],
)
def test_a_face_that_cannot_be_is_refused(face, why):
    """A normal of no length, and an edge at the origin, each in one line with the face."""
    with pytest.raises(cl.ScenarioError, match=why) as error:
        cl.prepare(cl.load_scenario("wam_slide", {"surface": {"kind": "polyhedron", "faces": [face]}}))
    assert "\n" not in str(error.value)


def test_a_point_slides_over_an_edge():
    """A point mass without friction that slides off the top goes over the rounded edge and leaves it; energy stays."""
    run = cl.simulate(
        cl.load_scenario("wam_slide", {
            "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0, 0.0, 0.0], "start.v": [0.1, 0.0, 0.0],
            "reference": {"kind": "hold"}, "law": {"kind": "none"}, "stabiliser": {"kind": "none"},
            "surface": {"kind": "polyhedron", "faces": [[1, 0, 1, 0.06]], "rounding": 0.002, "contact": "unilateral"},
            "time.integrator": "dop853", "time.duration": 0.8,
        })
    )  # fmt: skip
    speed2, drop = np.sum(run.velocity**2, axis=1), run.position[0, 2] - run.position[:, 2]
    assert speed2 - speed2[0] == pytest.approx(2.0 * 9.81 * drop, abs=1e-7)
    assert drop[-1] > 0.02
    assert run.surface_normal[-1] == pytest.approx([np.sqrt(0.5), 0.0, np.sqrt(0.5)], abs=1e-3)
    assert np.max(np.abs(run.closure_error[run.mode > 0])) < 1e-9
