"""Paths rolled onto a surface: geodesics in closed form, lengths and angles kept, carried along, edges refused."""

import numpy as np
import pytest
from numpy.polynomial import Chebyshev

import closedloop as cl
from closedloop.control.reference.path import PATHS, path_on
from closedloop.control.reference.tip_path import Rolling
from closedloop.mechanics.surface.motion import MOTIONS
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import SURFACES

TIP = np.array([0.3, -0.2, 0.5])
UP = np.array([0.0, 0.0, 1.0])
T = np.linspace(0.5, 4.499, 201)
SADDLE = {"expression": "z + 1.5*x**2 - 2*y**2 + 3*x*y*z"}
FLAT = {"heights": tuple((0.0,) * 9 for _ in range(9)), "spacing": 0.01}


def place(kind, motion="none", moves=None, **keys):
    """Return a surface below the tip."""
    return PlacedSurface.of(SURFACES[kind](**keys), MOTIONS[motion](**moves or {}), TIP)


def draw(kind, surface, **keys):
    """Return a path in its plane, and as it is rolled onto a surface."""
    section = PATHS[kind](on_surface="geodesic", **keys)
    return section.tip_path(TIP, UP), path_on(section, TIP, surface, 6.0)


def line(direction=(1.0, 0.0, 0.0), speed=0.1, **keys):
    """Return the keys of a line."""
    return {"direction": direction, "speed": speed, "start": 0.5, "stop": 4.5} | keys


def test_a_line_on_a_sphere_is_a_great_circle():
    """Position, velocity and acceleration in closed form."""
    R = 0.4
    _, path = draw("line", place("sphere", radius=R), **line())
    r, v, a = path.sample(T)
    angle = (0.1 * (T - 0.5) / R)[:, None]
    out, along = np.sin(angle) * [1, 0, 0] + np.cos(angle) * UP, np.cos(angle) * [1, 0, 0] - np.sin(angle) * UP
    assert np.allclose(r, TIP - R * UP + R * out, rtol=0, atol=1e-12)
    assert np.allclose(v, 0.1 * along, rtol=0, atol=1e-12)
    assert np.allclose(a, -0.01 / R * out, rtol=0, atol=1e-10)


@pytest.mark.parametrize("gap", [0.05, -0.02])
def test_a_path_that_begins_off_the_surface_keeps_its_height(gap):
    """It rolls along the parallel surface through its start: a great circle of a larger or smaller sphere."""
    R = 0.4
    section = PATHS["line"](on_surface="geodesic", **line())
    path = path_on(section, TIP + gap * UP, place("sphere", radius=R), 6.0)
    r = path.sample(T)[0] - (TIP - R * UP)
    assert np.allclose(np.linalg.norm(r, axis=1), R + gap, rtol=0, atol=1e-12)
    angle = 0.1 * (T - 0.5) / (R + gap)
    assert np.allclose(np.arctan2(r[:, 0], r[:, 2]), angle, rtol=0, atol=1e-11)


@pytest.mark.parametrize("inside", [False, True])
def test_a_line_on_a_cylinder_is_a_helix(inside):
    """From outside and in a pipe, at constant speed."""
    R, s = 0.3, -1.0 if inside else 1.0
    _, path = draw("line", place("cylinder", radius=R, inside=inside), **line((0.6, 0.8, 0.0)))
    r, v, _ = path.sample(T)
    angle = 0.08 * (T - 0.5) / R
    axis = TIP - s * R * UP
    helix = axis + np.column_stack([0.06 * (T - 0.5), R * np.sin(angle), s * R * np.cos(angle)])
    assert np.allclose(r, helix, rtol=0, atol=1e-12)
    assert np.allclose(np.linalg.norm(v, axis=1), 0.1, rtol=0, atol=1e-12)


SHAPES = {
    "raster": {"length": 0.1, "pitch": -0.03, "passes": 2, "start": 0.5, "stop": 4.5},
    "circle": {"radius": 0.05, "start": 0.5, "stop": 4.5},
    "figure_eight": {"width": 0.1, "height": 0.05, "start": 0.5, "stop": 4.5},
}


@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.slow) if k == "circle" else k for k in SHAPES])
def test_speed_and_curvature_within_the_surface_are_those_of_the_plane(kind):
    """On a saddle: the tip is on it, as fast as on the plane, its speed grows alike, and it turns alike."""
    surface = place("implicit", **SADDLE)
    plane, path = draw(kind, surface, direction=(0.8, 0.6, 0.0), **SHAPES[kind])
    (_, v, a), (_, dr, ddr) = plane.sample(T), path.sample(T)
    assert np.allclose(np.linalg.norm(dr, axis=1), np.linalg.norm(v, axis=1), rtol=0, atol=1e-9)
    assert np.allclose(np.sum(dr * ddr, axis=1), np.sum(v * a, axis=1), rtol=0, atol=1e-8)
    r = path.sample(T)[0]
    assert max(abs(surface.touching(each).gap) for each in r) < 1e-11
    normals, rates = surface.normals(T, r, dr)
    assert np.ptp(normals, axis=0).max() > 0.1
    turns = np.sum(np.cross(dr, ddr) * normals, axis=1)
    assert np.allclose(turns, np.cross(v, a)[:, 2], rtol=0, atol=1e-8)
    assert np.allclose(np.sum(ddr * normals, axis=1), -np.sum(dr * rates, axis=1), rtol=0, atol=1e-7)


