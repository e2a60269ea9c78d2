"""Hard stops of the joints: the impact there, the force that holds, the release; against closed forms."""

import dataclasses
import itertools

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.robot.pinocchio import Robot
from robot_models import load

G = 9.81


def no_torque(x):
    """A law that asks for nothing."""
    return 0.0 * x.q


def free(robot, **changes):
    """A scenario with stops in which the surface is out of reach."""
    n = load(robot).n
    changes = {
        "robot.model": robot, "robot.stops": True, "surface.gap": 50.0, "stabiliser.kind": "none", "law.kp": 0,
        "law.kd": 0, "law.force": 0, "start.v": [0.0] * n, "time.duration": 0.5, **changes,
    }  # fmt: skip
    return cl.load_scenario("planar2_drop", changes)


def test_mass_falls_onto_a_stop():
    """The instant, the energy and the force are those of a mass of 2 kg that falls 0.4 m."""
    start = {"start.q": [0.0, 0.0, -9.6], "start.v": [0.5, 0.0, 0.0]}
    run = cl.simulate(free("pointmass3", **start), law=no_torque)
    (event,) = run.events
    assert event.kind == "stop"
    assert event.time == pytest.approx(np.sqrt(0.8 / G), abs=1e-13)
    assert event.energy_lost == pytest.approx(2.0 * G * 0.4, rel=1e-11)
    after = run.time > event.time
    np.testing.assert_allclose(run.q[after, 2], -10.0, atol=1e-15)
    np.testing.assert_allclose(run.stop_torque[after], [[0.0, 0.0, 2.0 * G]] * int(after.sum()), atol=1e-12)
    np.testing.assert_allclose(run.q[:, 0], 0.5 * run.time, atol=1e-12)  # along the stop it is free
    assert not np.any(run.stop_torque[~after])


def test_mass_bounces():
    """Each bounce takes 1 − ε² of the energy, at the instants of the geometric series; then the mass rests."""
    changes = {"start.q": [0.0, 0.0, -9.6], "robot.stop_restitution": 0.5, "time.duration": 0.9}
    run = cl.simulate(free("pointmass3", **changes), law=no_torque)
    fall, energy = np.sqrt(0.8 / G), 2.0 * G * 0.4
    k = np.arange(9)
    lost = [event.energy_lost for event in run.events[:9]]
    np.testing.assert_allclose(lost, energy * 0.75 * 0.25**k, rtol=1e-6)
    instants = [event.time for event in run.events[:9]]
    np.testing.assert_allclose(instants, fall * (1.0 + 2.0 * (1.0 - 0.5**k)), atol=1e-9)
    assert run.time[np.flatnonzero(run.stop_torque[:, 2])[0]] == pytest.approx(3.0 * fall, abs=2e-3)
    assert run.q[-1, 2] == pytest.approx(-10.0, abs=1e-15)
    assert np.ptp(run.energy_supplied - run.kinetic_energy - run.potential_energy) < 1e-9


@pytest.mark.parametrize("torque", [1e12, 1e20])
def test_an_acceleration_that_no_substep_resolves_ends_the_run(torque):
    """One that turns round at each evaluation leaves the speed low, and a step could be divided without end."""
    evaluations = itertools.count()

    def to_and_fro(x):
        k = next(evaluations)
        assert k < 1000
        return torque * (-1.0) ** k + 0.0 * x.q

    with pytest.raises(cl.DivergenceError, match=r"stopped at t = 0 s: the motion diverges: joint \w+ is beyond"):
        cl.simulate(free("planar2", **{"time.integrator": "rk4"}), law=to_and_fro)


