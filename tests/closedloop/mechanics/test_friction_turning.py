"""Slow slip in two dimensions: friction turns with the slip at any step; a closure may pull where it cannot push."""

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.record.report import print_report

PRESSED = 1


def errors(run):
    """Return the errors of force (N,), N, and path along the surface (N,), m."""
    normal = np.array(run.scenario.surface.normal) / np.linalg.norm(run.scenario.surface.normal)
    path = run.position - run.reference_tip
    return run.contact_force - run.reference_force, np.linalg.norm(path - np.outer(path @ normal, normal), axis=1)


def rms(values):
    """Return the root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))


STEPS = [
    ("semi_implicit_euler", 1e-3),
    pytest.param("semi_implicit_euler", 2.5e-4, marks=pytest.mark.slow),
    pytest.param("rk4", 5e-4, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("scheme", "step"), STEPS)
def test_a_creeping_tip_is_not_thrown_from_side_to_side(scheme, step):
    """A tip that creeps to its stop along y has no friction across y, and its force stays within 0.03 N RMS."""
    settings = {"time.integrator": scheme, "time.step": step}
    run = cl.simulate(cl.load_scenario("wam_hybrid_friction", settings))
    sliding = (run.mode == PRESSED) & (run.time > 1.0)
    assert np.max(np.abs(run.friction_force[sliding, 0])) < 0.3  # of 4 N; it was 3 N
    force, path = errors(run)
    assert rms(force[run.time >= 1.0]) < 0.03
    assert rms(path[run.time >= 1.0]) < 2e-5


@pytest.mark.parametrize(("scheme", "step"), STEPS[1:])
def test_a_wiping_arm_is_the_same_at_any_step(scheme, step):
    """At its corners slip turns by a right angle at next to no speed: the errors do not depend on the step."""
    settings = {"time.integrator": scheme, "time.step": step}
    force, path = errors(cl.simulate(cl.load_scenario("panda_wipe", settings)))
    assert rms(force) == pytest.approx(0.03, abs=0.01)
    assert rms(path) == pytest.approx(1.3e-4, rel=0.05)


def test_a_tip_that_breaks_away_where_mobilities_differ_is_not_kicked():
    """With a tool the tip moves more easily one way: slip and force are those of a quarter of the step, row for row."""
    changes = {
        "surface": {"kind": "sphere", "radius": 0.25, "normal": [0.15, -0.2, 0.95]},
        "law": {"kind": "operational_space", "force": 12.0}, "friction": {"kind": "coulomb", "coefficient": 0.25},
        "reference": {"kind": "circle", "radius": 0.04, "direction": [0.030376207341, 0.979054319335, 0.201320455543],
                      "start": 0.1, "stop": 1.1},
        "tool": {"offset": [0.01, 0.02, 0.1], "mass": 0.4, "centre": [0.0, 0.01, 0.05],
                 "inertia": [1e-3, 1.2e-3, 0.8e-3, 1e-4, 0.0, -1e-4]},
        "time.integrator": "rk4", "time.duration": 0.192,
    }  # fmt: skip
    coarse, fine = (cl.simulate(cl.load_scenario("panda_slide", {**changes, "time.step": h})) for h in (1e-3, 2.5e-4))
    since = coarse.time > coarse.events[0].time
    speed, exact = (
        np.linalg.norm(run.slip_velocity, axis=1)[:: round(1e-3 / h)] for run, h in ((coarse, 1e-3), (fine, 2.5e-4))
    )
    np.testing.assert_allclose(speed[since], exact[since], rtol=0.01)  # 3e-3 where it was 6e-5 m/s, at the second row
    np.testing.assert_allclose(coarse.contact_force[since], fine.contact_force[::4][since], atol=2e-3)  # 1.1 N off


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
def test_a_tip_that_had_drifted_breaks_away_at_a_row(engine):
    """Without a stabiliser a tip that sticks drifts: where it breaks away that speed does not judge the slip anew."""
    changes = {
        "reference.kind": "waypoints", "reference.times": [0.1, 0.2, 0.3], "law.force_integral": 28.3,
        "reference.points": [[0, 0, 0], [0, 0.02, 0], [0, 0, 0]], "stabiliser.kind": "none",
        "time.step": 1.25e-4, "time.duration": 0.4,
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("panda_wipe", changes), engine=engine)  # it stopped at 0.206 s
    assert run.summary()["verdict"]["good"]


SOFT = {"compliance.kind": "kelvin_voigt", "compliance.stiffness": 2.5e5, "compliance.damping": 108.0}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("law", [{}, {"law.kind": "admittance", "law.force_integral": 5.0, "sensor.delay": 0.01}])
def test_tip_and_joints_stick_and_slip_on_a_soft_surface(law, scheme):
    """At 0.014 m/s, where friction in the joints was solved as if f answered as a rigid one's: no ChatterError."""
    changes = SOFT | law | {
        "surface.contact": "unilateral", "reference.speed": 0.014, "time.integrator": scheme, "time.duration": 3.0,
        "friction.kind": "coulomb", "friction.coefficient": 0.3,
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("joint_friction", changes))
    assert run.stopped is None
    kinds = [event.kind for event in run.events if event.kind in ("stick", "slip")]
    assert "slip" in kinds
    assert len(kinds) < 100
    assert np.all(np.linalg.norm(run.friction_force, axis=1) <= 0.3 * run.contact_force * (1.0 + 1e-9))
    assert run.summary()["max_energy_residual"] < 0.05 * run.summary()["energy_exchanged"]


