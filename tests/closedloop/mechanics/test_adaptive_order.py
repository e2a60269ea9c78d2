"""Steps of fixed length converge to the adaptive integrator with their own order, through events too.

The adaptive integrator shares the kernels of law, contact and Eq. 24 with them, and the rules of an event; how it
steps, where it finds an event and how it knows what is desired at any instant is its own.
"""

from functools import cache

import numpy as np
import pytest

import closedloop as cl
from robot_models import load


def fading_press(t, q, v, terms):
    """Press with 10 cos 4t N and pull sideways: the surface lets go where the pressing has faded."""
    return terms.bias - 10 * np.cos(4 * t) * terms.jacobian[2] + np.sin(3 * t) * terms.jacobian[0] - 0.3 * v


def press_and_swing(t, q, v, terms):
    """Press with 8 N and swing sideways."""
    return terms.bias - 8 * terms.jacobian[2] + 4 * np.sin(5 * t) * terms.jacobian[0]


# Law, gap, m, restitution, duration, s, and the events that come first.
CASES = {
    "liftoff": (fading_press, 0.0, 0.0, 0.6, ["liftoff"]),
    "touchdown": (press_and_swing, 0.02, 0.0, 0.4, ["touchdown"]),
    "impact": (press_and_swing, 0.02, 0.8, 0.26, ["impact"]),
}
ARMS = {"planar2": "planar2_drop", "wam4": "wam_bounce"}
EACH = [pytest.param(case, arm, marks=[pytest.mark.slow] if arm == "wam4" else []) for case in CASES for arm in ARMS]


@cache
def simulate(case, arm, integrator, step):
    """Return the run of a case."""
    law, gap, restitution, duration, _ = CASES[case]
    changes = {
        "surface.gap": gap,
        "impact.restitution": restitution,
        "stabiliser.kind": "projection",
        "time.integrator": integrator,
        "time.step": step,
        "time.duration": duration,
    }
    return cl.simulate(cl.load_scenario(ARMS[arm], changes), law=law, model=load(arm))


def errors(case, arm, integrator, steps):
    """Return the errors of the first event's time and of the last state, a row for each step."""
    truth, kinds = simulate(case, arm, "dop853", 0.01), CASES[case][4]
    found = []
    for step in steps:
        run = simulate(case, arm, integrator, step)
        for one in (run, truth):
            assert [e.kind for e in one.events][: len(kinds)] == kinds
        state, true_state = (np.concatenate([r.q[-1], r.v[-1]]) for r in (run, truth))
        found.append((abs(run.event_time[0] - truth.event_time[0]), np.max(np.abs(state - true_state))))
    return np.array(found)


@pytest.mark.parametrize(("case", "arm"), EACH)
def test_rk4_converges_with_order_four(case, arm):
    """From 10 ms to 2.5 ms errors fall by 4⁴, in the time of the event as in the state long after it."""
    found = errors(case, arm, "rk4", (0.01, 0.005, 0.0025))
    orders = np.log2(found[0] / found[-1]) / 2
    assert np.all(orders > 3.7), found
    assert np.all(found[-1] < 1e-7), found


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "explicit_euler"])
@pytest.mark.parametrize(("case", "arm"), EACH)
def test_euler_converges_with_order_one(case, arm, integrator):
    """From 5 ms to 1.25 ms errors fall by four."""
    found = errors(case, arm, integrator, (0.005, 0.0025, 0.00125))
    orders = np.log2(found[0] / found[-1]) / 2
    assert np.all(orders > 0.8), found
    assert np.all(found[-1] < (0.01, 0.1)), found


def test_rk4_follows_a_smooth_path_with_order_four():
    """WAM under the paper's law along a path of least jerk: every row of every joint, and the force at the end."""
    changes = {
        "stabiliser.kind": "projection",
        "time.duration": 1.0,
        "reference.timing": "minimum_jerk",
        "reference.start": 0.1,
        "reference.stop": 0.9,
    }
    truth = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.integrator": "dop853", "time.step": 0.004}))
    found = []
    for h in (0.004, 0.002, 0.001):
        run = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.integrator": "rk4", "time.step": h}))
        every = round(0.004 / h)
        found.append(
            [
                np.max(np.abs(run.q[::every] - truth.q)),
                np.max(np.abs(run.contact_force[::every] - truth.contact_force)),
            ]
        )
    found = np.array(found)
    assert np.all(found[:-1] > 13.0 * found[1:]), found
    assert found[-1, 0] < 1e-9
    assert found[-1, 1] < 1e-6


@pytest.mark.slow
def test_wam_slide_is_the_limit_of_short_steps():
    """The paper's slide, shorter, its velocity steps, and the stabiliser: halving the step halves what is missing."""
    changes = {"time.duration": 4.0, "reference.stop": 2.5}
    truth = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.integrator": "dop853", "time.step": 0.001}))
    found = []
    for h in (0.001, 0.0005, 0.00025):
        run = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.step": h}))
        every = round(0.001 / h)
        calm = (np.abs(truth.time - 0.5) > 0.1) & (np.abs(truth.time - 2.5) > 0.1)
        found.append(
            [
                np.max(np.abs(run.q[::every] - truth.q)),
                np.max(np.abs(run.contact_force[::every] - truth.contact_force)[calm]),
                abs(run.contact_force.min() - truth.contact_force.min()),
                abs(run.contact_force.max() - truth.contact_force.max()),
            ]
        )
    found = np.array(found)
    orders = np.log2(found[0] / found[-1]) / 2
    assert np.all(orders[:2] > 0.95), found
    assert np.all(orders[:2] < 1.1), found
    assert np.all(found[-1, 2:] < 1e-4), found


@pytest.mark.slow
def test_shipped_touchdown_and_liftoff_are_the_limit_of_short_steps():
    """WAM comes down, bounces and presses; WAM is drawn off: RK4's events go to the adaptive integrator's."""
    for name, duration in (("wam_touchdown", 2.4), ("wam_liftoff", 2.0)):
        changes = {"stabiliser.kind": "projection", "time.duration": duration}
        truth = cl.simulate(cl.load_scenario(name, changes | {"time.integrator": "dop853", "time.step": 0.004}))
        worst = []
        for h in (0.004, 0.001):
            run = cl.simulate(cl.load_scenario(name, changes | {"time.integrator": "rk4", "time.step": h}))
            assert [e.kind for e in run.events][: len(truth.events)] == [e.kind for e in truth.events]
            times = run.event_time[: len(truth.events)]
            q = run.q[:: round(0.004 / h)]
            worst.append([np.max(np.abs(times - truth.event_time)), np.max(np.abs(q - truth.q))])
        assert worst[1][1] < 1e-8
        assert worst[1][0] < 2e-7
        assert worst[0][1] > 100 * worst[1][1]
