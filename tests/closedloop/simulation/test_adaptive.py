"""The adaptive integrator against closed forms: events, energy, the closure, rows, laws, and what stops it."""

import numpy as np
import pytest
from free_bodies import energy
from rounding import rounding, within
from scipy.optimize import brentq
from scipy.special import ellipj

import closedloop as cl
from closedloop.simulation.engines.adaptive_parts import Memory
from robot_models import load

G = 9.81
MASS = 2.0  # kg, pointmass3
POINT = {
    "robot.model": "pointmass3",
    "surface.offset": 0.0,
    "surface.gap": 0.0,
    "start.q": [0, 0, 0],
    "start.v": [0, 0, 0],
    "law.kd": 0.0,
    "stabiliser.kind": "projection",
    "time.integrator": "dop853",
    "time.step": 0.01,
    "time.duration": 1.0,
}


def point(**changes):
    """Return the scenario of a point mass on the plane z = 0 that nothing acts on but gravity and the law."""
    return cl.load_scenario("planar2_drop", POINT | changes)


def limp(t, q, v, terms):
    """Do nothing."""
    return np.zeros(len(q))


@pytest.mark.parametrize(("restitution", "user_law"), [(0.8, True), (1.0, False)])
def test_a_ball_bounces_when_and_as_the_closed_form_says(restitution, user_law):
    """Impacts of a falling point mass are at sqrt(2 h/g) (1 + 2 (ε + ε² + ...)), with εᵏ times the first speed.

    A law of one's own that does nothing leaves gravity; the paper's law takes it away and presses with m g instead, in
    one stretch without a stop. The instants are found to a few roundings of two seconds, and the speeds are theirs
    times g: twenty of 3 m/s.
    """
    changes = {"start.q": [0, 0, 0.5], "start.v": [0.3, 0, 0], "impact.restitution": restitution, "time.duration": 2.0}
    run = cl.simulate(point(**changes | {"law.force": MASS * G}), law=limp if user_law else None)
    first = np.sqrt(2 * 0.5 / G)
    shrink = restitution ** np.arange(1, 12)
    times = first * (1 + 2 * np.concatenate([[0.0], np.cumsum(shrink)]))
    times = times[times < 2.0]
    assert len(run.events) == times.size >= 3
    assert np.max(np.abs(run.event_time - times)) < rounding(25, times)
    speeds = G * first * restitution ** np.arange(times.size)
    assert np.max(np.abs(run.event_rate_before + speeds)) < rounding(50, speeds)
    assert np.max(np.abs(run.q[:, 0] - 0.3 * run.time)) < rounding(50, run.q[:, 0])


def test_a_force_that_fades_lets_go_at_its_zero_and_the_flight_after_it_is_the_closed_form():
    """f = A + B sin ω(t − s) is zero at a known instant, and the flight after it is two integrals of it.

    The sine begins between rows, and rows, stages and events fall anywhere in its period: the desired force is exact
    at all of them, not only at rows. 1e-12 s is what the tolerance of 1e-12 m leaves at a speed of 0.7 m/s.
    """
    mean, swing, omega, s = 10.0, 15.0, 4 * np.pi, 0.1234
    run = cl.simulate(
        point(
            **{
                "law.force": mean,
                "force_profile.kind": "sine",
                "force_profile.amplitude": swing,
                "force_profile.frequency": omega / (2 * np.pi),
                "force_profile.start": s,
                "impact.restitution": 0.4,
            }
        )
    )
    off = s + (np.pi + np.arcsin(mean / swing)) / omega

    def height(t):
        c, since = np.cos(omega * (off - s)), t - off
        turn = (np.sin(omega * (t - s)) - np.sin(omega * (off - s))) / omega - c * since
        return -(mean * since**2 / 2 - swing / omega * turn) / MASS

    on = brentq(height, off + 0.1, off + 1.0, xtol=1e-15, rtol=1e-15)
    assert [e.kind for e in run.events[:2]] == ["liftoff", "impact"]
    assert within(64, run.event_time[0], off, 1.0)  # as sharply as `locate` finds an instant, s
    assert abs(run.event_time[1] - on) < 1e-12
    pressed = run.time < off
    wanted = mean + swing * np.sin(omega * np.maximum(run.time - s, 0.0))
    assert run.contact_force[pressed] == pytest.approx(wanted[pressed], abs=1e-12)
    free = (run.time > off) & (run.time < on)
    assert np.max(np.abs(run.closure_error[free] - height(run.time[free]))) < 1e-12
    assert not np.any(run.contact_force[free])


