"""Friction inside the simulation: closed forms of sliding, sticking and of both in turn; energy; refusals."""

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.scenario.load import parse_scenario

GRAVITY = 9.81  # m/s², along -z
MASS = 2.0  # kg, of pointmass3
PRESSED, STUCK = 1, 2

BLOCK = """
[robot]
model = "pointmass3"
[surface]
kind = "plane"
[law]
kp = 0.0
kd = 0.0
force = 0.0
[stabiliser]
kind = "projection"
[time]
duration = 1.0
step = 0.001
integrator = "rk4"
"""

DRY = {
    "coulomb": {"kind": "coulomb", "coefficient": 0.3},
    "coulomb_viscous": {"kind": "coulomb_viscous", "coefficient": 0.3, "viscous": 2.0},
    "stribeck": {"kind": "stribeck", "kinetic": 0.2, "static": 0.35, "stribeck_speed": 0.01, "viscous": 1.0},
    "karnopp": {"kind": "karnopp", "kinetic": 0.2, "static": 0.35, "dead_band": 1e-4, "viscous": 1.0},
}


def nothing(t, q, v, terms):
    """Apply no torque."""
    return np.zeros(q.size)


def block(law=nothing, **overrides):
    """Simulate the point mass on a plane; `a__b` stands for the key a.b."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return cl.simulate(parse_scenario(BLOCK, overrides=keys), law=law)


def pulled(pull, stiffness):
    """Return a law: a spring along x to an end that moves at `pull`."""

    def law(t, q, v, terms):
        return np.array([stiffness * (pull * t - q[0]), 0.0, 0.0])

    return law


@pytest.mark.parametrize(
    "friction",
    [
        {"kind": "karnopp", "kinetic": 0.2, "static": 0.3, "dead_band": 1e-9},
        {"kind": "stribeck", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-9},
    ],
    ids=["karnopp", "stribeck"],
)
def test_stick_slip_of_a_block_on_a_pulled_spring_matches_its_closed_form(friction):
    """Stick slip of a block on a pulled spring matches its closed form."""
    pull, stiffness, mu_k, mu_s = 0.1, 200.0, 0.2, 0.3
    run = block(pulled(pull, stiffness), friction=friction, time__duration=3.0)
    weight, omega = MASS * GRAVITY, np.sqrt(stiffness / MASS)
    # Stuck until the spring carries the static force. Then k y = F_k + (F_s - F_k) cos wt + ... with y the stretch:
    # y = y_k + a cos wt + (V/w) sin wt, and the block's velocity V - y' vanishes again at t = (2/w)(pi - atan(w a/V)).
    a = (mu_s - mu_k) * weight / stiffness
    slip = 2.0 / omega * (np.pi - np.arctan(omega * a / pull))
    stretch = (mu_k * weight / stiffness) - a  # what is left of it when the block stops
    stick = (mu_s * weight / stiffness - stretch) / pull
    first = mu_s * weight / (stiffness * pull)
    instants, at = [], first
    while at < 3.0:
        instants.append(at)
        at += slip if len(instants) % 2 else stick
    assert len(instants) >= 4
    assert [event.kind for event in run.events] == [("slip", "stick")[i % 2] for i in range(len(instants))]
    # With Stribeck's curve two of RK4's four stages after a break-away, half by weight, are at u = 0 and so still on
    # the static level: the piece of a step that follows ends at half the speed, and instants are late by order h.
    bound = 1e-8 if friction["kind"] == "karnopp" else 2e-3
    np.testing.assert_allclose([event.time for event in run.events], instants, rtol=0.0, atol=bound)


@pytest.mark.parametrize("kind", DRY)
def test_friction_takes_energy_and_what_it_takes_is_missing(kind):
    """Friction takes energy and what it takes is missing."""
    rng = np.random.default_rng(7)
    for _ in range(2):
        run = block(
            friction=DRY[kind], start__v=(*rng.normal(size=2).tolist(), 0.0), time__duration=0.3, time__step=5e-4
        )
        power = np.einsum("ni,ni->n", run.friction_force, run.velocity)
        assert np.all(power <= 1e-12)
        energy = run.kinetic_energy + run.potential_energy
        lost = np.trapezoid(power, run.time)
        assert lost < -1e-3
        assert energy[-1] - energy[0] == pytest.approx(lost, rel=1e-3)


@pytest.mark.parametrize("kind", ["coulomb", "karnopp", "stribeck"])
def test_at_every_row_friction_is_within_its_cone(kind):
    """At every row friction is within its cone."""
    overrides = {"friction": DRY[kind] | {"viscous": 0.0} if kind != "coulomb" else DRY[kind]}
    run = cl.simulate(cl.load_scenario("wam_slide", overrides | {"time.duration": 1.5}))
    mu = 0.3 if kind == "coulomb" else 0.2
    tangential = np.linalg.norm(run.friction_force, axis=1)
    slip = np.linalg.norm(run.velocity[:, :2], axis=1)
    # A row at which the mode changes holds the mode it changes to.
    sliding = (run.mode == PRESSED) & (slip > 0.1 * run.scenario.reference.speed)
    if kind == "stribeck":
        mu = 0.2 + 0.15 * np.exp(-((slip[sliding] / 0.01) ** 2))
    assert sliding.sum() > 100
    np.testing.assert_allclose(tangential[sliding], mu * run.contact_force[sliding], rtol=1e-12, atol=1e-12)
    # Eq. 24 is relative to its terms, solved through the mobility of the tip.
    assert run.residual_motion.max() < 1e-13
    stuck = run.mode == STUCK
    assert stuck.sum() > 100
    limit = 0.3 if kind == "coulomb" else 0.35
    assert np.all(tangential[stuck] <= limit * run.contact_force[stuck] * (1 + 1e-12))
    rests = np.flatnonzero(stuck[1:] & stuck[:-1])
    assert np.linalg.norm(run.position[rests + 1] - run.position[rests], axis=1).max() < 1e-9


def test_where_friction_wedges_the_tip_the_run_ends_in_words():
    """Where friction wedges the tip the run ends in words."""
    # S_nn - mu |S_nt| < 0 once mu > S_nn/|S_nt|: for one direction of slip any force makes the tip dig in (Painleve).
    robot = cl.Robot(robot_models.load("planar2"), "tip")
    q = np.array([0.3, -0.4])
    terms = robot.terms(q, np.zeros(2))
    S = terms.jacobian @ np.linalg.solve(terms.mass_matrix, terms.jacobian.T)
    for share, sign in ((0.9, 1.0), (0.9, -1.0), (1.5, -np.sign(S[2, 0]))):
        mu = share * S[2, 2] / abs(S[2, 0])
        v = np.linalg.lstsq(terms.jacobian[[0, 2]], [-0.05 * sign, 0.0], rcond=None)[0]
        changes = {
            "start.q": q.tolist(),
            "start.v": v.tolist(),
            "friction": {"kind": "coulomb", "coefficient": float(mu)},
            "reference": {"kind": "hold"},
            "time.duration": 0.005,
        }
        scenario = cl.load_scenario("planar2_slide", changes)
        if share < 1.0:
            run = cl.simulate(scenario)
            assert np.all(np.isfinite(run.contact_force))
            continue
        with pytest.raises(cl.PainleveError) as caught:
            cl.simulate(scenario)
        assert len(str(caught.value).splitlines()) == 1
        assert "stops of joints" not in str(caught.value)
        assert np.all(np.isfinite(caught.value.run.contact_force))
        with pytest.raises(cl.PainleveError, match="or is jammed between it and the stops of joints"):
            cl.simulate(cl.load_scenario("planar2_slide", changes | {"robot.stops": True}))


SWING = BLOCK.replace('kind = "plane"', 'kind = "plane"\ncontact = "unilateral"\ngap = 5.0')


def joint_run(torque, **overrides):
    """Simulate the free point mass, its slides with friction, under a constant torque and without its weight."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}

    def law(t, q, v, terms):
        return np.array(torque) + np.array([0.0, 0.0, MASS * GRAVITY])

    return cl.simulate(parse_scenario(SWING, overrides=keys), law=law)