@pytest.mark.parametrize("stops", [False, True])
def test_what_is_asked_of_a_joint_without_a_drive_does_not_act(stops):
    """With stops, which may be rows of loops, and without: H q̈ + C = (τ₁, 0), and the report says so."""
    model = load("planar2")
    model = dataclasses.replace(model, drives=model.joint_names[:1])
    scenario = free("planar2", **{"robot.stops": stops, "start.v": [0.3, -0.2], "time.duration": 0.002})
    run = cl.simulate(scenario, law=lambda x: np.array([1.5, -2.0]) + 0.0 * x.q, model=model)
    terms = Robot(model).terms(run.q[0], run.v[0])
    wanted = np.linalg.solve(terms.mass_matrix, [1.5, 0.0] - terms.bias)
    np.testing.assert_allclose(run.acceleration[0], wanted, rtol=1e-12)
    assert run.summary()["motions_without_drive"] == 1
    stepped = cl.Simulator(scenario, model=model, engine="pinocchio")
    stepped.step(torque=[1.5, -2.0])
    assert stepped.run().torque[0].tolist() == [1.5, 0.0]
    np.testing.assert_allclose(stepped.run().acceleration[0], wanted, rtol=1e-12)


def after_moreau(H, v, kept, pushing, restitution):
    """q̇ after Moreau's impact: rows `kept` stay at zero, rows `pushing` do not fall below it; by trying all sets."""
    answer, inverse = (np.inf, v), np.linalg.inv(H)
    for size in range(len(pushing) + 1):
        for rows in itertools.combinations(pushing, size):
            G = np.array([*kept, *rows]).reshape(-1, len(v))
            p = v - inverse @ G.T @ np.linalg.lstsq(G @ inverse @ G.T, G @ v, rcond=None)[0]
            if all(row @ p >= -1e-9 for row in pushing):
                answer = min(answer, ((p - v) @ H @ (p - v), p), key=lambda found: found[0])
    return answer[1] + restitution * (answer[1] - v)


