"""Force feedback against its closed forms, and the sampled loop's limits from both sides."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from control_loop import Loop, force_loop_radius
from sensor_chain import OneAxis

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.control.compensation.model import ModelCompensation
from closedloop.control.compensation.observer import ObserverCompensation
from closedloop.control.law import commanded_force, force_error_rate
from closedloop.control.laws.admittance import AdmittanceLaw
from closedloop.control.laws.dynamic_hybrid import DynamicHybridLaw
from closedloop.control.laws.hybrid import HybridLaw
from closedloop.control.laws.impedance import ImpedanceLaw
from closedloop.control.laws.operational_space import OperationalSpaceLaw
from closedloop.control.laws.paper import PaperLaw
from closedloop.control.sensor import SensorSection
from closedloop.jit.interpreted import interpreted
from closedloop.simulation.time_step import check_sampling, force_loop_settles

SECTIONS = (OperationalSpaceLaw, DynamicHybridLaw, ImpedanceLaw, AdmittanceLaw)
JOINT_LAWS = (partial(PaperLaw, kp=400.0, kd=30.0), partial(HybridLaw, kp=400.0, kd=30.0))


def push(loop, d):
    """Load the joints so that the force is off by d newtons, and nothing else: the plane takes all of it up."""
    loop.disturbance = -loop.moment(0.0, loop.q, loop.v)[0].A[0] * d


@pytest.mark.slow
@pytest.mark.parametrize("section", SECTIONS[:3] + JOINT_LAWS, ids=lambda s: getattr(s, "func", s).__name__)
@pytest.mark.parametrize("name", ["wam4", "planar2"])
def test_integral_feedback_alone_decays_exponentially(section, name):
    """e_f = e_f(0) exp(−K_I t) on any arm: 2 % are left at 3.912/K_I; a start off the set point and a load alike."""
    for load in (False, True):
        loop = Loop(name, section(force_integral=20.0))
        if load:
            push(loop, -3.0)
        else:
            loop.z[0] = -3.0 / 20.0
        run = loop.run(3.912 / 20.0 + 3e-3, h=2e-3, scheme="rk4")
        e = 10.0 - run["f"]
        assert e[0] == pytest.approx(3.0, abs=1e-9)
        assert np.max(np.abs(e - e[0] * np.exp(-20.0 * run["t"]))) < 1e-6
        assert abs(e[-1] / e[0]) == pytest.approx(0.02, rel=2e-2)


def test_proportional_and_integral_feedback():
    """With both, the error under a constant load is d/(1 + K_f) exp(−K_I t/(1 + K_f)), once the samples settled."""
    K_f, K_I, d = 0.5, 20.0, 2.0
    loop = Loop("wam4", OperationalSpaceLaw(force_feedback=K_f, force_integral=K_I))
    push(loop, d)
    run = loop.run(0.12, h=2.5e-4)
    e = run["f"] - 10.0
    closed_form = d / (1.0 + K_f) * np.exp(-K_I * run["t"] / (1.0 + K_f))
    settled = run["t"] > 0.01
    assert np.max(np.abs(e / closed_form - 1.0)[settled]) < 1e-2
    assert e[0] == pytest.approx(d, abs=1e-9)  # the reading is still that of before the load


def test_proportional_feedback_leaves_a_share_of_the_error():
    """With K_f alone d/(1 + K_f) of the error stays: the fixed point of the sampled loop."""
    loop = Loop("panda", DynamicHybridLaw(force_feedback=0.6))
    push(loop, 2.0)
    assert loop.run(0.06)["f"][-1] - 10.0 == pytest.approx(2.0 / 1.6, abs=1e-8)


@pytest.mark.parametrize("name", ["wam4", "panda", "ur5"])
def test_joint_friction_disturbs_the_force_as_predicted(name):
    """Joint friction τ_f costs f the share (A H⁻¹Aᵀ)⁻¹A H⁻¹τ_f, in f_des − f; known exactly, it costs nothing."""
    rng = np.random.default_rng(4)
    n = len(Loop(name, SECTIONS[0]()).q)
    v = rng.uniform(0.1, 0.3, n) * rng.choice([-1.0, 1.0], n)
    known = ModelCompensation(joint_coulomb=0.8, joint_viscous=0.3, joint_smoothing_speed=1e-12)
    errors = []
    for compensation in (None, known):
        loop = Loop(name, OperationalSpaceLaw(), compensation, v=v)
        loop.friction.joint_coulomb, loop.friction.joint_viscous = 0.8, 0.3
        loop.joints = lambda t: (loop.q_start, v)  # noqa: B023 - evaluated at once
        x, _ = loop.moment(0.0, loop.q, v)
        loop.path = lambda t: (np.zeros(3), x.u, np.zeros(3))  # noqa: B023
        loss = 0.8 * np.sign(v) + 0.3 * v
        # the stabiliser's share of f, for a state that moves along the normal
        share = -100.0 * x.u[0] / x.S[0, 0]
        F = loop.evaluate(0.0, loop.q, v, loop.z)[1]
        errors.append(F[0] - share - 10.0)
    predicted = x.A[0] @ np.linalg.solve(x.H, loss) / x.S[0, 0]
    assert abs(predicted) > 0.1
    assert errors[0] == pytest.approx(predicted, abs=1e-9)
    assert abs(errors[1]) < 1e-9


def test_observer_takes_a_constant_load_out():
    """A load on the joints is estimated with the rate K_o, and the force error goes with exp(−K_o t)."""
    loop = Loop("wam4", OperationalSpaceLaw(), ObserverCompensation(rate=50.0))
    push(loop, 2.5)
    run = loop.run(0.1, h=1e-3, scheme="rk4")
    e = run["f"] - 10.0
    assert np.max(np.abs(e - 2.5 * np.exp(-50.0 * run["t"]))) < 1e-6
    x, _ = loop.moment(0.0, loop.q, loop.v)
    estimate = 50.0 * (loop.v - loop.z[loop.packed[0].states :])
    assert x.H @ estimate == pytest.approx(loop.disturbance, abs=0.01 * np.max(np.abs(loop.disturbance)))


def test_admittance_moves_its_set_point_until_the_force_is_right():
    """M ẍ + (B + K_v/S) ẋ + K_p/S x = d, and f − f_des = d − (K_v ẋ + K_p x)/S, from the two roots of it."""
    law = AdmittanceLaw(admittance_inertia=2.0, admittance_damping=150.0)
    loop = Loop("wam4", law)
    push(loop, 2.0)
    S = loop.moment(0.0, loop.q, loop.v)[0].S[0, 0]
    run = loop.run(0.5, h=1e-3, scheme="rk4")
    c, k = (150.0 + 40.0 / S) / 2.0, 400.0 / S / 2.0
    a, b = np.roots([1.0, c, k]).astype(complex)
    t = run["t"]
    x = (2.0 / (2.0 * k) * (1.0 - (b * np.exp(a * t) - a * np.exp(b * t)) / (b - a))).real
    rate = (2.0 / (2.0 * k) * (-(a * b) * (np.exp(a * t) - np.exp(b * t)) / (b - a))).real
    assert np.max(np.abs(run["z"][:, 1] - x)) < 1e-8
    assert np.max(np.abs(run["f"] - 10.0 - (2.0 - (40.0 * rate + 400.0 * x) / S))) < 1e-5
    assert abs(run["f"][-1] - 10.0) < 0.25


def sampled_force(feedback, integral, section, period, samples=4000):
    """Return the force of a rigid contact that reads its sensor every period, under a load of 1 N from the start on."""
    chain = OneAxis(section, period, 10.0)
    sensor = chain.sensor
    z, measured, forces = 0.0, 10.0, []
    for _ in range(samples):
        f = 10.0 + feedback * (10.0 - measured) + integral * z + 1.0
        forces.append(f)
        if abs(f) > 1e9:
            break
        now = chain.z[0] if sensor.states else f
        z += period * (10.0 - (measured if sensor.sampled else now))
        measured = chain.read(f)
    return np.array(forces)


@pytest.mark.parametrize(
    ("section", "period"),
    [
        (SensorSection(), 1e-3),
        (SensorSection(delay=0.003), 1e-3),
        (SensorSection(filter_time_constant=0.01), 1e-3),
        (SensorSection(filter_time_constant=0.01, delay=0.004), 2e-3),
    ],
)
def test_largest_feedback_is_where_the_sampled_loop_starts_to_diverge(section, period):
    """A little below the limit the loop settles, above it grows: for K_f, for K_I, and in the refusal's text."""
    for gain in ("force_feedback", "force_integral"):
        big = 1e4

        def radius(value, gain=gain):
            pair = (value, 0.0) if gain == "force_feedback" else (0.0, value)
            return force_loop_radius(*pair, section, period)

        low, high = 0.0, big
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if radius(middle) <= 1.0 else (low, middle)
        for factor in (0.98, 1.02):
            pair = (factor * low, 0.0) if gain == "force_feedback" else (0.0, factor * low)
            forces = sampled_force(*pair, section, period)
            early, late = np.ptp(forces[100:200]), np.ptp(forces[-100:])
            assert (late < early) == (factor < 1.0), (gain, low)
        check_sampling(OperationalSpaceLaw(**{gain: 0.98 * low}), None, section, period)
        with pytest.raises(ScenarioError, match=rf"law\.{gain} = .* must be below ") as refused:
            check_sampling(OperationalSpaceLaw(**{gain: 1.02 * low}), None, section, period)
        assert float(str(refused.value).split("must be below ")[1].split()[0]) == pytest.approx(low, rel=0.02)


