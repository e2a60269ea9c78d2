"""Motions with many contacts: a box on feet that slides and turns, faces that land, a block that rocks to rest.

The box is a body on three prismatic and three revolute joints, the block one on two and one.
"""

import numpy as np
import pytest
from boxes import FEET, FOUR, HALF, G, drop_in_any_pose, simulate
from budget import budget

import closedloop as cl
from closedloop.record.report.summary import share_not_determined
from closedloop.record.report.tables import report_rows


def examine(run, mu, gap, rise=1e-8):
    """Forces press and are in their cones, nothing is deeper than this gap, m, and no energy comes from nowhere.

    A step may add `rise` of it, by the error of rk4, but where joints turn faster than that resolves: the three of a
    box that lies on its side have nearly parallel axes, and rates of hundreds of rad/s.
    """
    f = run.link_forces
    rub = np.hypot(*np.moveaxis(run.link_frictions.reshape(*f.shape, 2), -1, 0))
    size = np.maximum(1.0, f.max(axis=1, initial=0.0))[:, None]
    assert np.min(f) >= 0.0
    assert np.max((rub - mu * f) / size) < 1e-9
    assert np.min(run.link_gaps) > gap
    energy = run.kinetic_energy + run.potential_energy
    rate = np.max(np.abs(run.v), axis=1)
    resolved = np.maximum(rate[1:], rate[:-1]) * np.diff(run.time) < 0.05
    assert np.mean(resolved) > 0.95
    assert np.max(np.diff(energy)[resolved]) < rise * max(1.0, np.ptp(energy))
    assert np.all(run.event_energy_lost >= -1e-12)


@pytest.mark.parametrize("mu", [0.01, pytest.param(0.3, marks=pytest.mark.slow), 0.5])
def test_a_box_slides_and_turns_on_four_feet(tmp_path, mu):
    """It comes to rest; its friction takes its energy; while all slide, as the forces say: Newton's law of the box.

    The four normal forces have a sum and two moments, and are three numbers for four: those of least norm, which are
    recomputed here by non-negative least squares from the feet's places and slips alone.
    """
    run = simulate(tmp_path, HALF, FOUR, ([0, 0, 0.05, 0, 0, 0], [0.2, 0, 0, 0, 0, 1.0]), mu)
    examine(run, mu, -1e-9)
    f, slip = run.link_forces, run.link_slips
    # a slip that friction can turn or end within the step has friction against where it goes in the step
    fast = np.linalg.norm(slip.reshape(len(slip), -1, 2), axis=2) > 3.0 * mu * G * 1e-3
    sliding = np.flatnonzero(np.all((run.link_modes == 1) & fast, axis=1))
    assert len(sliding) > 10
    np.testing.assert_allclose(np.sum(f, axis=1), G, rtol=1e-6)
    for k in sliding[:: len(sliding) // 5]:
        turn = np.array([[np.cos(run.q[k, 5]), -np.sin(run.q[k, 5])], [np.sin(run.q[k, 5]), np.cos(run.q[k, 5])]])
        at = FOUR[:, :2] @ turn.T
        u = run.v[k, :2] + run.v[k, 5] * np.stack([-at[:, 1], at[:, 0]], axis=1)
        np.testing.assert_allclose(np.hypot(*slip[k].reshape(4, 2).T), np.linalg.norm(u, axis=1), atol=1e-8)
        rub = -mu * u / np.linalg.norm(u, axis=1)[:, None]
        # moments about the centre, of f at (x, y) and of friction at 0.05 m below it: none, for it does not tip
        rows = np.stack([np.ones(4), at[:, 1] + 0.05 * rub[:, 1], -at[:, 0] - 0.05 * rub[:, 0]])
        expected = np.linalg.pinv(rows) @ [G, 0.0, 0.0]
        assert np.min(expected) > 0.0
        np.testing.assert_allclose(f[k], expected, atol=1e-5)
    if mu > 0.1:
        assert np.all(run.link_modes[-1] == 2)
        assert np.max(np.abs(run.v[-1])) < 1e-9


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", pytest.param("dop853", marks=pytest.mark.slow)])
def test_every_integrator_slides_and_turns_alike(tmp_path, integrator):
    """The box ends where rk4 has it: to 5e-7 by another of high order, to a step's way, 0.5 mm, by that of first.

    rk4 turns friction to where slow slips are at the end of the step, which is 3.5e-7 rad at 1 ms.
    """
    start, changes = ([0, 0, 0.05, 0, 0, 0], [0.3, 0, 0, 0, 0, 0.5]), {"time.duration": 0.3}
    other = simulate(tmp_path, HALF, FOUR, start, 0.3, **changes, **{"time.integrator": integrator})
    exact = simulate(tmp_path, HALF, FOUR, start, 0.3, **changes)
    assert np.all(other.link_modes[-1] == 2)
    np.testing.assert_allclose(other.q[-1], exact.q[-1], atol=5e-7 if integrator == "dop853" else 5e-4)


def test_a_slide_that_turns_on_four_corners_ends_alike_in_both_engines():
    """At one instant, with one share of the forces until then: engines that differ by rounding differ by no more."""
    # Before, the forces of the last step were any of many: 3e-3 m/s and 0.6 N apart, at rows near the end.
    box = {"name": "box", "shape": "box", "mass": 1.304, "edges": [0.13, 0.157, 0.104], "position": [0.0, 0.0, 0.052]}
    box |= {"velocity": [0.02, 0.14, 0.0], "spin": [0.0, 0.0, 0.345]}
    floor = {"link": "box", "at": "collision", "friction": 0.3}
    turntable = {"kind": "turntable", "speed": -0.5, "centre": [0.2, 0.27, 0.0]}
    scenario = {"robot": {"model": "none"}, "body": [box], "contact": [floor], "surface_motion": turntable}
    scenario["time"] = {"duration": 0.12, "step": 0.001, "integrator": "rk4"}
    one, other = (cl.simulate(cl.Scenario.model_validate(scenario), engine=e) for e in ("compiled", "pinocchio"))
    assert [event.kind for event in one.events] == [event.kind for event in other.events]
    assert "stick" in {event.kind for event in one.events}
    np.testing.assert_allclose(one.event_time, other.event_time, atol=1e-9)
    np.testing.assert_allclose(one.v, other.v, atol=1e-8)
    np.testing.assert_allclose(one.link_forces, other.link_forces, atol=1e-5)


def draw(rng, feet):
    """Return half sides, feet, a pose above the floor with a velocity, μ and e, at random."""
    half = np.array(HALF) * np.exp(rng.uniform(-0.5, 0.5, size=3))
    at = FEET[feet] / HALF * half
    tilt = 0.25 if feet < 8 else 1.2
    x, y, z = rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt), rng.uniform(-3.0, 3.0)
    turn = np.eye(3)
    for angle, (a, b) in ((z, (0, 1)), (y, (2, 0)), (x, (1, 2))):
        one = np.eye(3)
        one[[a, b], [a, b]], one[a, b], one[b, a] = np.cos(angle), -np.sin(angle), np.sin(angle)
        turn = one @ turn
    height = 10 ** rng.uniform(-4.0, -1.5) - np.min(at @ turn[2])
    v = np.concatenate([rng.normal(size=3) * 0.5, rng.normal(size=3) * (0.2, 0.2, 1.0)])
    return (
        half,
        at,
        ([0.0, 0.0, height, x, y, z], v),
        rng.choice([0.0, 0.05, 1.0, rng.uniform()]),
        rng.uniform(0.0, 0.9),
    )


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, budget(4, 30)))])
@pytest.mark.parametrize("feet", FEET)
def test_a_box_that_is_dropped_comes_to_rest(tmp_path, feet, seed):
    """With whatever pose, velocity, friction and restitution; without friction it may go on along the floor.

    At steps of 1 ms energy rises by 8.6e-8 J at most (4 feet, seed 9), of which rk4 leaves
    less at shorter steps; at a quarter of that step, by 3e-9 J.
    """
    half, at, start, mu, e = draw(np.random.default_rng([seed, feet]), feet)
    run = simulate(tmp_path, half, at, start, mu, e, **{"time.duration": 4.0})
    examine(run, mu, -1e-6, rise=1e-7)
    assert len(run.events) < 5000
    assert np.min(run.link_gaps[-1]) > -1e-9
    assert np.max(np.ptp(run.link_gaps[-20:], axis=0)) < 1e-9
    if mu > 0.04:
        assert np.max(np.abs(run.v[-1])) < 1e-6