def test_a_pendulum_is_jacobis_elliptic_function():
    """One joint of planar2, the other locked, swings by 113 degrees: sin(θ/2) = k cd(ω t, k), to 2e-14 rad."""
    scenario = {
        "robot.lock": {"J2": 0.0},
        "start.q": [0.4],
        "start.v": None,
        "surface.offset": -10.0,
        "surface.gap": 0.0,
        "time.integrator": "dop853",
        "time.duration": 3.0,
        "time.step": 0.01,
    }
    run = cl.simulate(cl.load_scenario("planar2_drop", scenario), law=limp)
    terms = cl.Robot(run.model).terms([0.0], [0.0])
    omega, k = np.sqrt(terms.bias[0] / terms.mass_matrix[0, 0]), np.sin((0.4 + np.pi / 2) / 2)
    _, cn, dn, _ = ellipj(omega * run.time, k * k)
    assert within(64, run.q[:, 0] + np.pi / 2, 2 * np.arcsin(k * cn / dn))


@pytest.mark.parametrize("name", ["planar2_slide", "wam_slide", pytest.param("panda_slide", marks=pytest.mark.slow)])
@pytest.mark.parametrize("stabiliser", ["projection", "none"])
def test_limp_arm_on_the_surface_keeps_its_energy_and_the_closure(name, stabiliser):
    """An arm that nothing drives slides under gravity at many joules without gaining or losing 1e-12 of them.

    With the projection the closure holds to rounding, as it does for steps of fixed length; without it the drift of a
    second is that of the tolerance.
    """
    changes = {"time.integrator": "dop853", "time.step": 0.01, "time.duration": 1.0, "stabiliser.kind": stabiliser}
    if name == "wam_slide":
        changes["start.q"] = [np.pi / 2, 1.0, 0.0, 2.0]  # the elbow up: it falls far; hanging, it has little to lose
    run = cl.simulate(cl.load_scenario(name, changes), law=limp)
    moved = np.ptp(run.kinetic_energy)
    assert moved > 1.0
    assert np.max(np.abs(energy(run) - energy(run)[0])) < 1e-12 * moved
    assert np.max(np.abs(run.closure_error)) < (4e-15 if stabiliser == "projection" else 1e-12)
    assert np.max(np.abs(run.closure_rate)) < (2e-15 if stabiliser == "projection" else 1e-11)


@pytest.fixture(scope="module")
def slide():
    """Return the first second of the paper's slide, the velocity step in it, with the projection."""
    changes = {"time.integrator": "dop853", "time.duration": 0.8, "stabiliser.kind": "projection"}
    return cl.simulate(cl.load_scenario("wam_slide", changes))


def test_rows_meet_eq_24_at_their_own_state(slide):
    """Rows lie within the solver's steps, and yet force and acceleration solve Eq. 24 at the row's state."""
    assert len(slide) == 801
    assert max(slide.residual_motion.max(), slide.residual_closure.max()) < 1e-12
    assert np.all(slide.mode == 1)
    arm = cl.Robot(slide.model, "tip")
    for k in (0, 499, 500, 501, 637, 800):
        terms = arm.terms(slide.q[k], slide.v[k])
        left = terms.mass_matrix @ slide.acceleration[k] + terms.bias
        right = slide.torque[k] + terms.jacobian[2] * slide.contact_force[k]
        assert np.max(np.abs(left - right)) < 1e-11
        assert np.max(np.abs(terms.position - slide.position[k])) < rounding(50, terms.position)


def test_jump_is_in_the_row_at_which_it_happens(slide):
    """The row of the velocity step has the torque just after it, the row before knows nothing of it."""
    kd = np.array(slide.scenario.law.kd)
    assert slide.contact_force[:500] == pytest.approx(np.full(500, 10.0), abs=1e-12)
    assert np.max(np.abs(slide.v[:501])) < 1e-12
    step = slide.torque[500] - slide.torque[499]
    assert step == pytest.approx(kd * slide.reference_velocity[500], abs=1e-11)


def test_tolerance_says_how_far_the_run_is_from_the_truth():
    """A hundredfold tolerance makes a larger error, and each error is of the size that was allowed."""
    changes = {"time.integrator": "dop853", "time.duration": 0.8, "time.step": 0.01, "stabiliser.kind": "projection"}
    runs = [cl.simulate(cl.load_scenario("wam_slide", changes | {"time.tolerance": t})) for t in (1e-13, 1e-10, 1e-7)]
    tight, loose = (float(np.max(np.abs(run.q - runs[0].q))) for run in runs[1:])
    assert tight < 1e-10
    assert tight < 0.1 * loose
    assert loose < 1e-7


