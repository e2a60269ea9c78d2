"""What every run with a surface that only pushes obeys: 0 <= gap ⊥ f >= 0, and energy that only impacts take away."""

import numpy as np
import pytest
from contact_history import assert_one_story

import closedloop as cl

LOADED = [cl.load_scenario(name) for name in cl.shipped_scenarios()]
# Of a tip that comes and goes; several contacts are judged in `test_contacts`.
UNILATERAL = [
    each.name
    for each in LOADED
    if each.surface.contact == "unilateral"
    and each.friction.kind == "none"
    and not each.contact
    and each.belief.surface is None
]


@pytest.fixture(params=UNILATERAL)
def run(request, shipped_run):
    """Return the run of each shipped scenario whose tip may leave the surface."""
    return shipped_run(request.param)


def test_gap_and_force_complement_each_other(run):
    """At every row either the tip is free and f = 0, or it is on the surface and f >= 0.

    On the surface Baumgarte leaves a few nanometres, as in the bilateral scenarios (below 2e-8 m), and that times 10 N
    is what is left of e f = 0. A free tip may be as deep as the stabiliser left the one it was, 1e-9 m.
    """
    assert UNILATERAL
    free = run.mode == 0
    assert free.any()
    assert (~free).any()
    assert np.all(run.contact_force[free] == 0.0)
    assert np.all(run.stabiliser_force[free] == 0.0)
    assert np.all(run.contact_force[~free] >= 0.0)
    assert np.max(np.abs(run.closure_error[~free])) < 2e-8
    assert np.min(run.closure_error[free]) > -1e-9
    assert np.max(np.abs(run.closure_error * run.contact_force)) < 2e-7


def test_events_make_a_story(run):
    """The mode changes only at events, events are in order, rates have the signs that they must, losses are losses."""
    assert_one_story(run)
    assert run.events
    assert run.event_time[0] >= 0.0
    assert run.event_time[-1] <= run.time[-1]
    for event in run.events:
        assert event.energy_lost >= -1e-15
        if event.kind != "liftoff":
            assert event.rate_before < 0.0
            assert event.rate_after >= 0.0


def test_rates_and_positions_of_events_are_on_the_surface(run):
    """An event is where the surface is: to rounding as the tip arrives, to the stabiliser's nanometre as it goes."""
    normal = np.array(run.scenario.surface.normal)
    normal /= np.linalg.norm(normal)
    offset = normal @ run.position[0] - run.closure_error[0]
    for event in run.events:
        assert abs(normal @ event.position - offset) < (1e-9 if event.kind == "liftoff" else 1e-12)
        assert event.rate_after == 0.0 or event.kind == "impact"


SCHEMES = [
    {},
    {"time.integrator": "rk4"},
    {"time.integrator": "explicit_euler"},
    {"stabiliser.kind": "projection"},
    {"stabiliser.kind": "none"},
    {"law.sample_period": 0.004},
    {"time.integrator": "rk4", "stabiliser.kind": "both", "law.sample_period": 0.002},
]


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: "-".join(map(str, s.values())) or "as_shipped")
def test_a_surface_that_never_lets_go_is_the_papers(scheme):
    """As long as f > 0 the unilateral surface is the bilateral one, bit for bit in every column."""
    both = [
        cl.simulate(cl.load_scenario("wam_slide", {"surface.contact": kind, "time.duration": 1.0} | scheme))
        for kind in ("bilateral", "unilateral")
    ]
    assert both[0].contact_force.min() > 0.0
    assert both[1].events == ()
    for name in both[0].columns:
        assert np.array_equal(both[0].columns[name], both[1].columns[name]), name


def test_a_held_tip_and_a_free_one_part_where_the_force_changes_its_sign():
    """On wam_liftoff both surfaces agree to the last bit up to the liftoff, where the bilateral one begins to pull."""
    changes = {"time.duration": 2.0}
    free = cl.simulate(cl.load_scenario("wam_liftoff", changes))
    held = cl.simulate(cl.load_scenario("wam_liftoff", changes | {"surface.contact": "bilateral"}))
    first = int(np.flatnonzero(held.contact_force < 0.0)[0])
    assert held.time[first - 1] < free.events[0].time <= held.time[first]
    for name in ("q", "v", "torque", "contact_force", "closure_error"):
        assert np.array_equal(free.columns[name][:first], held.columns[name][:first]), name
    assert held.closure_error[-1] < 1e-6 < free.closure_error[-1]