def test_a_joint_with_coulomb_friction_holds_below_the_limit_and_accelerates_above():
    """A joint with coulomb friction holds below the limit and accelerates above."""
    limit = 3.0
    run = joint_run((2.999, 3.5, -4.0), joint_friction={"kind": "coulomb", "kinetic": limit})
    assert np.abs(run.q[:, 0] - run.q[0, 0]).max() < 1e-12
    np.testing.assert_allclose(run.joint_friction[:, 0], -2.999, atol=1e-9)
    np.testing.assert_allclose(run.v[:, 1], (3.5 - limit) / MASS * run.time, atol=1e-9)
    np.testing.assert_allclose(run.v[:, 2], (-4.0 + limit) / MASS * run.time, atol=1e-9)


def test_a_joint_with_coulomb_friction_comes_to_rest_without_chatter():
    """A joint with coulomb friction comes to rest without chatter."""
    limit, v0 = 3.0, 0.7
    run = joint_run(
        (0.0, 0.0, 0.0),
        joint_friction={"kind": "coulomb", "kinetic": limit},
        start__v=(v0, -v0, 0.0),
        time__integrator="semi_implicit_euler",
    )
    stop = v0 * MASS / limit
    after = run.time > stop + 2 * run.scenario.time.step
    assert np.abs(run.v[after]).max() < 1e-12
    assert run.q[-1, 0] - run.q[0, 0] == pytest.approx(MASS * v0**2 / (2 * limit), abs=v0 * run.scenario.time.step)
    assert np.all(np.diff(np.abs(run.v[:, :2]), axis=0) <= 1e-12)