def test_time_between_rows_does_not_matter():
    """Rows ten times as far apart are the same rows, to what the tolerance allows."""
    changes = {"time.integrator": "dop853", "time.duration": 0.8, "stabiliser.kind": "projection"}
    fine, coarse = (cl.simulate(cl.load_scenario("wam_slide", changes | {"time.step": h})) for h in (1e-3, 1e-2))
    assert np.max(np.abs(fine.q[::10] - coarse.q)) < 1e-12
    assert np.max(np.abs(fine.contact_force[::10] - coarse.contact_force)) < 1e-8


def test_sampled_law_is_held_between_its_samples():
    """A torque that is evaluated every 2 ms is constant for 2 ms, in rows 0.5 ms apart, and changes then."""
    changes = {"law.sample_period": 0.002, "time.step": 5e-4, "time.duration": 0.7, "stabiliser.kind": "projection"}
    run = cl.simulate(cl.load_scenario("planar2_slide", changes | {"time.integrator": "dop853"}))
    groups = run.torque[:-1].reshape(-1, 4, 2)
    assert np.all(groups == groups[:, :1])
    assert np.all(np.any(np.diff(groups[251:, 0], axis=0) != 0.0, axis=1))
    fixed = cl.simulate(cl.load_scenario("planar2_slide", changes | {"time.integrator": "rk4"}))
    assert np.max(np.abs(fixed.q - run.q)) < 1e-9


@pytest.mark.slow
def test_friction_holds_a_block_until_the_pull_is_too_strong():
    """A pull of 2 t N tears a block loose that 1.2 N of friction hold, at 0.6 s; then m ẍ = 2 t − 1.2."""
    scenario = point(**{"law.force": 4.0, "friction.kind": "coulomb", "friction.coefficient": 0.3})

    def pull(t, q, v, terms):
        return terms.bias - 4.0 * terms.jacobian[2] + 2.0 * t * terms.jacobian[0]

    run = cl.simulate(scenario, law=pull)
    (loose,) = run.events
    assert loose.kind == "slip"
    assert abs(loose.time - 0.6) < 1e-12
    since = np.maximum(run.time - 0.6, 0.0)
    assert np.max(np.abs(run.v[:, 0] - since**2 / MASS)) < 1e-12
    assert np.max(np.abs(run.q[:, 0] - since**3 / 3 / MASS)) < 1e-12


@pytest.mark.slow
def test_a_stuck_block_that_nothing_drags_is_lifted_straight_off():
    """A block pressed with 10 cos ωt N leaves at π/2ω although f ends and friction's cone closes at the same instant.

    From there z = 10 N/(m ω) (t − π/2ω + cos(ωt)/ω), which does not come down.
    """
    omega = 20.0
    scenario = point(**{"friction.kind": "coulomb", "friction.coefficient": 0.3, "time.duration": 0.3})
    run = cl.simulate(scenario, law=lambda t, q, v, terms: terms.bias - 10.0 * np.cos(omega * t) * terms.jacobian[2])
    off = np.pi / (2 * omega)
    assert [e.kind for e in run.events] == ["liftoff"]
    assert within(64, run.event_time[0], off, 1.0)  # as sharply as `locate` finds an instant, s
    up = run.time > off
    assert np.array_equal(run.mode, np.where(up, 0, 2))
    height = 10.0 / (MASS * omega) * (run.time - off + np.cos(omega * run.time) / omega)
    assert np.max(np.abs(run.closure_error - np.where(up, height, 0.0))) < 1e-12


@pytest.mark.slow
def test_elastic_friction_is_the_limit_of_short_steps():
    """LuGre's bristles are states beside q and q̇: RK4 with a short step gives the same run."""
    changes = {
        "friction.kind": "lugre",
        "friction.kinetic": 0.2,
        "friction.static": 0.3,
        "friction.stribeck_speed": 0.01,
        "friction.stiffness": 1e3,
        "friction.damping": 5.0,
        "law.force": 4.0,
        "start.v": [0.3, 0.4, 0],
        "time.duration": 0.5,
    }
    truth = cl.simulate(point(**changes))
    steps = [cl.simulate(point(**changes | {"time.integrator": "rk4", "time.step": h})) for h in (1e-3, 5e-4)]
    errors = [np.max(np.abs(run.q[:: round(0.01 / h)] - truth.q)) for run, h in zip(steps, (1e-3, 5e-4), strict=True)]
    # A step that takes the decay of bristles exactly has a larger constant where that is slow: 6.3e-7 m, and 4.1e-8
    # with half of that step.
    assert errors[1] < 1e-6
    assert errors[0] > 12 * errors[1]


