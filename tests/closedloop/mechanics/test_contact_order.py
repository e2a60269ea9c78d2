"""Events keep the order of the integrator: every piece of a step before and after an event is a full step of it.

The error is that against the same run in much smaller steps of RK4; the motions are smooth but for their events.
"""

import numpy as np
import pytest

import closedloop as cl
from robot_models import load


def rising_pull(t, q, v, terms):
    """Press with 10 cos 4t N and pull sideways: the surface lets go where the pressing has faded."""
    return terms.bias - 10 * np.cos(4 * t) * terms.jacobian[2] + np.sin(3 * t) * terms.jacobian[0] - 0.3 * v


def press_and_swing(t, q, v, terms):
    """Press with 8 N and swing sideways."""
    return terms.bias - 8 * terms.jacobian[2] + 4 * np.sin(5 * t) * terms.jacobian[0]


# Law, gap, m, restitution, and the events that follow.
CASES = {
    "liftoff": (rising_pull, 0.0, 0.0, ["liftoff"]),
    "touchdown": (press_and_swing, 0.02, 0.0, ["touchdown"]),
    "bounces": (press_and_swing, 0.02, 0.8, ["impact", "impact"]),
}
# Ends, s, in the middle of a smooth part.
DURATION = {
    ("liftoff", "planar2"): 0.6,
    ("liftoff", "wam4"): 0.6,
    ("touchdown", "planar2"): 0.4,
    ("touchdown", "wam4"): 0.4,
    ("bounces", "planar2"): 0.26,
    ("bounces", "wam4"): 0.35,
}


@pytest.fixture(scope="module")
def simulated():
    """Return a function that simulates one of the cases with one arm, integrator, step and stabiliser."""
    arms = {name: load(name) for name in ("planar2", "wam4")}
    known = {}

    def simulate(case, arm, integrator, step, stabiliser):
        law, gap, restitution, _ = CASES[case]
        key = (case, arm, integrator, step, stabiliser)
        if key not in known:
            scenario = {
                "surface.gap": gap,
                "impact.restitution": restitution,
                "stabiliser.kind": stabiliser,
                "time.integrator": integrator,
                "time.step": step,
                "time.duration": DURATION[case, arm],
            }
            start = "planar2_drop" if arm == "planar2" else "wam_bounce"
            known[key] = cl.simulate(cl.load_scenario(start, scenario), law=law, model=arms[arm])
        return known[key]

    return simulate


FINEST = 0.0025 / 8  # s, of what errors are measured against: an eighth of rk4's shortest step


def errors(simulated, case, arm, integrator, steps, stabiliser):
    """Return the errors of the time of the first events and of the last state, a row for each step."""
    fine = simulated(case, arm, "rk4", FINEST, stabiliser)
    kinds = CASES[case][3]
    found = []
    for step in steps:
        run = simulated(case, arm, integrator, step, stabiliser)
        assert [e.kind for e in run.events][: len(kinds)] == kinds
        state, truth = (np.concatenate([r.q[-1], r.v[-1]]) for r in (run, fine))
        late = run.event_time[: len(kinds)] - fine.event_time[: len(kinds)]
        found.append((np.max(np.abs(late)), np.max(np.abs(state - truth))))
    return np.array(found)


RK4 = [
    pytest.param(case, arm, stabiliser, marks=[pytest.mark.slow] if arm == "wam4" else [])
    for case in CASES
    for arm in ("planar2", "wam4")
    for stabiliser in ("none", "projection")
]


@pytest.mark.parametrize(("case", "arm", "stabiliser"), RK4)
def test_rk4_keeps_its_fourth_order_through_events(case, arm, stabiliser, simulated):
    """A step half as long makes the times of the events and the state after them 16 times more exact.

    The order is the slope over a factor of four. The instant of a liftoff is then within what instants are sought to,
    1e-14 s, so it may seem to be of a higher one.
    """
    found = errors(simulated, case, arm, "rk4", (0.01, 0.005, 0.0025), stabiliser)
    orders = np.log2(found[0] / found[-1]) / 2
    assert np.all(orders > 3.7), found
    assert np.all(orders < 5.0), found


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "explicit_euler"])
@pytest.mark.parametrize("case", CASES)
def test_euler_keeps_its_first_order_through_events(case, integrator, simulated):
    """A step half as long halves the errors of an Euler scheme."""
    found = errors(simulated, case, "planar2", integrator, (0.005, 0.0025, 0.00125), "none")
    orders = np.log2(found[0] / found[-1]) / 2
    assert np.all(orders > 0.8), found
    assert np.all(orders < 1.3), found
