"""Encoders: what the law sees is read once a step, with noise and quantisation, and all that follows from it."""

import numpy as np
import pytest
from rounding import within

import closedloop as cl

SHORT = {"time.duration": 0.12, "law.pd_start": 0.05}
NOISY = {"encoder.noise": 2e-5, "encoder.quantisation": [1e-4, 5e-5, 0.0, 1e-6], "encoder.velocity_noise": 1e-3}
DIFFERENCES = {"encoder.noise": 1e-6, "encoder.velocity": "difference", "encoder.filter_time_constant": 0.004}


def slide(changes, **options):
    """Return a run of the slide."""
    return cl.simulate(cl.load_scenario("wam_slide", SHORT | changes), **options)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_a_perfect_encoder_samples_the_law_and_nothing_else(integrator):
    """To the bit: what it reads is the state, and the terms of the reading are those of the state."""
    changes = {
        "time.integrator": integrator,
        "friction.kind": "coulomb",
        "friction.coefficient": 0.2,
        "time.duration": 0.08,
    }
    plain, measured = slide(changes | {"law.sample_period": 0.001}), slide(changes | {"encoder.seed": 1})
    assert np.array_equal(measured.measured_position, plain.q)
    for name in ("q", "v", "torque", "contact_force", "mode"):
        assert np.array_equal(getattr(measured, name), getattr(plain, name)), name


def test_the_law_computes_everything_from_its_readings():
    """q and q̇ of the law are the columns' readings; H, C, the tip and its Jacobian are those of the readings."""
    seen = []

    def spy(x):
        seen.append([part.copy() for part in (x.q, x.v, x.C, x.H, x.J, x.r, x.Jdot_v, x.u)])
        return x.C - 10.0 * x.A[0]

    run = slide(NOISY | {"time.duration": 0.02}, law=spy)
    assert np.array_equal([each[0] for each in seen], run.measured_position)
    assert np.array_equal([each[1] for each in seen], run.measured_velocity)
    robot, frame = cl.prepare(run.scenario).robot, cl.prepare(run.scenario).frame
    for q, v, C, H, J, r, drift, u in seen:
        terms = robot.terms(q, v)
        assert within(512, C, terms.bias)
        assert within(16, H, terms.mass_matrix)
        assert within(16, J, terms.jacobian)
        assert within(16, r, terms.position)
        assert within(64, drift, terms.drift, 9.81)
        assert within(16, u, frame @ terms.jacobian @ v)


def test_what_is_wanted_is_not_measured():
    """A law behind encoders is told the same path, force and contact as one that knows the state."""
    circle = {"kind": "circle", "radius": 0.03, "direction": [0.0, 1.0, 0.0], "start": 0.0, "stop": 0.1}
    given = []

    def spy(x):
        given.append([*x.q_des, *x.v_des, *x.qdd_des, *x.p_des, *x.u_des, *x.a_des, x.f_des, x.pressed])
        return x.C - 10.0 * x.A[0]

    for changes in ({"law.sample_period": 0.001}, NOISY):
        slide(changes | {"reference": circle, "time.duration": 0.02}, law=spy)
    knowing, measuring = np.split(np.array(given), 2)
    assert np.array_equal(knowing, measuring)
    assert np.all(knowing[:, -2:] == [10.0, 1.0])
    assert np.all(np.any(knowing[-1, 12:21].reshape(3, 3) != 0.0, axis=1))


def test_readings_are_quantised_and_as_noisy_as_asked_for():
    """Whole quanta, half a quantum and the noise from the truth; white noise as large as asked for, each its own."""
    run, quanta = slide(NOISY | {"time.duration": 1.0}), np.array(NOISY["encoder.quantisation"])
    off, noise = run.measured_position - run.q, NOISY["encoder.noise"]
    coarse = quanta > 0.0
    steps = run.measured_position[:, coarse] / quanta[coarse]
    assert np.max(np.abs(steps - np.round(steps))) < 1e-9
    assert np.all(np.abs(off) <= quanta / 2 + 5 * noise)
    assert np.std(off[:, 2]) == pytest.approx(noise, rel=0.1)
    assert np.std(run.measured_velocity - run.v) == pytest.approx(1e-3, rel=0.05)
    assert abs(np.corrcoef(off[1:, 2], off[:-1, 2])[0, 1]) < 0.15
    each = np.corrcoef(np.hstack([off[:, 2:], run.measured_velocity - run.v]).T)
    assert np.max(np.abs(each - np.eye(6))) < 0.15