def test_viscous_friction_in_a_joint_decays_like_an_exponential():
    """Viscous friction in a joint decays like an exponential."""
    b, v0 = 5.0, 0.4
    friction = {"kind": "coulomb_viscous", "kinetic": 0.0, "viscous": b}
    run = joint_run((0.0, 0.0, 0.0), joint_friction=friction, start__v=(v0, 0.0, -v0))
    decay = v0 * np.exp(-b / MASS * run.time)
    np.testing.assert_allclose(run.v[:, 0], decay, rtol=1e-9)
    np.testing.assert_allclose(run.v[:, 2], -decay, rtol=1e-9)


def test_an_impact_with_friction_loses_energy_and_runs_on():
    """An impact with friction loses energy and runs on."""
    run = block(
        nothing,
        surface__contact="unilateral",
        surface__gap=0.05,
        impact={"restitution": 0.5},
        friction=DRY["coulomb"],
        start__v=(0.5, 0.0, 0.0),
    )
    impacts = [event for event in run.events if event.kind == "impact"]
    fall = np.sqrt(2 * GRAVITY * 0.05)
    assert impacts[0].rate_before == pytest.approx(-fall, rel=1e-6)
    assert impacts[0].rate_after == pytest.approx(0.5 * fall, rel=1e-6)
    # It slips all through the impact, so the tangential impulse is mu times the normal one.
    impulse = 1.5 * fall * MASS
    np.testing.assert_allclose(impacts[0].tangential, [-0.3 * impulse, 0.0, 0.0], rtol=1e-6, atol=1e-9)
    assert all(event.energy_lost >= 0.0 for event in impacts)
    assert run.mode[-1] == STUCK
    assert run.time[-1] == pytest.approx(1.0)


def test_a_run_with_friction_survives_its_file(tmp_path):
    """A run with friction survives its file."""
    run = cl.simulate(
        cl.load_scenario("wam_slide", {"friction": DRY["stribeck"], "time.duration": 0.6}),
    )
    run.save(tmp_path / "run.nc")
    again = cl.load_run(tmp_path / "run.nc")
    assert again.scenario == run.scenario
    for column in ("friction_force", "joint_friction", "mode", "position", "event_time", "event_kind"):
        np.testing.assert_array_equal(getattr(again, column), getattr(run, column))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"friction": {"kind": "coulomb", "coefficient": -0.1}}, ("friction.coefficient", "-0.1", "negative")),
        (
            {"friction": DRY["stribeck"] | {"static": 0.1}},
            ("friction.static", "0.1", "must not be below kinetic"),
        ),
        (
            {"friction": DRY["stribeck"] | {"stribeck_speed": 0.0}},
            ("friction.stribeck_speed", "0", "greater than 0"),
        ),
        ({"joint_friction": {"kind": "coulomb", "kinetic": [1.0, -2.0, 1.0, 1.0]}}, ("joint_friction", "-2")),
        ({"friction": {"kind": "sand"}}, ("friction", "sand", "coulomb")),
    ],
)
def test_bad_input_is_refused_in_one_line(overrides, words):
    """Bad input is refused in one line."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario("wam_slide", overrides)
    line = str(caught.value)
    assert "\n" not in line
    for word in words:
        assert word in line
