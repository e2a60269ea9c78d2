"""Surfaces that end: leaving over the edge is an event at its own instant, and beyond it nothing is touched."""

import math

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.scene.scene import scene_of
from closedloop.mechanics.surface.kinds.height_field import HeightField

MASS, PRESS = 2.0, 5.0


def point_mass(**changes):
    """Return the scenario of a point mass of three slides that is carried, and pressed down with PRESS."""
    own = {} if "surface" in changes else {"surface.contact": "unilateral", "surface.extent": [0.1, 0.2]}
    return cl.load_scenario("wam_slide", own | {
        "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0, 0.0, 0.0], "start.v": [0.0, 0.0, 0.0],
        "reference": {"kind": "hold"}, "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": PRESS},
        "stabiliser": {"kind": "none"}, "time.integrator": "rk4", "time.duration": 0.6, "time.step": 0.001,
    } | {key.replace("__", "."): value for key, value in changes.items()})  # fmt: skip


@pytest.mark.parametrize("contact", ["bilateral", "unilateral"])
@pytest.mark.parametrize("engine", ["pinocchio", "compiled", "adaptive"])
def test_it_falls_off_the_edge(engine, contact):
    """At x = 0.1 m contact ends, at its own instant; from there it falls freely, past the surface."""
    speed = 0.37
    scenario = point_mass(start__v=[speed, 0.1, 0.0], surface__contact=contact,
                          time__integrator="dop853" if engine == "adaptive" else "rk4")  # fmt: skip
    run = cl.simulate(scenario, engine="compiled" if engine == "compiled" else "pinocchio")
    (off,) = run.events
    assert off.kind == "edge"
    assert off.time == pytest.approx(0.1 / speed, abs=1e-12)
    assert off.position == pytest.approx(run.position[0] + [0.1, 0.01 / speed, 0.0], abs=1e-12)
    assert (off.energy_lost, off.rate_before, off.rate_after) == (0.0, 0.0, 0.0)
    before = run.time < off.time
    assert np.allclose(run.contact_force[before], PRESS, rtol=0, atol=1e-12)
    assert not np.any(run.contact_force[~before])
    fallen = 0.5 * PRESS / MASS * np.maximum(run.time - off.time, 0.0) ** 2
    assert np.allclose(run.position[0, 2] - run.position[:, 2], fallen, rtol=0, atol=1e-12)
    assert np.allclose(run.velocity[:, 0], speed, rtol=0, atol=1e-13)
    assert run.summary()["max_energy_residual"] < 1e-12
    assert run.summary()["events"]["edge"] == 1


def test_a_round_edge_of_a_ball_that_moves():
    """A patch of a rolling ball: the edge is where the surface's axes have it at that instant; both engines agree."""
    scenario = point_mass(
        surface={"kind": "sphere", "radius": 0.5, "contact": "bilateral", "edge_radius": 0.06}, law__force=0.0,
        surface_motion={"kind": "conveyor", "velocity": [-0.05, 0.02, 0.0]}, start__v=[0.1, 0.0, 0.0],
    )  # fmt: skip
    run, other = cl.simulate(scenario), cl.simulate(scenario, engine="compiled")
    (off,), (same,) = run.events, other.events
    assert off.time == pytest.approx(same.time, abs=1e-12)
    at = off.position - run.position[0] - off.time * np.array([-0.05, 0.02, 0.0])
    assert math.hypot(at[0], at[1]) == pytest.approx(0.06, abs=1e-12)
    after = run.time > off.time
    assert np.allclose(np.diff(run.velocity[after], axis=0), 0.0, atol=1e-12)  # nothing acts any more
    assert run.summary()["max_energy_residual"] < 1e-9


def test_a_surface_runs_away_below_a_tip_that_stays():
    """A belt of 10 cm with sticking friction off: it leaves the tip when its end has passed."""
    scenario = point_mass(
        surface__extent=[0.05, 0.1], surface_motion={"kind": "conveyor", "velocity": [0.2, 0.0, 0.0]}, law__kp=100.0,
        law__kd=20.0,
    )  # fmt: skip
    (off,) = cl.simulate(scenario).events
    assert (off.kind, off.time) == ("edge", pytest.approx(0.25, abs=1e-12))