@pytest.mark.parametrize(
    ("feet", "seed", "duration"),
    [
        (5, 82, 0.06),  # one foot slides until pressing harder pulls it in: its force grows, and stops it before
        (8, 224, 0.06),  # ... and an impulse stops it
        (8, 86, 1.0),  # rates of its joints of thousands of rad/s, near a pose in which two have one axis
        *(pytest.param(4 + (k % 2), k, 4.0, marks=pytest.mark.slow) for k in range(budget(4, 20))),
        *(pytest.param(8, k, 4.0, marks=pytest.mark.slow) for k in range(budget(4, 20))),
    ],
)
def test_a_box_dropped_in_any_pose_goes_on(tmp_path, feet, seed, duration):
    """Nothing pulls or leaves its cone, and the error of a step is what is deeper than a touch or rises in energy."""
    half, at, start, mu, e = drop_in_any_pose(feet, seed)
    run = simulate(tmp_path, half, at, start, mu, e, **{"time.duration": duration})
    assert run.stopped is None
    examine(run, mu, -2e-7, rise=1e-6)


def test_shares_that_are_not_determined_are_told(tmp_path):
    """A box on four feet may share its weight in many ways, on three without friction in one; the report says so."""
    start = ([0, 0, 0.05, 0, 0, 0], [0, 0, 0, 0, 0, 0])
    four = simulate(tmp_path, HALF, FOUR, start, 0.3, **{"time.duration": 0.005})
    assert share_not_determined(four) == (0.0, 12, 6)
    said = {row[0]: row for row in report_rows(four)}["share of each contact not determined"]
    assert said[1:] == ("from 0", "s", "6 of 12 rows are independent; the forces of least norm are recorded")
    three = [[0.1, 0.0, -0.05], [-0.1, 0.05, -0.05], [-0.1, -0.05, -0.05]]
    three = simulate(tmp_path, HALF, three, start, 0.0, **{"time.duration": 0.005})
    assert share_not_determined(three) is None


def test_what_soft_contacts_bear_is_determined():
    """It follows from how deep they are: of a tower on soft feet 10 of 28 forces were told not unique."""
    soft = {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 40.0}
    for among, found in (("*", None), (0, (0.0, 57, 30))):
        tower = cl.load_scenario("tower", {"time.duration": 0.004, f"contact.{among}.compliance": soft})
        assert share_not_determined(cl.simulate(tower, engine="compiled")) == found