STRAIGHT = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold", "time.duration": 0.5}


@pytest.mark.parametrize(
    ("name", "changes", "error", "match"),
    [
        ("planar2_slide", STRAIGHT, cl.SingularClosureError, r"t = 0 s: singular pose"),
        ("wam_slide", {"law.kd": -300.0}, cl.DivergenceError, r"joint J\d is beyond 1e\+06 rad/s.* law.kp and law.kd$"),
    ],
)
def test_what_stops_a_run_stops_this_one(name, changes, error, match):
    """A singular pose and a divergence end the run with the error that fixed steps give, and keep what ran."""
    scenario = cl.load_scenario(name, {"time.integrator": "dop853"} | changes)
    with pytest.raises(error, match=match) as caught:
        cl.simulate(scenario)
    run = caught.value.run
    assert all(np.all(np.isfinite(column)) for column in run.columns.values())
    if len(run):
        assert run.time[-1] <= caught.value.time <= run.time[-1] + 0.001 + 1e-9


def test_law_without_a_torque_stops_it_at_once():
    """A law that returns NaN from 3.2 ms on stops the run there, in the row's interval."""
    scenario = cl.load_scenario("planar2_slide", {"time.integrator": "dop853", "time.duration": 0.1})

    def broken(t, q, v, terms):
        return terms.bias - 10 * terms.jacobian[2] + (np.nan if t > 0.0032 else 0.0)

    with pytest.raises(cl.DivergenceError, match=r"stopped at t = 0\.0032 s: the law returned Q = \[nan, nan\]"):
        cl.simulate(scenario, law=broken)


