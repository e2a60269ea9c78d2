"""The energy that the arm is given, integrated with the run: what the balance leaves over is the run's own error."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.report import energy_balance


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
