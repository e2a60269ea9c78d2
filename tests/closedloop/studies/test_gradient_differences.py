"""Derivatives by differences of runs: their errors, kinks, and events that come in another order."""

import numpy as np
import pytest
from test_gradient import ACCELERATION, FORCE, GAP, RESTITUTION, ball, bounces, complex_step, point

import closedloop as cl
from closedloop.studies.gradient import differences, exact
from closedloop.studies.gradient.differences import ROUNDING, Estimate, Happening, Keys, Sample, one_sided, two_sided
from tests.closedloop.linear_loops import MASS


def test_differences_of_an_integrator_that_chooses_its_steps():
    """With dop853, which has no dual numbers, instants of impacts and of the end of a slip are known to 1e-8."""
    falls = ball(time__integrator="dop853", time__duration=0.5)
    found = cl.gradient(falls, ["impact.restitution", "surface.gap"], of=["event_time"])
    by, count = found.derivative["event_time"], found.value["event_time"].size
    assert set(found.method["event_time"].values()) == {differences.DIFFERENCES}
    assert count == 2
    for key, at, closed in (
        ("impact.restitution", RESTITUTION, lambda e: bounces(count, e, GAP, ACCELERATION)),
        ("surface.gap", GAP, lambda h: bounces(count, RESTITUTION, h, ACCELERATION)),
    ):
        np.testing.assert_allclose(by[key], complex_step(closed, at), rtol=1e-8, atol=1e-12)
    v, friction = 0.8, 0.4
    changes = {"friction__kind": "coulomb", "friction__coefficient": friction, "time__integrator": "dop853"}
    changes |= {"time__duration": 0.42}
    found = cl.gradient(point(start__v=[v, 0.0, 0.0], **changes), ["friction.coefficient", "law.force"], ["event_time"])
    stop = MASS * v / (friction * FORCE)
    assert found.derivative["event_time"]["friction.coefficient"] == pytest.approx([-stop / friction], rel=1e-8)
    assert found.derivative["event_time"]["law.force"] == pytest.approx([-stop / FORCE], rel=1e-8)


def test_another_order_of_events_is_named():
    """Where one bounce more begins there are one-sided derivatives alone; beside it there are two-sided ones.

    The second rebound is v ε², the third v ε³: the first that is slower than `impact.rest_speed` is cut.
    """
    speed = np.sqrt(2.0 * ACCELERATION * GAP)
    turn = float(np.sqrt(0.05 / speed))
    key, of = "impact.restitution", "largest_rate_cut"
    expected = 2.0 * speed * turn, 3.0 * speed * turn**2
    at = cl.gradient(ball(impact__restitution=turn), [key], of=[of])
    assert np.isnan(at.derivative[of][key])
    assert len(at.problems) == 1
    assert "impact at" in at.problems[0]
    known = [pair for pair in zip(at.one_sided[of][key], expected, strict=True) if not np.isnan(pair[0])]
    assert known
    assert all(mine == pytest.approx(its, rel=1e-5) for mine, its in known)
    for share, power in ((1.0 - 1e-4, 2), (1.0 + 1e-4, 3)):
        beside = cl.gradient(ball(impact__restitution=share * turn), [key], of=[of])
        assert not beside.problems
        assert beside.derivative[of][key] == pytest.approx(power * speed * (share * turn) ** (power - 1), rel=1e-6)


def test_a_graze_is_named():
    """A mass on the law's spring comes near the plane, touches it, or strikes it, by the speed at which it starts.

    Beside the graze, on either side, it has the derivatives of the closed form, which grow without bound towards it
    where there is an impact. At the graze the side without an impact has one, the other none.
    """
    rate, end, of = 10.0, 0.25, "q@end"
    graze = GAP * rate

    def at(share):
        start = {"start__v": [0.0, 0.0, -(1.0 + share) * graze], "law__kp": [0.0, 0.0, MASS * rate**2]}
        spring = ball(**start, law__force=1e-9, impact__rest_speed=1e-6, time__duration=end)
        found = cl.gradient(spring, ["start.v"], of=[of])
        return found, found.derivative[of]["start.v"][2, 2]

    def rebound(v):
        left = rate * end - np.arcsin(graze / v)
        return GAP * np.cos(left) - RESTITUTION * np.sqrt(v * v - graze * graze) / rate * np.sin(left)

    missed = np.sin(rate * end) / rate
    for share in (-1e-2, -1e-4, 1e-4, 1e-2):
        found, mine = at(share)
        expected = missed if share < 0.0 else complex_step(rebound, (1.0 + share) * graze)
        assert mine == pytest.approx(expected, rel=1e-6)
        assert not found.problems
    for share in (-1e-9, 0.0):
        found, mine = at(share)
        assert np.isnan(mine)
        assert len(found.problems) == 1
        assert "impact at 0.15" in found.problems[0]
        below, above = (each[2, 2] for each in found.one_sided[of]["start.v"])
        assert np.isnan(below)
        assert np.isnan(above) if share == 0.0 else above == pytest.approx(missed, rel=1e-6)


@pytest.mark.parametrize(("share", "named"), [(-1e-3, 0), (0.0, 1), (1e-7, 1), (1e-3, 0)])
def test_a_graze_that_a_step_does_not_resolve_is_named(share, named):
    """A ball that is thrown up to a ceiling touches it for less than a step, or not: its run has no event there."""
    gap, radius = 0.1, 0.05
    up = float((1.0 + share) * np.sqrt(2.0 * 9.81 * gap))
    ball = {"name": "ball", "shape": "ball", "radius": radius, "mass": 1.0, "velocity": [0, 0, up]}
    ceiling = {
        "name": "ceiling",
        "link": "ball",
        "radius": radius,
        "normal": [0, 0, -1],
        "through": [0, 0, gap + radius],
    }
    times = {"duration": 0.2, "step": 0.001, "integrator": "rk4"}
    scenario = {"robot": {"model": "none"}, "body": [ball], "contact": [ceiling], "time": times}
    found = cl.gradient(cl.Scenario.model_validate(scenario), ["body.ball.velocity"], ["q@end"])
    assert len(found.problems) == named
    assert all("gap of ceiling is" in each and "at 0.143 s" in each for each in found.problems)