def test_the_report_says_how_far_friction_is_off_a_slow_slip(capsys):
    """A block at 0.4 mm/s that is pushed across: the largest angle, by hand from columns; none if it goes straight."""

    def push(t, q, v, terms):
        return terms.bias - 2.0 * terms.jacobian[2] + across * terms.jacobian[1]

    changes = {
        "robot.model": "pointmass3", "start": {"v": [4e-4, 0.0, 0.0]}, "reference": {"kind": "hold"}, "law.kp": 0.0,
        "law.kd": 0.0, "friction": {"kind": "coulomb", "coefficient": 0.3}, "time.duration": 0.01,
    }  # fmt: skip
    for across in (0.0, 0.8):
        run = cl.simulate(cl.load_scenario("wam_slide", changes), law=push, engine="pinocchio")
        off = run.summary()["friction_off_slip"]
        if across == 0.0:
            assert off is None
    slip, friction = run.slip_velocity[:, :2] @ [1, 1j], -run.friction_force[:, :2] @ [1, 1j]
    turn = np.degrees(np.abs(np.angle(friction / slip)))
    assert off["max_angle"] == pytest.approx(np.max(turn), rel=1e-6)
    assert off["max_angle"] > 20.0
    assert off["at"] == run.time[np.argmax(turn)]
    assert off["below_speed"] == pytest.approx(np.max(np.abs(slip[turn > 1.0])), rel=1e-12)
    print_report(run, width=100)
    assert "friction off the slip" in capsys.readouterr().out


@pytest.mark.slow  # compiles the adaptive scheme with friction
def test_a_slow_block_turns_as_an_adaptive_scheme_says():
    """A block that slides off along x and is pushed along y: Euler's path nears that of DOP853 with its order, one."""

    def push(t, q, v, terms):
        return terms.bias - 2.0 * terms.jacobian[2] + 0.8 * terms.jacobian[1]

    base = {
        "robot.model": "pointmass3",
        "start": {"v": [2e-3, 1e-4, 0.0]},
        "reference": {"kind": "hold"},
        "law.kp": 0.0,
        "law.kd": 0.0,
        "friction": {"kind": "coulomb", "coefficient": 0.3},
        "stabiliser": {"kind": "projection"},
    }

    def run(**time):
        return cl.simulate(
            cl.load_scenario("wam_slide", base | {"time": {"duration": 0.1, "step": 1e-3} | time}), law=push
        )

    truth = run(integrator="dop853")
    far = [np.max(np.abs(run(step=h).position[:: round(1e-3 / h)] - truth.position)) for h in (1e-3, 5e-4, 2.5e-4)]
    assert far[0] < 2e-5
    assert far[0] / far[2] == pytest.approx(4.0, rel=0.3)