def test_nyquist_and_eigenvalues_agree_on_the_sampled_loop():
    """Over gains, low-passes and delays the loop settles where all eigenvalues of its recursion do."""
    draw, verdicts = np.random.default_rng(8), []
    for _ in range(400):
        period = 10.0 ** draw.uniform(-4, -2)
        section = SensorSection(
            delay=period * draw.integers(0, 25),
            filter_time_constant=period * draw.choice([0.0, 1.0, draw.uniform(1.0, 200.0)]),
            noise=draw.choice([0.0, 1.0]),
        )
        feedback = draw.choice([0.0, 10.0 ** draw.uniform(-2, 2)])
        integral = draw.choice([0.0, 10.0 ** draw.uniform(-3, 0.5) / period])
        radius = force_loop_radius(feedback, integral, section, period)
        if abs(radius - 1.0) > 1e-9:
            verdicts.append(radius < 1.0)
            assert force_loop_settles(feedback, integral, section, period) == verdicts[-1], (
                section,
                feedback,
                integral,
            )
    assert 100 < sum(verdicts) < len(verdicts) - 100


def test_limit_with_a_long_delay():
    """A reading m samples old bounds K_I at 2 sin(π/(4m + 2))/h, and K_f at 1: for any m, at once."""
    for delay in (0, 1, 20, 999, 9999):
        section, age = SensorSection(delay=1e-3 * delay), delay + 1
        if delay:  # else the integral is of the force itself
            limit = 2.0 * np.sin(np.pi / (4 * age + 2)) / 1e-3
            assert force_loop_settles(0.0, 0.9999 * limit, section, 1e-3)
            assert not force_loop_settles(0.0, 1.0001 * limit, section, 1e-3)
        assert force_loop_settles(0.9999, 0.0, section, 1e-3)
        assert not force_loop_settles(1.0001, 0.0, section, 1e-3)