@pytest.mark.parametrize(("motion", "moves"), [("breathing", {"amplitude": 0.03, "frequency": 0.4}),
                                               ("turntable", {"axis": (0.2, 0.0, 1.0), "speed": 0.3})])  # fmt: skip
def test_a_surface_that_moves_carries_the_path(motion, moves):
    """On the body it is what it is at rest; velocity and acceleration are its derivatives."""
    surface = place("sphere", motion, moves, radius=0.4)
    _, path = draw("line", surface, **line())
    _, still = draw("line", place("sphere", radius=0.4), **line())
    for k in (0, 90, 200):
        turn, shift = surface.displacement(T[k])
        assert np.allclose(
            path.sample(T[k : k + 1])[0], still.sample(T[k : k + 1])[0] @ turn.T + shift, rtol=0, atol=1e-12
        )
    t = 2.0 + 0.3 * np.cos(np.pi * (np.arange(24) + 0.5) / 24)
    r, v, a = path.sample(t)
    for i in range(3):
        series = Chebyshev.fit(t, r[:, i], 23)
        assert np.allclose(series.deriv()(t), v[:, i], rtol=0, atol=1e-9)
        assert np.allclose(Chebyshev.fit(t, v[:, i], 23).deriv()(t), a[:, i], rtol=0, atol=1e-9)


def test_waypoints_on_the_surface():
    """Laid onto the surface they lie on it, one way or the other, and on the plane too; else they are in space."""
    points = {"times": (0.5, 2.0, 4.5), "points": ((0, 0, 0), (0.05, 0, 0.02), (0.05, 0.05, 0.0)), "timing": "linear"}
    for surface in (place("sphere", radius=0.4), place("plane")):
        for how in ("projected", "geodesic"):
            path = path_on(PATHS["waypoints"](on_surface=how, **points), TIP, surface, 6.0)
            r, v, _ = path.sample(T)
            assert max(abs(surface.touching(each).gap) for each in r) < 1e-11
            if how == "geodesic":
                assert np.linalg.norm(v[0]) == pytest.approx(0.05 / 1.5, abs=1e-12)
        path = path_on(PATHS["waypoints"](**points), TIP, surface, 6.0)
        assert path.sample(np.array([2.0]))[0][0, 2] == pytest.approx(0.52)


@pytest.mark.parametrize("how", ["geodesic", "projected"])
def test_a_path_beyond_the_edge_is_refused(how):
    """A patch of 40 mm each way is too small for a line of 108 mm from its middle; one of 36 mm lies on it."""
    patch = {"surface": {"kind": "height_field", **FLAT}, "reference.on_surface": how}
    cl.prepare(cl.load_scenario("wam_slide", patch | {"reference.speed": 0.006}))
    with pytest.raises(cl.ScenarioError, match="over its edge") as caught:
        cl.prepare(cl.load_scenario("wam_slide", patch))
    assert "\n" not in str(caught.value)


def test_a_path_too_long_to_follow_is_refused():
    """At once: it would take minutes to integrate, and the inverse kinematics takes none so long."""
    with pytest.raises(cl.ScenarioError, match="too long"):
        draw("line", place("sphere", radius=0.4), **line(speed=1e3))


def test_a_path_over_a_kink_is_refused_at_once_and_where_it_is(monkeypatch):
    """Knots are put where the polynomials are off alone: near the kink, not all along, which took 28 s."""
    steps, step = [], Rolling._step
    monkeypatch.setattr(Rolling, "_step", lambda self, *given: (steps.append(given[1:]), step(self, *given)))
    folded = place("implicit", expression="z + 0.1*sqrt((x - 0.02)**2 + 1e-10)")
    with pytest.raises(
        cl.ScenarioError, match=r"^reference: after 0\.0\d+ m the path .* bent too sharply, at "
    ) as said:
        draw("line", folded, **line(speed=0.02))
    assert float(str(said.value).split()[2]) == pytest.approx(0.02, abs=5e-4)
    assert len(str(said.value).splitlines()) == 1
    assert len(steps) < 2000  # 8192 in the last of ten rounds, evenly spread


def test_a_run_along_a_geodesic():
    """The loop follows it at the speed that the scenario says, where the projected line gets faster."""
    changes = {"surface.kind": "sphere", "surface.radius": 0.3, "reference.speed": 0.12, "reference.start": 0.05,
               "reference.stop": 1.0, "time.duration": 0.95}  # fmt: skip
    speeds = {}
    for how in ("geodesic", "projected"):
        run = cl.simulate(cl.load_scenario("wam_slide", changes | {"reference.on_surface": how}))
        assert run.summary()["verdict"]["good"], run.summary()["verdict"]
        speeds[how] = np.linalg.norm(np.diff(run.reference_tip[100:900], axis=0), axis=1) / 0.001
    assert np.allclose(speeds["geodesic"], 0.12, rtol=0, atol=1e-6)
    assert speeds["projected"][-1] > 0.127