@pytest.mark.parametrize("contact", ["none", "bilateral", "unilateral"])
@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_several_stops_and_the_tip_at_once(contact, restitution):
    """Joints strike at once, two of them with the tip in contact: velocity and energy lost are Moreau's, by search."""
    robot = Robot(load("wam4"))
    sides, model = np.array([0.0, 1.0, -1.0, 1.0 if contact == "none" else 0.0]), robot.model
    q = np.where(sides > 0, model.position_upper, np.where(sides < 0, model.position_lower, 0.3))
    terms = robot.terms(q, np.zeros(4))
    H = np.triu(terms.mass_matrix) + np.triu(terms.mass_matrix, 1).T
    A, rng = terms.jacobian[2], np.random.default_rng(1)
    v = np.zeros(4)
    while not np.all((v * sides > 0.05) | (sides == 0.0)):
        v = rng.uniform(-1.0, 1.0, 4)
        v -= (contact != "none") * A * (A @ v) / (A @ A)
    changes = {
        "robot.stops": True, "robot.stop_restitution": restitution, "start.q": list(q), "start.v": list(v),
        "law.kp": 0, "law.kd": 0, "reference.kind": "hold", "time.step": 1e-6, "time.duration": 2e-6,
        "stabiliser.kind": "none", "surface.contact": "unilateral" if contact == "none" else contact,
        "surface.gap": 5.0 if contact == "none" else 0.0, "law.force": 0.0 if contact == "none" else 5.0,
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    pushing = [-sides[j] * np.eye(4)[j] for j in np.flatnonzero(sides)] + ([A] if contact == "unilateral" else [])
    wanted = after_moreau(H, v, [A] if contact == "bilateral" else [], pushing, restitution)
    assert run.events[0].kind == "stop"
    assert run.events[0].energy_lost == pytest.approx(0.5 * (v @ H @ v - wanted @ H @ wanted), rel=1e-9)
    assert run.events[0].energy_lost > 0.0
    if np.all(sides * wanted < 1e-9):  # else joints that this drives into their stops strike next
        np.testing.assert_allclose(run.v[-1], wanted, atol=2e-4)


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_an_arm_that_swings_about_a_tip_that_sticks_strikes_a_stop(restitution):
    """With one motion left, which the stop bars, all of it is reversed by ε, and 1 − ε² of its energy is lost.

    The impulse at the tip is 1.2e4 times as large along the surface as across it.
    """
    still = cl.load_scenario("wam_slide")
    model, q = load("wam4"), np.array(still.start.q)
    terms = Robot(model).terms(q, np.zeros(4))
    H = np.triu(terms.mass_matrix) + np.triu(terms.mass_matrix, 1).T
    v = np.linalg.svd(terms.jacobian)[2][-1]
    j = int(np.argmax(np.abs(v)))
    v *= np.sign(v[j])
    upper = model.position_upper.copy()
    upper[j] = q[j]
    changes = {
        "start.v": v.tolist(), "friction.kind": "coulomb", "friction.coefficient": 2e4, "stabiliser.kind": "none",
        "robot.stops": True, "robot.stop_restitution": restitution, "law.kp": 0, "law.kd": 0, "reference.kind": "hold",
        "time.step": 1e-6, "time.duration": 2e-6,
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", changes), model=dataclasses.replace(model, position_upper=upper))
    assert [event.kind for event in run.events] == ["stop"]
    np.testing.assert_allclose(run.v[-1], -restitution * v, atol=2e-4)
    assert run.events[0].energy_lost == pytest.approx(0.5 * v @ H @ v * (1.0 - restitution**2), rel=1e-9)


@pytest.fixture(scope="module")
def at_three_stops():
    """The WAM with three joints at their stops and its tip on a surface: J, H, the stops, and how to run it."""
    robot, sides = Robot(load("wam4")), np.array([0.0, 1.0, -1.0, 1.0])
    model = robot.model
    q = np.where(sides > 0, model.position_upper, np.where(sides < 0, model.position_lower, 0.3))
    terms = robot.terms(q, np.zeros(4))
    H = np.triu(terms.mass_matrix) + np.triu(terms.mass_matrix, 1).T
    changes = {
        "robot.stops": True, "start.q": list(q), "law.kp": 0, "law.kd": 0, "time.step": 1e-6, "time.duration": 1e-6,
        "stabiliser.kind": "none", "surface.gap": 0.0, "law.force": 0.0, "impact.restitution": 0.0,
    }  # fmt: skip

    def run(v, normal):
        start = {"start.v": list(v), "surface.normal": list(normal)}
        return cl.simulate(cl.load_scenario("wam_bounce", changes | start), model=model)

    return terms.jacobian, H, [-sides[j] * np.eye(4)[j] for j in range(1, 4)], run


def test_the_tip_and_joints_strike_at_once(at_three_stops):
    """The motion after it is the nearest that the stops and the surface allow: some joints leave their stops."""
    J, H, stops, run = at_three_stops
    rng, found = np.random.default_rng(3), set()
    while len(found) < 5:
        normal, v = rng.normal(size=3), rng.uniform(-1.0, 1.0, 4)
        A = normal @ J / np.linalg.norm(normal)
        if A @ v > -0.1 or any(row @ v > -0.05 for row in stops):
            continue
        wanted = after_moreau(H, v, [], [*stops, A], 0.0)
        left = tuple(np.abs(wanted[1:]) > 1e-3)
        if left in found:
            continue
        moved = run(v, normal)
        assert [(event.time, event.contact) for event in moved.events[:4]] == [(0.0, i) for i in (0, 2, 3, 4)]
        np.testing.assert_allclose(moved.v[0], wanted, atol=1e-9)
        found.add(left)


def test_loops_and_stops_together():
    """A five-bar falls onto its stops and bounces: the loop stays closed, and every torque is explained."""
    model = load("five_bar")
    changes = {
        "surface.gap": 5.0, "surface.contact": "unilateral", "robot.stops": True, "robot.stop_restitution": 0.4,
        "stabiliser.kind": "none", "law.kp": 0, "law.kd": 0, "law.force": 0, "reference.kind": "hold",
        "time.duration": 0.3, "time.step": 0.002, "time.integrator": "rk4",
    }  # fmt: skip
    start = cl.prepare(cl.load_scenario("five_bar", changes)).q
    close = dataclasses.replace(model, position_lower=start - 0.15, position_upper=start + 0.2)
    run = cl.simulate(cl.load_scenario("five_bar", changes), model=close, law=no_torque)
    assert sum(event.kind == "stop" for event in run.events) > 3
    assert all(event.energy_lost >= 0.0 for event in run.events)
    assert np.ptp(run.energy_supplied - run.kinetic_energy - run.potential_energy) < 1e-5
    assert np.max(run.q - close.position_upper) < 1e-12
    assert np.max(close.position_lower - run.q) < 1e-12
    assert np.max(np.abs(run.loops.errors)) < 1e-12
    assert np.max(run.loops.unexplained) < 1e-9
    lower = np.abs(run.q - close.position_lower) < 1e-9
    assert np.any(run.stop_torque > 1e-3)
    assert np.all(run.stop_torque[lower] >= -1e-8)


def test_arm_is_struck_as_a_whole():
    """A joint is driven into its stop: the impulse is in that joint alone, it stays there, and no energy appears."""
    torque = np.array([-2.0, 30.0])
    run = cl.simulate(free("planar2", **{"start.q": [0.6, 2.5], "time.duration": 0.4}), law=lambda x: torque)
    first = run.events[0]
    assert first.kind == "stop"
    left = run.energy_supplied - (run.kinetic_energy + run.potential_energy)
    assert np.ptp(left) < 1e-6  # what the events took is booked
    assert all(event.energy_lost >= 0.0 for event in run.events)
    assert first.energy_lost > 0.01
    k = int(first.time / run.scenario.time.step)
    impulse = Robot(run.model).terms(run.q[k + 1], run.v[k + 1]).mass_matrix @ (run.v[k + 1] - run.v[k])
    assert abs(impulse[0]) < 0.1 * abs(impulse[1])  # but for the step's own torques
    held = run.stop_torque[:, 1] != 0.0
    assert np.count_nonzero(held) > 100
    assert np.all(run.stop_torque[held, 1] < 0.0)  # the upper stop pushes back
    np.testing.assert_allclose(run.q[held, 1], 3.0, atol=1e-12)
    assert np.max(run.q[:, 1]) <= 3.0 + 1e-12


def test_engines_agree():
    """Both strike at the same instant."""
    changes = {"start.q": [0.6, 2.5], "start.v": [0.0, 5.0], "law.kd": 0.01, "time.duration": 0.3}
    runs = [cl.simulate(free("planar2", **changes), engine=engine) for engine in ("pinocchio", "compiled")]
    assert [event.kind for event in runs[0].events] == [event.kind for event in runs[1].events]
    assert runs[0].events[0].kind == "stop"
    assert runs[0].events[0].time == pytest.approx(runs[1].events[0].time, abs=1e-12)
    np.testing.assert_allclose(runs[0].q, runs[1].q, atol=1e-10)


def test_stop_lets_go():
    """It never pulls: once the torque turns round the joint leaves at once."""
    run = cl.simulate(
        free("pointmass3", **{"start.q": [9.9, 0.0, 0.0], "time.duration": 1.0}),
        law=lambda x: np.array([20.0 if x.t < 0.5 else -20.0, 0.0, 2.0 * G]),
    )
    assert [event.kind for event in run.events] == ["stop", "release"]
    assert run.events[0].time == pytest.approx(np.sqrt(2 * 0.1 / 10.0), abs=1e-13)
    assert run.events[1].time == pytest.approx(0.5, abs=1.1e-3)  # the law itself jumps within a step
    assert np.all(run.stop_torque <= 1e-9)
    assert run.q[-1, 0] == pytest.approx(10.0 - 0.5 * 10.0 * (1.0 - run.events[1].time) ** 2, abs=1e-2)


def test_tip_in_contact_takes_part():
    """A joint of an arm that slides strikes its stop: the tip stays on the surface, and the closure holds."""
    changes = {
        "robot.model": "pointmass3", "robot.stops": True, "start.q": [9.95, 0.0, 0.0], "start.v": [0.5, 0.2, -0.5],
        "surface.normal": [1, 0, 1], "reference.kind": "hold", "time.duration": 0.5, "law.kp": 0, "law.kd": 0,
        "law.force": 5.0,
    }  # fmt: skip
    scenario = cl.load_scenario("planar2_slide", changes)
    run = cl.simulate(scenario)
    assert run.events[0].kind == "stop"
    after = run.time > run.events[0].time
    np.testing.assert_allclose(run.v[after][:, [0, 2]], 0.0, atol=1e-9)  # both ways are barred, the third is not
    np.testing.assert_allclose(run.v[after][:, 1], 0.2, atol=1e-9)
    assert np.max(np.abs(run.closure_error)) < 1e-9


@pytest.mark.parametrize("e", [0.0, 0.5])
@pytest.mark.parametrize("moves", [False, True])
def test_a_mass_that_slides_down_a_slope_strikes_a_stop(e, moves):
    """m Δv = P n + s ex: along x and z it turns back with e, and the stop's impulse s is that of both.

    Where the slope moves its impulse is at work: the energy after the event is that before, less what was lost.
    """
    changes = {
        "robot.model": "pointmass3", "robot.stops": True, "start.q": [9.95, 0.0, 0.0], "start.v": [0.5, 0.2, -0.5],
        "surface.normal": [1, 0, 1], "reference.kind": "hold", "time.duration": 0.12, "law.kp": 0, "law.kd": 0,
        "law.force": 5.0, "robot.stop_restitution": e, "time.integrator": "rk4",
    }  # fmt: skip
    if moves:
        changes |= {
            "surface_motion.kind": "breathing",
            "surface_motion.amplitude": 0.01,
            "surface_motion.frequency": 2.0,
        }
    scenario = cl.load_scenario("planar2_slide", changes)
    run = cl.simulate(scenario)
    at, h = run.events[0].time, scenario.time.step
    i = int(at / h)
    ((mass, _, _), *_) = cl.prepare(scenario).robot.terms(run.q[0], run.v[0]).mass_matrix
    before = run.v[i] + (at - i * h) * run.acceleration[i]
    turned = 2.0 * (1.0 + e) * mass * before[0]
    assert run.event_compression[0] == pytest.approx(turned, rel=1e-4 if moves else 1e-9)
    assert run.v[-1, 0] == pytest.approx(-e * before[0], abs=0.05 if moves else 1e-9)
    lost = 0.5 * mass * 2.0 * before[0] ** 2 * (1.0 - e * e)  # it turns back along x, and along z as the slope bids
    assert run.event_energy_lost[0] == pytest.approx(lost, rel=1e-3 if moves else 1e-9)
    assert run.summary()["max_energy_residual"] < (1e-5 if moves else 1e-9)


def test_repeat_and_batch(tmp_path):
    """The same from the file, and in a batch."""
    scenario = free("pointmass3", **{"start.q": [0.0, 0.0, -9.6], "law.kd": 0.1, "robot.stop_restitution": 0.3})
    run = cl.simulate(scenario)
    kept = cl.load_run(run.save(tmp_path / "run.nc"))
    np.testing.assert_array_equal(cl.simulate(kept.scenario, model=kept.model).q, run.q)
    table = cl.simulate_batch(scenario, {"law.kd": [0.1, 0.2]}, engine="pinocchio")
    assert table["max_tip_speed"][0].as_py() == run.summary()["max_tip_speed"]


def test_what_stops_do_not_go_with_is_refused():
    """In one line."""
    with pytest.raises(cl.ScenarioError, match=r"set robot\.stops = true"):
        cl.simulate(cl.load_scenario("wam_slide", {"robot.stop_restitution": 0.5}))
