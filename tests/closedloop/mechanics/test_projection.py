"""Projection: the state is back on the closure after each step, by the smallest move, and f knows nothing of it."""

import numpy as np
import pytest

import closedloop as cl

SHORT = {"time.duration": 1.0, "stabiliser.kind": "projection"}


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "explicit_euler", "rk4"])
@pytest.mark.parametrize("kind", ["projection", "both"])
def test_closure_holds_to_rounding_at_every_row(kind, integrator):
    """e and ė are rounding: a few ε of a metre, and of the tip's speed times as many joints."""
    changes = SHORT | {"stabiliser.kind": kind, "time.integrator": integrator}
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    assert np.max(np.abs(run.closure_error)) < 4e-15
    assert np.max(np.abs(run.closure_rate)) < 1e-16
    assert np.max(run.velocity[:, 1]) > 0.01  # it does slide


def test_without_it_the_closure_drifts_in_the_same_second():
    """The negative control: with no stabiliser e is ten thousand times larger by the end of that second."""
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT | {"stabiliser.kind": "none"}))
    assert np.max(np.abs(run.closure_error)) > 1e-8


def test_force_has_no_share_of_it():
    """Projection alone puts no stabiliser's force into f; f is Baumgarte's but for what the law makes of ė.

    Baumgarte leaves ė of 4e-7 m/s, which the PD part's damping, some hundred N s/m along the normal, turns into 4e-5 N.
    """
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT))
    assert not np.any(run.stabiliser_force)
    other = cl.simulate(cl.load_scenario("wam_slide", SHORT | {"stabiliser.kind": "baumgarte"}))
    assert run.contact_force == pytest.approx(other.contact_force, abs=1e-3)
    assert run.contact_force[-1] == pytest.approx(other.contact_force[-1], abs=2e-4)
    assert np.ptp(run.contact_force) > 1.0  # the transient is in it


def test_a_start_beside_the_surface_is_put_on_it_by_the_smallest_move():
    """The first row is on the closure, and the move there is H⁻¹Aᵀ times a number: the smallest in H's norm."""
    scenario = cl.load_scenario("wam_slide", SHORT | {"time.duration": 0.002})
    height = cl.prepare(scenario).plane.offset
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT | {"time.duration": 0.002, "surface.offset": height - 5e-4}))
    assert abs(run.closure_error[0]) < 4e-15
    problem = cl.prepare(scenario)
    terms = problem.robot.terms(problem.q, problem.v)
    least = np.linalg.solve(terms.mass_matrix, problem.plane.normal @ terms.jacobian)
    move = run.q[0] - problem.q
    # One move is along H⁻¹Aᵀ exactly; the second, of the size of the first one's curvature, turns it by as much.
    assert abs(move @ least) == pytest.approx(np.linalg.norm(move) * np.linalg.norm(least), rel=1e-5)
    assert np.linalg.norm(move) > 1e-4


def test_it_acts_on_a_law_of_ones_own_and_under_a_hold():
    """Projection works on every path through the loop: a user's law, a sampled law."""
    for options in ({"law.sample_period": 0.002}, {}):
        scenario = cl.load_scenario("planar2_slide", SHORT | options)

        def law(t, q, v, terms):
            return terms.bias - terms.jacobian.T @ [0.0, 0.0, 10.0] + np.array([0.3, 0.1])

        for own in (None, law):
            run = cl.simulate(scenario, law=own)
            assert np.max(np.abs(run.closure_error)) < 4e-15


def test_kind_takes_no_gains():
    """A gain beside a projection is refused, not ignored."""
    with pytest.raises(cl.ScenarioError, match="damping_ratio"):
        cl.load_scenario("wam_slide", {"stabiliser.kind": "projection", "stabiliser.damping_ratio": 0.7})