def test_a_closure_pulls_where_it_cannot_push():
    """With μ above S_nn/|S_nt| one direction of slip wedges a tip that pushes, the other one that pulls; no more."""
    robot = cl.Robot(robot_models.load("planar2"), "tip")
    q = np.array([0.3, -0.4])
    terms = robot.terms(q, np.zeros(2))
    S = terms.jacobian @ np.linalg.solve(terms.mass_matrix, terms.jacobian.T)
    mu, wedging = 1.5 * S[2, 2] / abs(S[2, 0]), np.sign(S[2, 0])
    for force, direction in ((10.0, 1.0), (10.0, -1.0), (-10.0, 1.0), (-10.0, -1.0)):
        v = np.linalg.lstsq(terms.jacobian[[0, 2]], [0.05 * direction * wedging, 0.0], rcond=None)[0]
        scenario = cl.load_scenario(
            "planar2_slide",
            {
                "start.q": q.tolist(),
                "start.v": v.tolist(),
                "friction": {"kind": "coulomb", "coefficient": float(mu)},
                "reference": {"kind": "hold"},
                "law.force": force,
                "law.kp": 0.0,
                "law.kd": 0.0,
                "time.duration": 0.005,
            },
        )
        if force * direction > 0.0:
            with pytest.raises(cl.PainleveError):
                cl.simulate(scenario)
        else:
            run = cl.simulate(scenario)
            assert run.contact_force[0] * force > 0.0
            assert run.residual_motion.max() < 1e-12


def test_a_tip_that_friction_lifts_and_the_torque_presses_stays_with_no_force():
    """Viscous friction alone would lift it: it touches with f = 0 and the share of friction that is in balance."""
    press = 0.2  # m/s², of the tip without contact
    changes = {
        "surface.contact": "unilateral", "reference": {"kind": "hold"}, "stabiliser": {"kind": "none"},
        "friction": {"kind": "coulomb_viscous", "coefficient": 0.1, "viscous": 5.0}, "time.duration": 0.02,
        "time.integrator": "rk4",
    }  # fmt: skip
    problem = cl.prepare(cl.load_scenario("planar2_slide", changes))
    frame, terms = problem.surface.frame[:2], problem.robot.terms(problem.q, problem.v)
    start = np.linalg.solve(frame @ terms.jacobian, [0.0, -0.3])

    def towards_the_surface(t, q, v, terms):
        A = frame[0] @ terms.jacobian
        return terms.bias + terms.mass_matrix @ A * (-press - frame[0] @ terms.drift) / (A @ A)

    run = cl.simulate(cl.load_scenario("planar2_slide", changes | {"start.v": start.tolist()}), law=towards_the_surface)
    assert np.all(run.mode == 1)
    assert not run.events
    assert np.max(np.abs(run.contact_force)) == 0.0
    assert np.max(np.abs(run.closure_error)) < 1e-9
    for k in (0, 10, 20):
        terms = problem.robot.terms(run.q[k], run.v[k])
        A = frame @ terms.jacobian
        S = A @ np.linalg.solve(terms.mass_matrix, A.T)
        assert frame[1] @ run.friction_force[k] == pytest.approx(press / S[0, 1], rel=1e-9)
        assert abs(frame[1] @ run.friction_force[k]) < 5.0 * abs(frame[1] @ run.slip_velocity[k])


def test_a_tip_that_the_surface_would_have_to_pull_at_slips():
    """Held along the surface it would be lifted, and without any force it comes back: neither stuck nor free."""
    changes = {"law.kind": "impedance", "friction.kind": "coulomb", "friction.coefficient": 0.3, "time.duration": 0.24}
    run = cl.simulate(cl.load_scenario("panda_scan", changes))
    touching = run.contact_force > 0.0
    assert [event.kind for event in run.events] == ["touchdown"]
    assert np.array_equal(touching, run.time >= run.events[0].time)
    assert np.all(np.linalg.norm(run.friction_force, axis=1) <= 0.3 * run.contact_force * (1.0 + 1e-9))