def test_beyond_the_edge_nothing_is_touched():
    """A tip that comes down beside the surface passes it, one that comes down on it does not; and then bounces off."""
    down = {"surface__gap": 0.02, "law__force": 0.0, "time__duration": 0.5, "impact": {"restitution": 0.5}}
    beside = cl.simulate(point_mass(start__v=[0.6, 0.0, -0.1], **down))
    assert not beside.events
    assert beside.position[-1, 2] == pytest.approx(beside.position[0, 2] - 0.05, abs=1e-12)
    on = cl.simulate(point_mass(start__v=[0.4, 0.0, -0.1], **down))
    assert [event.kind for event in on.events] == ["impact"]
    assert on.events[0].time == pytest.approx(0.2, abs=1e-12)
    # From below, past the edge and on through the surface, which has no underside; and down on it.
    over = cl.simulate(point_mass(
        start__v=[-0.2, 0.0, 0.1], start__q=[0.13, 0.0, -0.02], surface__offset=0.0, surface__extent=[0.1, 0.1],
        law__force=0.4, time__duration=0.8,
    ))  # fmt: skip
    assert over.events[0].kind in ("impact", "touchdown")
    assert over.events[0].time == pytest.approx(0.5 * (1.0 + math.sqrt(0.2)), abs=1e-12)


def test_a_height_field_ends_where_its_grid_does():
    """Without another edge; and a smaller one is one of the grid."""
    heights = [[0.001 * math.sin(i + j) for j in range(7)] for i in range(6)]
    field = {"kind": "height_field", "heights": heights, "spacing": 0.02, "contact": "unilateral"}
    run = cl.simulate(point_mass(surface=field, start__v=[0.0, 0.4, 0.0], law__force=50.0))
    off = run.events[-1]  # the first is the blow of a start that is not along the slope
    assert off.kind == "edge"
    assert off.position[1] - run.position[0, 1] == pytest.approx(0.05, abs=1e-12)
    smaller = cl.simulate(
        point_mass(surface=field | {"extent": [0.03, 0.03]}, start__v=[0.0, 0.4, 0.0], law__force=50.0)
    )
    assert smaller.events[-1].position[1] - run.position[0, 1] == pytest.approx(0.03, abs=1e-12)
    for extent, bounds in (([9.0, 0.01], (0.06, 0.01)), ([0.04, 0.5], (0.04, 0.05))):
        assert HeightField(heights=heights, spacing=0.02, extent=extent).bounds() == pytest.approx(bounds, rel=1e-15)
    assert HeightField(heights=heights, spacing=0.02, edge_radius=0.05).bounds() == (0.05, 0.0)
    with pytest.raises(cl.ScenarioError, match=r"edge_radius = 0\.2: the grid ends 0\.05 m from its middle"):
        cl.prepare(point_mass(surface=field | {"edge_radius": 0.2}))


REFUSED = {
    "path": ({"surface.extent": [0.1, 0.02]}, "the path leaves the surface over its edge, by 0.04 m at most: make it"),
    "start": ({"surface": {"kind": "sphere", "radius": 0.3, "point": [0.0, 0.0, 0.0], "extent": [0.1, 0.1]}}, "edge"),
    "two edges": ({"surface.extent": [1, 1], "surface.edge_radius": 1.0}, "leave out one of them"),
    "negative": ({"surface.extent": [0.1, -0.1]}, "surface.extent"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_with_an_edge_is_refused(case):
    """In one line, before anything is simulated."""
    changes, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError, match=words) as caught:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("edge", [{"surface.extent": [0.1, 0.07]}, {"surface.edge_radius": 0.08}])
def test_a_patch_is_drawn_as_far_as_it_goes(edge):
    """Rectangle or disc, of a plane and of a ball."""
    for kind in ({}, {"surface.kind": "sphere", "surface.radius": 0.3}):
        run = cl.simulate(cl.load_scenario("wam_slide", edge | kind | {"time.duration": 0.01}))
        vertices, triangles = scene_of(run).surface
        away = np.abs(vertices - run.position[0]).max(axis=0)
        assert away[:2] == pytest.approx(edge.get("surface.extent", [0.08, 0.08]), abs=1e-3)
        assert triangles.max() == len(vertices) - 1
