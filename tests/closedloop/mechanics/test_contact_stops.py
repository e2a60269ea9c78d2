"""Stops of joints among several contacts, and with dop853: closed forms, the stops alone, other integrators."""

import dataclasses

import numpy as np
import pytest
from box_in_plane import HEIGHT, MASS, WIDTH, G, block, corners, moved, total_energy

import closedloop as cl
import robot_models
from closedloop.mechanics.closure.contact_force import STUCK


def limited(lower, upper):
    """The block with limits of its joints: along x and z, m, and turning, rad."""
    return dataclasses.replace(block(), position_lower=np.array(lower), position_upper=np.array(upper))


FREE = 50.0


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_block_slides_into_a_stop(restitution):
    """v² = v₀² − 2 μ g s at the stop, where v is reversed by e and 1 − e² of its energy is lost; then friction."""
    model, way = limited([-FREE, -FREE, -FREE], [0.05, FREE, FREE]), 0.05
    changes = {"robot.stops": True, "robot.stop_restitution": restitution}
    run = moved([0, HEIGHT / 2, 0], [1.0, 0, 0], corners(0.3), 0.1, model=model, **changes)
    v = np.sqrt(1.0 - 2 * 0.3 * G * way)
    stop = run.events[0]
    assert (stop.kind, stop.contact) == ("stop", 3)  # behind the tip and two feet: the first joint
    assert stop.time == pytest.approx((1.0 - v) / (0.3 * G), abs=1e-10)
    assert stop.rate_after == pytest.approx(restitution * v, abs=1e-9)
    assert stop.energy_lost == pytest.approx(0.5 * MASS * v**2 * (1 - restitution**2), rel=1e-8)
    assert np.max(run.q[:, 0]) < way + 1e-12
    assert np.ptp(total_energy(run)) < 1e-12


def test_weight_is_shared_by_a_foot_and_a_stop():
    """On one foot, with the stop of its turning: the floor carries all of the weight, the stop its moment."""
    model = limited([-FREE, -FREE, 0.0], [FREE, FREE, FREE])
    run = moved([0, HEIGHT / 2, 0], [0, 0, 0], corners(0.5)[:1], 0.01, model=model, **{"robot.stops": True})
    np.testing.assert_allclose(run.link_forces[:, 0], MASS * G, rtol=1e-8)
    np.testing.assert_allclose(run.stop_torque[:, 2], MASS * G * WIDTH / 2, rtol=1e-8)
    np.testing.assert_allclose(run.stop_torque[:, :2], 0.0, atol=1e-12)
    assert np.all(run.link_modes == STUCK)
    assert np.max(run.residual_motion) < 1e-14
    falls = moved([0, HEIGHT / 2, 0], [0, 0, 0], corners(0.5)[1:], 0.01, model=model, **{"robot.stops": True})
    assert falls.acceleration[0, 2] > 1.0  # on the other foot nothing stops it


def test_block_rattles_between_stops_and_floor():
    """Impacts of feet and joints at any time: energy is kept, nothing is passed, what is open carries nothing."""
    model = limited([-0.02, -FREE, -0.1], [0.03, FREE, 0.2])
    changes = {"robot.stops": True, "robot.stop_restitution": 0.5}
    start = [0, HEIGHT / 2 + 0.03, 0.1], [0.5, 0, 1.0]
    run = moved(*start, corners(0.4, restitution=0.5), 0.2, 4e-3, model=model, **changes)
    kinds = {event.kind for event in run.events}
    assert {"stop", "impact"} <= kinds
    assert np.ptp(total_energy(run)) < 1e-7
    assert all(event.energy_lost > -1e-12 for event in run.events)
    assert np.min(run.link_gaps) > -1e-8
    over = np.maximum(run.q - model.position_upper, model.position_lower - run.q)
    assert np.max(over) < 1e-8
    assert np.max(np.abs(run.stop_torque * over)) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("contacts", [None, corners(0.3, restitution=0.3)])
def test_dop853_finds_the_stops_and_the_contacts(contacts):
    """Stops alone, and stops and feet: the events of rk4 at their instants, and the energy to rounding."""
    model = limited([-0.02, -FREE, -0.1], [0.03, FREE, 0.2])
    start = [0, HEIGHT / 2 + 0.01, 0.05], [0.7, 0, 0.5]
    runs = [
        moved(
            *start, contacts, 0.06, 5e-4, model=model,
            **{"robot.stops": True, "robot.stop_restitution": 0.6, "time.integrator": integrator},
        )
        for integrator in ("rk4", "dop853")
    ]  # fmt: skip
    rk4, dop853 = runs
    assert [(e.kind, e.contact) for e in rk4.events] == [(e.kind, e.contact) for e in dop853.events]
    np.testing.assert_allclose([e.time for e in rk4.events], [e.time for e in dop853.events], atol=1e-6)
    np.testing.assert_allclose(rk4.q, dop853.q, atol=1e-6)
    assert np.ptp(total_energy(dop853)) < 1e-12


@pytest.mark.slow
def test_dop853_finds_the_stops_of_a_mechanism_with_loops():
    """A five-bar that falls onto its stops: as with rk4, closed and explained in every row."""
    model = robot_models.load("five_bar")
    changes = {
        "surface.gap": 5.0, "surface.contact": "unilateral", "robot.stops": True, "robot.stop_restitution": 0.4,
        "stabiliser.kind": "none", "law.kp": 0, "law.kd": 0, "law.force": 0, "reference.kind": "hold",
        "time.duration": 0.2, "time.step": 0.005,
    }  # fmt: skip
    start = cl.prepare(cl.load_scenario("five_bar", changes)).q
    close = dataclasses.replace(model, position_lower=start - 0.15, position_upper=start + 0.2)
    rk4, dop853 = (
        cl.simulate(
            cl.load_scenario("five_bar", {**changes, "time.integrator": integrator}),
            model=close,
            law=lambda x: 0.0 * x.q,
        )
        for integrator in ("rk4", "dop853")
    )
    assert len(rk4.events) == len(dop853.events) > 2
    np.testing.assert_allclose(rk4.q, dop853.q, atol=1e-6)
    assert np.max(np.abs(dop853.loops.errors)) < 1e-12
    assert np.max(dop853.loops.unexplained) < 1e-9
    assert np.ptp(total_energy(dop853)) < 1e-9
