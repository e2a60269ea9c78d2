"""Events inside a step: many of them, a graze, what only comes near, held laws, and the way to a file and back.

The ball of 2 kg over the ground at z = 0: its gravity is taken away by the law and replaced by what the test needs.
"""

import numpy as np
import pytest
from contact_history import assert_one_story
from rounding import within

import closedloop as cl
from robot_models import load

MODEL = load("pointmass3")
ARMS = {name: load(name) for name in ("planar2", "wam4")}
GRAVITY, MASS = 9.81, 2.0


def simulate(force, height, rate=0.0, **changes):
    """Return the run of the ball under a vertical force, N: force(t, z, ż), from this height, m, and rate, m/s."""
    scenario = {
        "robot.model": "pointmass3",
        "surface.offset": 0.0,
        "surface.gap": 0.0,
        "start.q": [0.0, 0.0, height],
        "start.v": [0.0, 0.0, rate],
        "impact.restitution": 0.5,
        "stabiliser.kind": "projection",
        "time.integrator": "rk4",
        "time.step": 0.1,
        "time.duration": 1.0,
    }

    def law(t, q, v, terms):
        return terms.bias + np.array([0.0, 0.0, force(t, terms.position[2], terms.jacobian[2] @ v)])

    return cl.simulate(cl.load_scenario("planar2_drop", scenario | changes), law=law, model=MODEL)


def bounces(height, restitution, count):
    """Return the times of the first impacts of a ball that falls from this height."""
    first = np.sqrt(2 * height / GRAVITY)
    return first * (1 + 2 * np.concatenate([[0.0], np.cumsum(restitution ** np.arange(1, count))]))


def test_many_events_in_one_step_are_all_found():
    """A step in which the ball bounces to rest holds all its impacts, at the times of the closed form."""
    run = simulate(lambda t, z, rate: -MASS * GRAVITY, 0.05, **{"time.step": 0.5})
    times = bounces(0.05, 0.5, len(run.events))
    assert times[-1] < 0.5
    assert len(run.events) == 14  # 0.99 · 0.5ᵏ m/s is below rest_speed, 1e-4 m/s, from k = 14 on: that bounce is cut
    assert np.max(np.abs(run.event_time - times)) < 1e-11
    assert run.mode.tolist() == [0, 1, 1]
    assert run.contact_force[1:] == pytest.approx(MASS * GRAVITY, rel=1e-13)


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9])
def test_a_dip_inside_a_step_is_an_impact(depth):
    """A tip that would dip into the surface and be out again by the end of the step meets it where the parabola does.

    It comes down at 0.4 m/s and is accelerated upwards by a = 10 m/s²: z = z0 − 0.4 t + 5 t², lowest at t = 40 ms, in a
    step of 100 ms at whose end it is higher than at its beginning.
    """
    start = 0.008 - depth
    run = simulate(lambda t, z, rate: 10.0 * MASS, start, -0.4, **{"impact.rest_speed": 1e-6})
    assert start - 0.04 + 0.05 > start
    first = run.events[0]
    # The smaller root of z0 − 0.4 t + 5 t² = 0, and the rate there.
    fast = np.sqrt(0.16 - 20 * start)
    assert first.kind == "impact"
    assert first.time == pytest.approx((0.4 - fast) / 10, abs=1e-14 + 2e-17 / fast)
    assert first.rate_before == pytest.approx(-fast, rel=1e-6)
    assert first.rate_after == pytest.approx(0.5 * fast, rel=1e-6)
    assert len(run.events) == 1
    t = run.time[1] - first.time
    assert run.closure_error[1] == pytest.approx(first.rate_after * t + 5 * t**2, abs=1e-9)


