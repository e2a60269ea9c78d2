"""The energy that the arm is given, integrated with the run: what the balance leaves over is the run's own error."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report import energy_balance


def left_over(**changes):
    """Return the largest energy unaccounted for of a drop with impacts, J, and the run."""
    run = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.7, "stabiliser.kind": "none"} | changes))
    return float(np.max(np.abs(energy_balance(run)[0]))), run


@pytest.mark.parametrize(("scheme", "order"), [("semi_implicit_euler", 1), ("rk4", 4)])
def test_what_is_left_over_falls_with_the_order_across_impacts(scheme, order):
    """A drop with a drive that brakes and two impacts: half the step leaves 2 or 16 times less."""
    left = []
    for step in (0.004, 0.002):
        off, run = left_over(**{"time.integrator": scheme, "time.step": step, "time.duration": 0.44})
        assert [event.kind for event in run.events] == ["impact", "impact"]
        assert np.sum(run.event_energy_lost) > 0.25
        left.append(off)
    assert left[0] / left[1] == pytest.approx(2**order, rel=0.3)
    assert left[1] < (0.1 if order == 1 else 1e-8)


def test_the_adaptive_integrator_leaves_rounding():
    """With dop853 at 1e-12 what is left is 1e-12 J of the 0.6 J exchanged, whatever the rows and the impacts."""
    off, run = left_over(**{"time.integrator": "dop853", "time.step": 0.01})
    assert len(run.events) >= 2
    assert off < 1e-11


def test_an_impact_at_the_start_is_accounted_for():
    """A tip that starts on the surface and moves into it loses 0.09 J before the first row."""
    off, run = left_over(**{"surface.gap": 0.0, "start.v": [-0.5, -0.5], "time.duration": 0.1})
    assert run.event_time[0] == 0.0
    assert run.event_energy_lost[0] > 0.05
    assert off < 1e-9


def starting(kind, engine, **changes):
    """Return the run of an arm of which the tip, a contact of a link or a joint strikes at t = 0."""
    values = {"time.duration": 0.02, "law.force": 0.0, "stabiliser.kind": "none", "time.integrator": "rk4"} | changes
    if kind == "tip":
        values |= {"surface.gap": 0.0, "start.v": [-0.5, -0.5]}
    elif kind == "stop":
        values |= {"robot.stops": True, "start.q": [0.0, 0.0, -10.0], "start.v": [0.5, 0.0, -2.0], "surface.gap": 5.0}
        values |= {"law.kp": 0, "law.kd": 0, "reference.kind": "hold", "surface.contact": "unilateral"}
        values |= {"robot.model": "pointmass3", "robot.stop_restitution": 0.5}
    else:
        values |= {"start.v": [-0.5, -0.5], "surface.gap": 50.0, "time.step": 1e-3, "law.kp": 0, "law.kd": 0}
        drop = cl.load_scenario("planar2_drop")
        tip = cl.prepare(drop).robot.terms(np.array(drop.start.q), np.zeros(2)).position
        values["contact"] = [{"link": "tip", "through": [0, 0, float(tip[2])], "restitution": 0.4}]
    return cl.simulate(cl.load_scenario("planar2_drop", values), engine=engine)


@pytest.mark.parametrize("engine", ["compiled", "pinocchio", "dop853"])
@pytest.mark.parametrize("kind", ["tip", "contact", "stop"])
def test_the_balance_closes_from_row_0_after_an_impact_at_the_start(kind, engine):
    """E(k) − E(0) is the energy supplied, in every row: it was off by what the impact at t = 0 took."""
    changes = {"time.integrator": "dop853"} if engine == "dop853" else {}
    run = starting(kind, "pinocchio" if changes else engine, **changes)
    assert run.event_time[0] < 1e-12
    assert run.event_energy_lost[0] > 0.05
    energy = run.kinetic_energy + run.potential_energy
    assert run.energy_supplied[0] == 0.0
    np.testing.assert_allclose(energy - energy[0], run.energy_supplied, rtol=0.0, atol=1e-8)


def test_supplied_is_the_sum_of_what_the_rows_say():
    """Without events it is the power of the rows, by the trapezoidal rule, to the square of the step."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.integrator": "rk4", "time.duration": 0.6}))
    power = np.sum((run.torque + run.joint_friction) * run.v, axis=1) + run.contact_force * run.closure_rate
    power += np.sum(run.friction_force * run.velocity, axis=1)
    smooth = slice(0, 500)  # up to the step of the path's velocity
    assert abs(np.trapezoid(power[smooth], run.time[smooth]) - run.energy_supplied[499]) < 1e-12
    rest = np.trapezoid(power[510:], run.time[510:])
    assert run.energy_supplied[-1] - run.energy_supplied[510] == pytest.approx(rest, rel=1e-3)
    assert abs(rest) > 1e-4