@pytest.mark.slow
def test_law_that_switches_back_and_forth_stalls_with_a_reason():
    """A law that jumps about zero velocity has no smooth motion; the run says so instead of going on for ever."""
    scenario = point(**{"law.force": 4.0, "start.v": [0.1, 0, 0]})

    def switching(t, q, v, terms):
        return terms.bias - 4 * terms.jacobian[2] - np.array([1.0, 0, 0]) * (1.0 if v[0] > 0.0 else -1.0)

    with pytest.raises(cl.DivergenceError, match=r"t = 0\.2 s: the step of the adaptive integrator has become zero"):
        cl.simulate(scenario, law=switching)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time.tolerance": 0.0}, "time.tolerance = 0.0: must be from 1e-14 to 0.001"),
        ({"time.tolerance": -1e-9}, "time.tolerance = -1e-09: must be from 1e-14 to 0.001"),
        ({"time.tolerance": 1e-15}, "time.tolerance = 1e-15: must be from 1e-14 to 0.001"),
        ({"time.tolerance": 0.1}, "time.tolerance = 0.1: must be from 1e-14 to 0.001"),
        ({"time.tolerance": "fine"}, "time.tolerance = 'fine': must be a number"),
        ({"time.integrator": "dop835"}, "'semi_implicit_euler', 'time_stepping' or 'dop853'"),
        (
            {"time.tolerance": 1e-9, "time.integrator": "rk4"},
            "time.tolerance = 1e-09: acts with integrator = 'dop853' only; the error of 'rk4' is set by time.step",
        ),
        (
            {"joint_friction.kind": "coulomb", "joint_friction.kinetic": 1.0},
            "joint_friction.kind = 'coulomb': depends on the step, and 'dop853' chooses its own steps; must be",
        ),
    ],
)
def test_what_cannot_be_asked_for_is_refused_in_one_line(changes, message):
    """A tolerance out of range, or where it means nothing, and friction that needs a step."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", {"time.integrator": "dop853"} | changes))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_least_tolerance_that_may_be_asked_for_works():
    """At 1e-14 error estimates are of the size of rounding; the steps shrink, and the run is there."""
    changes = {"time.integrator": "dop853", "time.tolerance": 1e-14, "time.duration": 0.6, "time.step": 0.01}
    fine, usual = (
        cl.simulate(cl.load_scenario("wam_slide", changes | {"stabiliser.kind": "projection", "time.tolerance": t}))
        for t in (1e-14, 1e-12)
    )
    assert within(512, fine.q, usual.q)


def test_stiff_stabiliser_is_no_limit_on_the_time_between_rows():
    """With rows a thousand time constants apart an integrator of fixed step is refused, this one is not."""
    changes = {"time.step": 0.1, "time.duration": 0.4, "stabiliser.time_constant": 1e-4}
    with pytest.raises(cl.ScenarioError, match="unstable"):
        cl.prepare(cl.load_scenario("wam_slide", changes))
    run = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.integrator": "dop853"}))
    assert run.contact_force == pytest.approx(np.full(5, 10.0), abs=1e-6)


def test_progress_is_reported_and_the_scenario_goes_round(tmp_path):
    """Progress counts rows up to the end; a run saved and loaded still says what it was made with."""
    heard = []
    changes = {"time.integrator": "dop853", "time.tolerance": 1e-11, "time.duration": 0.4}
    run = cl.simulate(cl.load_scenario("planar2_slide", changes), progress=lambda *x: heard.append(x))
    done, totals = zip(*heard, strict=True)
    assert (done[0], done[-1], set(totals)) == (0, 400, {400})
    assert list(done) == sorted(done)
    assert cl.load_run(run.save(tmp_path / "run.nc")).scenario.time == run.scenario.time
    assert run.summary()["max_kkt_residual"] < 1e-12


def test_model_given_and_events_between_rows():
    """A robot made in Python drops onto the surface: every event is between the rows around it."""
    scenario = cl.load_scenario("planar2_drop", {"time.integrator": "dop853", "time.duration": 0.6, "time.step": 0.01})
    run = cl.simulate(scenario, model=load("planar2"))
    assert len(run.events) > 5
    assert run.events[-1].kind == "touchdown"
    for event in run.events:
        assert run.closure_error[run.time <= event.time].min() > -1e-12
    assert np.all(run.mode[run.time > run.event_time[-1]] == 1)
    assert np.all(np.diff(run.event_time) > 0.0)


def test_a_ball_that_just_slips_takes_few_evaluations(tmp_path, monkeypatch):
    """Just above 7/2 μ its slip is slow, and its direction stiff; a = g (sin θ − μ cos θ) all the same."""
    calls, rate = [], Memory.rate
    monkeypatch.setattr(Memory, "rate", lambda self, *given: calls.append(1) or rate(self, *given))
    mu, radius, theta = 0.3, 0.07, np.arctan(1.001 * 3.5 * 0.3)
    n = np.array([np.sin(theta), 0.0, np.cos(theta)])
    body = f'name = "b"\nshape = "ball"\nradius = {radius}\nmass = 1.3\nposition = {(radius * n).tolist()}'
    contact = f'name = "c"\nlink = "b"\nat = "collision"\nnormal = {n.tolist()}\nfriction = {mu}'
    (tmp_path / "s.toml").write_text(
        f'robot.model = "none"\n[[body]]\n{body}\n[[contact]]\n{contact}\n'
        '[time]\nduration = 0.1\nstep = 1e-2\nintegrator = "dop853"\n'
    )
    run = cl.simulate(cl.load_scenario(str(tmp_path / "s.toml")), progress=False)
    a = 9.81 * (np.sin(theta) - mu * np.cos(theta))
    np.testing.assert_allclose(run.v[:, :3], np.outer(a * run.time, [n[2], 0.0, -n[0]]), atol=1e-9)
    assert len(calls) < 3000


def test_friction_of_a_rigid_slide_is_against_it_beside_a_soft_contact(tmp_path):
    """A ball slides and turns its slip while another lies on a soft floor."""
    (tmp_path / "s.toml").write_text(
        'robot.model = "none"\n'
        '[[body]]\nname = "a"\nshape = "ball"\nradius = 0.1\nmass = 1.0\nposition = [0, 0, 0.1]\n'
        "velocity = [0.3, 0, 0]\nspin = [4, 0, 0]\n"
        '[[body]]\nname = "b"\nshape = "ball"\nradius = 0.1\nmass = 1.0\nposition = [1, 0, 0.1]\n'
        "velocity = [0.2, 0, 0]\n"
        '[[contact]]\nname = "rigid"\nlink = "a"\nat = "collision"\nfriction = 0.2\n'
        'motion = { kind = "turntable", speed = 3.0 }\n'
        '[[contact]]\nname = "soft"\nlink = "b"\nat = "collision"\nfriction = 0.2\n'
        'compliance = { kind = "kelvin_voigt", stiffness = 1e4, damping = 50.0 }\n'
        '[time]\nduration = 0.03\nstep = 5e-3\nintegrator = "dop853"\n'
    )
    run = cl.simulate(cl.load_scenario(str(tmp_path / "s.toml")), progress=False)
    rub, slip = run.link_frictions[:, :2], run.link_slips[:, :2]
    across = rub[:, 0] * slip[:, 1] - rub[:, 1] * slip[:, 0]
    assert np.all(run.link_modes[:, 0] == 1)
    assert np.max(np.abs(across)) < 1e-9