@pytest.mark.parametrize("clearance", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
def test_a_tip_that_only_comes_near_has_no_event(clearance, integrator):
    """The same parabola, its lowest point off the surface, has no event; the run is a free tip's to the bit."""
    step = 0.1 if integrator == "rk4" else 0.001
    # The parabola falls by 8 mm. The Euler scheme's arc, q₃₉ = z0 − 7.8 mm, then −0.01 τ + 10 τ², falls by 7.8025 mm.
    start = clearance + (0.008 if integrator == "rk4" else 0.0078025)
    changes = {"time.step": step, "time.duration": 0.1, "time.integrator": integrator}
    run = simulate(lambda t, z, rate: 10.0 * MASS, start, -0.4, **changes)
    far = simulate(lambda t, z, rate: 10.0 * MASS, start, -0.4, **changes | {"surface.offset": -1.0})
    assert run.events == ()
    assert np.all(run.mode == 0)
    assert np.array_equal(run.q, far.q)
    assert np.array_equal(run.v, far.v)


def test_a_dip_is_found_in_steps_of_first_order_too():
    """Semi-implicit Euler finds the dip where its rows show it: at z0 − 0.4 k h + a h² k (k + 1) / 2.

    With h = 20 ms the lowest are z0 − 4 mm, for k = 1 and 2: from 3.5 mm the tip meets the surface in the first step,
    where 0.0035 − 0.4 t + 10 t² is zero. What such a scheme does between two rows that are off the surface is no
    motion, and has no event.
    """
    changes = {"time.integrator": "semi_implicit_euler", "time.duration": 0.1, "time.step": 0.02}
    run = simulate(lambda t, z, rate: 10.0 * MASS, 0.0035, -0.4, **changes)
    assert run.events[0].kind == "impact"
    assert within(512, run.events[0].time, (0.4 - np.sqrt(0.16 - 0.14)) / 20, 1.0)
    assert np.min(run.closure_error) > -1e-13
    assert simulate(lambda t, z, rate: 10.0 * MASS, 0.0045, -0.4, **changes).events == ()


def test_liftoff_at_an_instant_inside_a_step():
    """A force that presses with 10 N − 30 N/s t lets go at 1/3 s, and the ball then rises as t³."""
    run = simulate(lambda t, z, rate: -10.0 + 30.0 * t, 0.0)
    (event,) = run.events
    assert event.kind == "liftoff"
    assert within(512, event.time, 1 / 3, 1.0)
    after = run.time > 1 / 3
    t = run.time[after] - 1 / 3
    assert within(512, run.closure_error[after], 30 / MASS * t**3 / 6, 1.0)
    assert run.contact_force[~after] == pytest.approx(10 - 30 * run.time[~after], abs=1e-12)


def press_but_between(middle, half):
    """Return a force that presses but for 2 half seconds around `middle`, c ((t − middle)² − half²), N."""
    return lambda t, z, rate: -4e3 * ((t - middle) ** 2 - half**2)


@pytest.mark.parametrize("stabiliser", ["projection", "baumgarte"])
def test_a_pull_inside_a_step_lets_go(stabiliser):
    """A force that presses at both ends of a step and pulls in its middle lifts the ball, and presses it down again.

    With s = (t − 0.35 s)/half the ball is at z ~ (s + 1)³ (3 − s): it leaves at s = −1 and arrives at s = 3. The force
    is a parabola in time, which RK4 integrates exactly.
    """
    half = 0.02
    changes = {"stabiliser.kind": stabiliser, "impact.restitution": 0.0, "time.duration": 0.6}
    if stabiliser == "baumgarte":
        changes["stabiliser.time_constant"] = "auto"
    run = simulate(press_but_between(0.35, half), 0.0, **changes)
    assert [e.kind for e in run.events] == ["liftoff", "touchdown"]
    assert run.event_time == pytest.approx([0.35 - half, 0.35 + 3 * half], abs=1e-12)
    rows = np.searchsorted(run.event_time, run.time) == 1
    s = (run.time[rows] - 0.35) / half
    assert s.size == 1
    assert within(512, run.closure_error[rows], 4e3 / MASS * half**4 / 12 * (s + 1) ** 3 * (3 - s), 1.0)
    assert_one_story(run)


@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler", "dop853"])
def test_a_pull_between_all_evaluations_is_seen_by_the_adaptive_integrator_only(integrator):
    """What begins and ends between the evaluations of a step of fixed length leaves no trace in it.

    RK4 evaluates at both ends and in the middle, an Euler scheme at the ends.
    """
    middle = 0.325 if integrator == "rk4" else 0.35
    changes = {"time.integrator": integrator, "impact.restitution": 0.0, "time.duration": 0.6}
    run = simulate(press_but_between(middle, 0.02), 0.0, **changes)
    seen = ["liftoff", "touchdown"] if integrator == "dop853" else []
    assert [e.kind for e in run.events] == seen
    assert np.all(run.contact_force >= 0.0)


@pytest.mark.parametrize("integrator", ["rk4", "dop853"])
def test_a_dip_between_two_rises_is_seen_by_the_adaptive_integrator_only(integrator):
    """On z = 10 mm (4 x³ − 6 x² + 2.2 x + 0.02), x = t/h, the ball rises, is 0.18 mm deep at x = 0.76, and rises."""
    size, step = 0.01, 0.1
    roots = np.roots([4.0, -6.0, 2.2, 0.02])
    first = np.sort(roots[(abs(roots.imag) < 1e-12) & (roots.real > 0.0)].real)[0]
    run = simulate(
        lambda t, z, rate: MASS * size * (24.0 * t / step - 12.0) / step**2, 0.02 * size, 2.2 * size / step,
        **{"time.integrator": integrator, "time.duration": step},
    )  # fmt: skip
    if integrator == "rk4":
        assert run.events == ()
        assert within(16, run.closure_error, [0.02 * size, 0.22 * size], 1.0)
    else:
        assert run.events[0].kind == "impact"
        assert run.events[0].time == pytest.approx(first * step, abs=1e-12)


def smooth_pull(t, q, v, terms):
    """Press with 10 cos 4t N and pull sideways."""
    return terms.bias - 10 * np.cos(4 * t) * terms.jacobian[2] + np.sin(3 * t) * terms.jacobian[0] - 0.3 * v


@pytest.mark.parametrize(
    ("integrator", "stabiliser"),
    [("semi_implicit_euler", "none"), ("semi_implicit_euler", "both"), ("explicit_euler", "baumgarte"),
     ("explicit_euler", "projection"), ("rk4", "baumgarte"), ("rk4", "both")],
)  # fmt: skip
@pytest.mark.parametrize(
    ("arm", "start"),
    [("planar2", "planar2_drop"), pytest.param("wam4", "wam_bounce", marks=pytest.mark.slow)],
)
def test_a_tip_that_leaves_once_leaves_once(arm, start, stabiliser, integrator):
    """An arm that is pulled off smoothly has one liftoff: contact does not begin again without a touchdown.

    Where f of the drifted tip is zero, that of the tip moved back onto the closure may be positive yet, and the other
    way round; the steps here are long enough for a drift of up to millimetres.
    """
    model = ARMS[arm]
    for step in (0.01, 0.005, 0.002):
        changes = {"surface.gap": 0.0, "stabiliser.kind": stabiliser, "time.integrator": integrator, "time.step": step}
        if stabiliser in ("baumgarte", "both"):
            changes["stabiliser.time_constant"] = "auto"
        run = cl.simulate(cl.load_scenario(start, changes | {"time.duration": 0.6}), law=smooth_pull, model=model)
        assert [e.kind for e in run.events] == ["liftoff"], step
        assert_one_story(run)


@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
def test_a_held_torque_acts_until_the_step_in_which_an_event_is_ends(integrator):
    """With law.sample_period the force of each sample acts unchanged through impacts, in closed form piece by piece.

    The law, sampled every 0.2 s: −m g (1 + t). The impacts are where a ball under the sampled gravity has them.
    """
    step = 0.1 if integrator == "rk4" else 1e-4
    changes = {"law.sample_period": 0.2, "time.integrator": integrator, "time.step": step, "impact.restitution": 0.6}
    run = simulate(lambda t, z, rate: -MASS * GRAVITY * (1 + t), 0.3, **changes)
    z, u, now, times = 0.3, 0.0, 0.0, []
    for k in range(5):
        a, end = GRAVITY * (1 + 0.2 * k), 0.2 * (k + 1)
        while len(times) < 5:  # without end, bounces would pile up at the Zeno time
            hit = now + (u + np.sqrt(u * u + 2 * a * z)) / a
            if hit > end:
                break
            u = 0.6 * np.sqrt(u * u + 2 * a * z)
            z, now = 0.0, hit
            times.append(hit)
        t = end - now
        z, u, now = z + u * t - 0.5 * a * t * t, u - a * t, end
    count = len(times)
    assert count >= 3
    assert len(run.events) >= count
    assert run.event_time[:count] == pytest.approx(times, abs=1e-12 if integrator == "rk4" else 2e-3)
    per = round(0.2 / step)
    for k in range(5):
        assert np.all(run.torque[per * k : per * (k + 1), 2] == run.torque[per * k, 2])


@pytest.mark.parametrize("stabiliser", ["baumgarte", "projection", "both", "none"])
def test_every_stabiliser_lands_alike(stabiliser):
    """The first impacts of wam_bounce do not depend on the stabiliser, which acts in contact only."""
    runs = [
        cl.simulate(cl.load_scenario("wam_bounce", {"stabiliser.kind": kind, "time.duration": 1.5}))
        for kind in ("projection", stabiliser)
    ]
    assert runs[1].events[-1].kind == "touchdown"
    assert np.array_equal(runs[0].event_time, runs[1].event_time)
    assert np.array_equal(runs[0].event_energy_lost, runs[1].event_energy_lost)
    assert runs[1].contact_force[-1] == pytest.approx(10.0, abs=1e-6)
    assert abs(runs[1].closure_error[-1]) < (1e-12 if stabiliser in ("projection", "both") else 1e-8)


def test_a_run_with_events_comes_back_from_its_file(tmp_path):
    """A saved run has the same events, in file, object and xarray; the table has a dimension of its own."""
    run = cl.simulate(cl.load_scenario("wam_bounce", {"time.duration": 0.6}))
    again = cl.load_run(run.save(tmp_path / "run.nc"))
    assert len(run.events) > 3
    assert len(again.events) == len(run.events)
    for mine, theirs in zip(run.events, again.events, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            assert np.array_equal(a, b)
    data = run.to_xarray()
    assert data.sizes["event"] == len(run.events)
    assert data.event_time.dims == ("event",)
    assert data.event_position.dims == ("event", "axis")
    assert data.event_energy_lost.attrs["units"] == "J"
    assert np.array_equal(data.event_kind, run.event_kind)


def test_a_run_file_repeats_its_events(command_line, tmp_path):
    """A run made again from its run.nc has the same events to the last bit."""
    options = ("--time.duration", "0.6", "--no-figures", "--json")
    assert command_line("wam_bounce", *options, "--out", "a").status == 0
    assert command_line(tmp_path / "a" / "run.nc", "--no-figures", "--json", "--out", "b").status == 0
    one, two = (cl.load_run(tmp_path / folder / "run.nc") for folder in "ab")
    assert len(one.events) > 3
    for name in one.columns:
        assert np.array_equal(one.columns[name], two.columns[name]), name


@pytest.mark.slow  # thousands of events
@pytest.mark.parametrize(("height", "ends"), [(1e-6, False), (1e-8, True)])
def test_a_contact_that_changes_faster_than_the_step_resolves_ends_the_run(height, ends):
    """A mass that bounces without loss: 55 times in each step of 50 ms it goes on for all, 550 times it is too much."""
    changes = {
        "robot.model": "pointmass3", "start.q": [0.0, 0.0, 0.0], "start.v": [0.0, 0.0, 0.0], "time.step": 0.05,
        "surface.contact": "unilateral", "surface.normal": [0, 0, 1], "surface.gap": height, "impact.rest_speed": 1e-9,
        "impact.restitution": 1.0, "reference.kind": "hold", "law.kp": 0, "law.kd": 0, "law.force": 0.0,
        "time.duration": 1.0, "time.integrator": "rk4", "stabiliser.kind": "none",
    }  # fmt: skip
    scenario = cl.load_scenario("planar2_drop", changes)
    if not ends:
        flights = 1.0 / (2.0 * np.sqrt(2.0 * height / 9.81))
        run = cl.simulate(scenario, law=lambda x: np.zeros(3), engine="pinocchio")
        assert len(run.events) == pytest.approx(flights, rel=0.01)
        return
    with pytest.raises(cl.ChatterError, match="more than 2000 times in the last few steps") as caught:
        cl.simulate(scenario, law=lambda x: np.zeros(3), engine="pinocchio")
    assert 2000 < len(caught.value.run.events) < 3500
