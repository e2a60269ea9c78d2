"""A ball of 2 kg that bounces on the ground, against its closed form.

From height h it arrives after t1 = √(2h/g) with g t1; each bounce keeps the share ε of the speed, so flight k lasts
2 εᵏ t1 and bouncing ends at t1 (1 + ε)/(1 − ε), the Zeno time. g = 9.81 m/s². A ballistic arc is a parabola, which RK4
follows exactly, whatever the step.
"""

import numpy as np
import pytest

import closedloop as cl

GRAVITY, MASS = 9.81, 2.0


def weightless_law(t, q, v, terms):
    """Return no torque at all: gravity alone acts."""
    return np.zeros(3)


def drop(height=1.0, restitution=0.9, **changes):
    """Return the run of a ball let go at this height, m; the ground is at 0, where rounding is smallest."""
    scenario = {
        "robot.model": "pointmass3",
        "surface.offset": 0.0,
        "surface.gap": 0.0,
        "start.q": [0.0, 0.0, height],
        "start.v": None,
        "impact.restitution": restitution,
        "impact.rest_speed": 1e-4,
        "stabiliser.kind": "projection",
        "time.integrator": "rk4",
        "time.step": 0.01,
        "time.duration": 9.5,
    }
    return cl.simulate(cl.load_scenario("planar2_drop", scenario | changes), law=weightless_law)


@pytest.fixture(scope="module")
def ball():
    """Return the run of h = 1 m, ε = 0.9."""
    return drop()


def impacts(height, restitution, count):
    """Return the times, s, of the first impacts, and their speeds, m/s."""
    first = np.sqrt(2 * height / GRAVITY)
    shares = restitution ** np.arange(count)
    return first * (1 + 2 * np.concatenate([[0.0], np.cumsum(shares[1:])])), GRAVITY * first * shares


# Height, m, restitution, Zeno time, s, and path until the ball rests, m: √(2h/g) (1 + ε)/(1 − ε) and
# h (1 + ε²)/(1 − ε²) at g = 9.81 m/s², once evaluated and frozen. The first case is the bouncing ball in the tests of
# Siconos (bouncing_ball.cpp: h = 1 m, ε = 0.9).
CLOSED_FORM = [
    (1.0, 0.9, 8.578949178728887, 9.526315789473687),
    (1.0, 0.5, 1.3545709229571927, 1.6666666666666667),
    (5.0, 0.8, 9.086737992230741, 22.77777777777779),
]


@pytest.mark.parametrize(("height", "restitution", "zeno", "path"), CLOSED_FORM)
def test_bounces_are_those_of_the_closed_form(height, restitution, zeno, path, ball):
    """Times and speeds of all impacts, the Zeno time and the path with what the cut leaves out, are the closed form's.

    To 1e-10. Bouncing is cut where a bounce would leave with less than rest_speed: with the speed c then cut off, the
    bounces to come would last 2 (c/g)(1 + ε + ε² + ...) = 2 c/(g (1 − ε)), and go up and down by
    2 (c²/2g)(1 + ε² + ε⁴ + ...) = c²/(g (1 − ε²)).
    """
    run = ball if (height, restitution) == (1.0, 0.9) else drop(height, restitution)
    times, speeds = impacts(height, restitution, len(run.events))
    assert zeno == pytest.approx(np.sqrt(2 * height / GRAVITY) * (1 + restitution) / (1 - restitution), rel=1e-15)
    assert np.max(np.abs(run.event_time - times)) < 1e-10
    assert np.max(np.abs(run.event_rate_before + speeds)) < 1e-10
    last = run.events[-1]
    assert last.time + 2 * last.rate_cut / (GRAVITY * (1 - restitution)) == pytest.approx(zeno, abs=1e-10)
    bounced = height + np.sum(run.event_rate_after[:-1] ** 2) / GRAVITY
    assert bounced + last.rate_cut**2 / (GRAVITY * (1 - restitution**2)) == pytest.approx(path, abs=1e-10)


def test_every_bounce_is_an_impact_but_the_last(ball):
    """Bounces are impacts that keep ε; the first that would leave slower than rest_speed is the touchdown."""
    assert [e.kind for e in ball.events[:-1]] == ["impact"] * (len(ball.events) - 1)
    assert ball.events[-1].kind == "touchdown"
    assert ball.event_rate_after[:-1] == pytest.approx(-0.9 * ball.event_rate_before[:-1], rel=1e-13)
    assert np.all(ball.event_rate_after[:-1] >= 1e-4)
    assert ball.events[-1].rate_after == 0.0
    assert 0.0 < ball.events[-1].rate_cut < 1e-4
    assert ball.events[-1].rate_cut == pytest.approx(-0.9 * ball.events[-1].rate_before, rel=1e-13)