def test_unfiltered_feedback_must_stay_below_one():
    """A reading one sample old allows K_f < 1, whatever the period; a low-pass of T allows up to T/h."""
    for period in (1e-4, 1e-3):
        assert force_loop_settles(0.999, 0.0, SensorSection(), period)
        assert not force_loop_settles(1.001, 0.0, SensorSection(), period)
    slow = SensorSection(filter_time_constant=0.02)
    assert force_loop_settles(19.9, 0.0, slow, 1e-3)
    assert not force_loop_settles(20.1, 0.0, slow, 1e-3)


def test_fast_feedback_behind_a_low_pass_in_the_closed_loop():
    """K_f = 5 behind a 20 ms low-pass settles in the arm's own loop at d/(1 + K_f)."""
    chain = OneAxis(SensorSection(filter_time_constant=0.02), 1e-3, 10.0)
    loop = Loop("wam4", OperationalSpaceLaw(force_feedback=5.0))
    push(loop, 3.0)
    for _ in range(100):
        F, _ = loop.step(1e-3)
        loop.f_measured = chain.read(F[0])
    assert F[0] - 10.0 == pytest.approx(3.0 / 6.0, abs=1e-3)


def test_observer_faster_than_its_sensor_is_refused():
    """K_o h must stay below 1, and K_o below what a late sensor allows: beyond that the arm's own loop grows."""
    law = OperationalSpaceLaw()
    check_sampling(law, ObserverCompensation(rate=999.0), SensorSection(), 1e-3)
    with pytest.raises(ScenarioError, match=r"compensation\.rate = 1000: diverges .* must be below 1000"):
        check_sampling(law, ObserverCompensation(rate=1000.0), SensorSection(), 1e-3)
    late = SensorSection(delay=0.01)
    with pytest.raises(ScenarioError, match=r"compensation\.rate = 900: .* must be below ") as refused:
        check_sampling(law, ObserverCompensation(rate=900.0), late, 1e-3)
    limit = float(str(refused.value).rsplit(maxsplit=1)[1])
    assert 100.0 < limit < 200.0
    grown = []
    for rate in (0.9 * limit, 1.1 * limit):
        loop = Loop("wam4", law, ObserverCompensation(rate=rate))
        chain, readings = OneAxis(late, 1e-3, 10.0), loop.rates
        loop.rates = lambda x, f, torque, z=None: readings(x, loop.f_measured, torque, z)  # noqa: B023 - used at once
        push(loop, 0.1)
        forces = []
        for _ in range(600):
            F, _ = loop.step(1e-3)
            loop.f_measured = chain.read(F[0])
            forces.append(F[0])
        grown.append(np.ptp(forces[500:]) / np.ptp(forces[:100]))
    assert grown[0] < 0.5
    assert grown[1] > 2.0