def test_an_event_that_no_longer_happens_is_named_though_another_run_has_it_past_a_row(monkeypatch):
    """Of the runs on one side one has the event between other rows, and the next has none: there are no differences."""

    def made(*rows):
        return Sample(np.ones(len(rows)), tuple(Happening("release", 0, row) for row in rows), (0.1,) * len(rows))

    monkeypatch.setattr(differences, "samples", lambda changed, *_: [made(4), made(), made(3)] * 2)
    keys = Keys(cl.load_scenario("planar2_drop"), ["law.force"])
    found = differences.along(keys, keys.directions, made(3), lambda run: run, None, lambda *_: None)
    assert all(known.best is None and "release at 0.1 s, no longer happens" in known.why for known in found.values())


def test_the_error_of_a_difference_is_not_below_the_scatter_of_the_runs():
    """Of values that scatter by s the smallest difference, over h/4, scatters by 4 s/h, a one-sided by twice that."""
    h, scatter = 1e-3, np.array([1e-9])
    steps = h * 0.5 ** np.arange(3)[:, None]
    at = np.array([1.0])
    found = two_sided(h, at, at - 2.0 * steps, at + 2.0 * steps, scatter)
    assert found.value == pytest.approx([2.0], rel=1e-9)
    assert found.error == pytest.approx([4.0 * 1e-9 / h], rel=1e-3)
    _, off = one_sided(-h, at, at - 2.0 * steps, scatter)
    assert off == pytest.approx([8.0 * 1e-9 / h], rel=1e-3)
    own = two_sided(h, at, at - 2.0 * steps, at + 2.0 * steps)  # of nothing said, by their rounding
    assert 4.0 * ROUNDING / h <= own.error[0] < 100.0 * ROUNDING / h


def test_a_cubic_has_its_derivative_to_rounding_and_a_kink_two():
    """Extrapolation removes the errors in h² and h⁴; of |x| + x both sides are found, and that there is a kink."""
    h, x = 0.1, 0.5
    steps = h * 0.5 ** np.arange(3)[:, None]
    found = two_sided(h, np.array([x**5]), (x - steps) ** 5, (x + steps) ** 5)
    assert found.value == pytest.approx([5.0 * x**4], rel=1e-12)
    assert not found.kink
    bent = two_sided(h, np.zeros(1), 0.0 * steps, 2.0 * steps)
    assert (bent.below, bent.above) == (pytest.approx(0.0, abs=1e-12), pytest.approx(2.0, rel=1e-12))
    assert bent.kink


def test_a_kink_that_shorter_steps_do_not_see_is_beside_the_point():
    """The better of two estimates is that of the smaller error, but of a kink the one of shorter steps without it."""

    def estimate(error, kink):
        one = np.ones(1)
        return Estimate(error * one, error * one, one, one, np.array([kink]))

    for first, second, taken in (
        ((0.1, False), (0.2, False), 0.1), ((0.2, False), (0.1, False), 0.1), ((0.1, True), (0.2, False), 0.2),
        ((0.1, True), (0.2, True), 0.1), ((0.1, False), (0.2, True), 0.1),
    ):  # fmt: skip
        found = differences.better(estimate(*first), estimate(*second))
        assert found.error == taken
        assert found.kink == (first[1] and second[1])


def test_a_kink_is_named():
    """The largest speed is |v|: at v = 0 it has one derivative on either side."""
    smooth = point(surface__contact="bilateral", time__duration=0.1)
    found = cl.gradient(smooth, ["start.v"], of=["max_tip_speed"])
    assert np.isnan(found.derivative["max_tip_speed"]["start.v"][0])
    below, above = found.one_sided["max_tip_speed"]["start.v"]
    assert below[0] == pytest.approx(-1.0, rel=1e-9)
    assert above[0] == pytest.approx(1.0, rel=1e-9)
    assert "max_tip_speed has no derivative with respect to start.v[0]" in found.problems[0]


def test_a_small_step_does_not_hide_a_wrong_derivative():
    """A derivative that is 0.3 % off is not accepted where the difference is no larger than rounding."""
    for beside, agrees in ((exact.BESIDE[0], False), (exact.BESIDE[1], True)):
        change = np.array([1e-5 * beside])
        noise = exact.NOISE * ROUNDING
        seen, tells = exact.changes_as(1.003 * change, 1.0 - change, np.ones(1), 1.0 + change, noise)
        assert seen == agrees
        assert not tells or not agrees


def test_at_a_bound_there_is_one_side():
    """A coefficient of friction cannot be negative: at 0 the derivative above remains, and the reason is said."""
    smooth = point(surface__contact="bilateral", start__v=[0.5, 0.0, 0.0], friction__kind="coulomb",
                   friction__coefficient=0.0, time__duration=0.1)  # fmt: skip
    found = cl.gradient(smooth, ["friction.coefficient"], of=["q@end"])
    below, above = found.one_sided["q@end"]["friction.coefficient"]
    assert np.isnan(below[0])
    assert above[0] == pytest.approx(-0.5 * ACCELERATION * 0.1**2, rel=1e-6)
    assert "friction.coefficient" in found.problems[0]