def test_a_velocity_by_differences_is_that_of_the_readings():
    """The low-pass of the difference quotients of the recorded readings, to the bit; the first is the true one."""
    run, h, T = slide(DIFFERENCES), 0.001, DIFFERENCES["encoder.filter_time_constant"]
    q, v = run.measured_position, run.measured_velocity
    raw = (q[1:] - q[:-1]) / h
    assert np.array_equal(v[0], run.v[0])
    assert np.array_equal(v[1:], v[:-1] + (h / (T + h)) * (raw - v[:-1]))


@pytest.mark.parametrize("changes", [NOISY, DIFFERENCES], ids=["noisy", "differences"])
def test_engines_file_simulator_and_batch_agree(changes, tmp_path):
    """The engines to rounding, the rest to the bit; another seed is another run."""
    run, other = slide(changes), slide(changes, engine="compiled")
    assert np.allclose(run.measured_position, other.measured_position, rtol=0, atol=1e-12)
    assert np.allclose(run.contact_force, other.contact_force, rtol=0, atol=1e-6)
    loaded = cl.load_run(run.save(tmp_path / "run.nc"))
    assert np.array_equal(loaded.measured_velocity, run.measured_velocity)
    again = cl.simulate(loaded.scenario, model=loaded.model)
    assert np.array_equal(again.torque, run.torque)
    assert not np.array_equal(slide(changes | {"encoder.seed": 5}).torque, run.torque)
    sim = cl.Simulator(run.scenario)
    sim.reset()
    sim.run_until(0.06)
    sim.step(sim.state.torque)  # the same torque from outside: the law would have given it
    last = sim.run_until(0.12)
    assert np.array_equal(last.measured_velocity, run.measured_velocity[-1])
    assert np.array_equal(sim.run().contact_force, run.contact_force)
    assert np.array_equal(sim.run().measured_position, run.measured_position)
    kept = cl.simulate_batch(run.scenario, {"encoder.seed": [0, 5]}, engine="pinocchio", keep=["measured_position"])
    assert np.array_equal(kept["measured_position"].to_pylist()[0], run.measured_position)


def test_encoders_go_with_events_inside_a_step():
    """A step that is divided by an impact reads its end again, and the same: the noise belongs to the row."""
    changes = {"time.duration": 0.4, "encoder.noise": 1e-5, "encoder.velocity": "difference"}
    run = cl.simulate(cl.load_scenario("planar2_drop", changes))
    assert run.events
    assert np.std(run.measured_position - run.q) == pytest.approx(1e-5, rel=0.1)
    raw = np.diff(run.measured_position, axis=0) / run.scenario.time.step
    assert np.allclose(run.measured_velocity[1:], raw, rtol=0, atol=1e-12)


def test_a_motion_that_diverges_names_the_gains_that_the_law_has_and_what_it_reads():
    """Not those of another law: this one has no kp, and reads angles that are off by radians."""
    changes = {
        "encoder.quantisation": 2.687, "law.posture_stiffness": 191.0, "compliance.kind": "none", "time.duration": 0.3,
    }  # fmt: skip
    with pytest.raises(cl.DivergenceError, match=r"law\.motion_stiffness.*encoder") as caught:
        cl.simulate(cl.load_scenario("panda_polish", changes))
    assert "law.kp" not in str(caught.value)
    with pytest.raises(cl.DivergenceError, match=r"law\.kp and law\.kd, .*transmission\.stiffness, and at time\.step"):
        cl.simulate(
            cl.load_scenario("wam_slide", {"transmission.stiffness": 823.8, "encoder.noise": 0.0, "time.duration": 1.0})
        )


REFUSED = {
    "negative": ({"encoder.noise": -1e-5}, "encoder.noise = -1e-05: must not be negative"),
    "length": ({"encoder.quantisation": [1e-5, 1e-5]}, "encoder.quantisation has 2 entries: the robot has 4 joints"),
    "word": ({"encoder.velocity": "guess"}, "encoder.velocity = 'guess'"),
    "adaptive": ({"encoder.noise": 1e-5, "time.integrator": "dop853"}, "encoder: is sampled once a step"),
    "one count": ({"encoder.quantisation": [0.0, 6.28, 0.0, 0.0]}, "joint J2 moves 3.94444 rad (m) in all"),
    "seed": ({"encoder.seed": -1}, "must be a whole number, 0 or above"),
    "a seed no number holds": ({"encoder.seed": 10**400}, "must be at most 2**128"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """Each with the key, the value and the cure."""
    changes, said = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as refused:
        slide(changes)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