@pytest.mark.parametrize("integral", [-0.2, 0.0, 0.2])
@pytest.mark.parametrize("reading", [4.0, 10.0, 13.0])
def test_feedback_adds_in_contact_alone_and_takes_away_in_free_motion_too(reading, integral):
    """f_c = f_des + K_f (f_des − f_s) + K_I z on the surface; off it the feedback may only make it less."""
    loop = Loop("wam4", OperationalSpaceLaw(force_feedback=0.5, force_integral=20.0))
    x = loop.moment(0.0, loop.q, loop.v)[0]._replace(f_measured=reading)
    z = SimpleNamespace(force_error=integral)
    feedback = 0.5 * (10.0 - reading) + 20.0 * integral
    for pressed, expected in ((1.0, 10.0 + feedback), (0.0, 10.0 + min(feedback, 0.0))):
        found = interpreted(commanded_force)(x._replace(pressed=pressed), loop.law, z)
        assert found == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("pressed", "f_des", "f", "integral", "rate"),
    [
        (1.0, 10.0, 7.0, 0.1, 3.0),
        (1.0, -4.0, 7.0, -0.1, -11.0),
        (0.0, 10.0, 0.0, 0.1, 0.0),  # it does not wind up
        (0.0, 10.0, 0.0, -0.1, 10.0),  # it recovers
        (0.0, 10.0, 0.0, 0.0, 0.0),
        (0.0, 10.0, 12.0, -0.1, 0.0),  # but does not fall further
        (0.0, -4.0, -7.0, -0.1, 0.0),  # nor recovers for a tip that is to stay away
    ],
)
def test_integral_rests_in_free_motion_but_for_its_recovery(pressed, f_des, f, integral, rate):
    """On the surface ż = f_des − f; off it z rises to zero at most, if the tip is to press."""
    loop = Loop("wam4", OperationalSpaceLaw(force_integral=20.0))
    x = loop.moment(0.0, loop.q, loop.v)[0]._replace(pressed=pressed, f_des=f_des)
    assert interpreted(force_error_rate)(x, loop.law, SimpleNamespace(force_error=integral), f) == rate


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_set_points_of_a_servo_gain_speed_off_the_surface_and_press_on_it(engine):
    """Off it ẋ_a = −g f_des t/M up to its limit, exactly; on a soft surface the force comes to f_des, to 0.1 N."""
    law = {
        "kind": "servo_admittance", "kp": 2e4, "kd": 600.0, "force": 20.0, "gain_scaling": 0.5, "speed_limit": 0.1,
        "admittance_inertia": 5.0, "admittance_damping": 0.0, "contact_damping": 300.0,
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("soft_table", {
        "robot.model": "pointmass3", "start.q": [0.0, 0.0, 0.0], "surface.gap": 0.003, "surface.contact": "unilateral",
        "compliance.stiffness": 5e3, "compliance.damping": 20.0, "reference": {"kind": "hold"}, "law": law,
        "time.duration": 0.5, "time.integrator": "rk4",
    }), engine=engine, progress=False)  # fmt: skip
    free = np.cumprod(run.mode == 0).astype(bool)
    wanted = np.maximum(-0.5 * 20.0 * run.time / 5.0, -0.1)[free]
    assert free.sum() > 50
    assert run.law_set_point_rate[free] == pytest.approx(wanted, abs=2e-3 + 1e-12)
    assert np.abs(run.law_set_point_rate[free] - wanted)[run.time[free] < 0.05] == pytest.approx(0.0, abs=1e-12)
    assert run.contact_force[-1] == pytest.approx(20.0, abs=0.1)