def test_an_impact_takes_the_energy_and_gives_the_impulse_of_the_closed_form(ball):
    """An impact costs (1 − ε²)/2 m u² and its two phases are m u and ε m u; the touchdown keeps nothing."""
    speed = -ball.event_rate_before
    assert ball.event_energy_lost[:-1] == pytest.approx((1 - 0.81) / 2 * MASS * speed[:-1] ** 2, rel=1e-12)
    assert ball.events[-1].energy_lost == pytest.approx(0.5 * MASS * speed[-1] ** 2, rel=1e-12)
    assert ball.event_compression == pytest.approx(MASS * speed, rel=1e-13)
    assert ball.event_decompression[:-1] == pytest.approx(0.9 * MASS * speed[:-1], rel=1e-13)
    assert ball.events[-1].decompression == 0.0
    assert np.all(ball.event_tangential == 0.0)
    total = ball.kinetic_energy + ball.potential_energy
    assert np.sum(ball.event_energy_lost) == pytest.approx(total[0] - total[-1], abs=1e-10)


def test_every_flight_rises_to_its_height(ball):
    """At every row of flight k the ball's height of rise, e + ė²/2g, is ε²ᵏ h."""
    flight = np.searchsorted(ball.event_time, ball.time)
    free = ball.mode == 0
    assert free.sum() > 800
    rise = ball.closure_error + ball.closure_rate**2 / (2 * GRAVITY)
    assert np.max(np.abs(rise - 0.9 ** (2 * flight))[free]) < 1e-10


def test_after_the_last_bounce_the_ball_lies_still(ball):
    """At rest the ground carries the weight, m g = 19.62 N, and nothing moves."""
    at_rest = ball.time > ball.events[-1].time
    assert at_rest.sum() > 50
    assert np.all(ball.mode[at_rest] == 1)
    assert np.all(ball.mode[~at_rest] == 0)
    assert ball.contact_force[at_rest] == pytest.approx(MASS * GRAVITY, rel=1e-14)
    assert np.all(ball.contact_force[~at_rest] == 0.0)
    assert np.max(np.abs(ball.closure_error[at_rest])) < 1e-14
    assert np.max(np.abs(ball.velocity[at_rest])) < 1e-14


@pytest.mark.parametrize("step", [0.1, 0.025, 0.004])
def test_times_do_not_depend_on_the_step(step):
    """A step that holds many bounces, and one that holds few, find the same bounces to 1e-10."""
    run = drop(restitution=0.5, **{"time.step": step, "time.duration": 2.0})
    times, _ = impacts(1.0, 0.5, len(run.events))
    assert len(run.events) == 16  # 4.43 · 0.5ᵏ m/s is below 1e-4 m/s from k = 16 on: the sixteenth bounce is cut
    assert np.max(np.abs(run.event_time - times)) < 1e-10


def test_a_perfect_bounce_keeps_its_energy_for_ever():
    """With ε = 1 the ball never rests, every bounce takes nothing, and every flight is like the first."""
    run = drop(restitution=1.0)
    times, _ = impacts(1.0, 1.0, len(run.events))
    assert len(run.events) == 11
    assert np.all(run.event_kind == 1)
    assert np.max(np.abs(run.event_time - times)) < 1e-10
    assert np.max(np.abs(run.event_energy_lost)) < 1e-12
    assert np.all(run.mode == 0)
    total = run.kinetic_energy + run.potential_energy
    assert np.max(np.abs(total - total[0])) < 1e-10


def test_without_restitution_the_ball_rests_at_once():
    """With ε = 0 the first meeting is a touchdown that takes all the kinetic energy, m g h, and cuts nothing."""
    run = drop(restitution=0.0, **{"time.duration": 1.0})
    (event,) = run.events
    assert event.kind == "touchdown"
    assert event.time == pytest.approx(np.sqrt(2 / GRAVITY), abs=1e-13)
    assert event.energy_lost == pytest.approx(MASS * GRAVITY, rel=1e-12)
    assert event.rate_cut == 0.0
    assert event.rate_after == 0.0
    assert run.contact_force[-1] == pytest.approx(MASS * GRAVITY, rel=1e-14)


@pytest.mark.parametrize(("integrator", "sign"), [("semi_implicit_euler", -1), ("explicit_euler", 1)])
def test_euler_is_off_by_what_its_own_arcs_say(integrator, sign):
    """With an Euler scheme of step h the first bounces are where its arcs, which are no parabolas, take the ball.

    Both schemes have the velocity of free fall exactly, and q̇²/2 + g q ± h g q̇/2 in place of the energy. So the ball
    arrives h/2 early (late) and g h/2 slow (fast), a flight that leaves with speed u returns with u ∓ g h, and lasts as
    long as gravity takes for that. What follows for the later bounces holds up to second order and a piece of a step
    after each event.
    """
    for step in (0.004, 0.001):
        run = drop(restitution=0.8, **{"time.integrator": integrator, "time.step": step, "time.duration": 3.0})
        times, speeds = impacts(1.0, 0.8, 4)
        late, fast = 0.5 * step, 0.5 * step * GRAVITY
        for k in range(4):
            assert run.event_time[k] - times[k] == pytest.approx(sign * late, abs=0.1 * step)
            assert -run.event_rate_before[k] - speeds[k] == pytest.approx(sign * fast, abs=0.1 * step * GRAVITY)
            late += 2 * 0.8 * fast / GRAVITY + step
            fast = 0.8 * fast + step * GRAVITY
