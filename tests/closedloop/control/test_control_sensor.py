"""The force sensor: noise, bias, steps, low-pass and delay, each by what it is defined by."""

import numpy as np
import pytest
from rounding import within
from sensor_chain import OneAxis

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.control.sensor import (
    SensorSection,
    bias_at,
    continuous_reading,
    draws,
    pack_sensor,
    quantised,
    signal_of,
)
from closedloop.jit.interpreted import interpreted

H = 1e-3


def readings(section, forces, period=H):
    """Return what the sensor says to a row of forces, one a sample, at rest in the first of them before."""
    chain = OneAxis(section, period, forces[0])
    normal = draws(section, len(forces))[:, 0]
    return np.array([chain.read(f, z) for f, z in zip(forces, normal, strict=True)])


FORCES = 10.0 + 3.0 * np.sin(np.linspace(0.0, 7.0, 400))


def test_ideal_sensor_says_the_force():
    """As it stands the sensor gives every sample to the last bit."""
    assert np.array_equal(readings(SensorSection(), FORCES), FORCES)
    assert pack_sensor(SensorSection(), H).sampled is False


def test_bias_is_added():
    """A bias shifts every reading by itself."""
    assert within(16, readings(SensorSection(bias=-0.3), FORCES), FORCES - 0.3)


def test_readings_come_in_steps():
    """Every reading is a whole number of steps, and none is further than half a step from the force."""
    said = readings(SensorSection(quantisation=0.05), FORCES)
    assert np.max(np.abs(said / 0.05 - np.round(said / 0.05))) < 1e-9
    assert 0.02 < np.max(np.abs(said - FORCES)) <= 0.025 + 1e-12
    assert len(np.unique(said)) > 50


def test_what_a_double_resolves_no_finer_is_not_quantised():
    """Beyond 2⁵² quanta, and where there is no number, the reading stays as it is."""
    for reading in (5e3, -1e9, 1e300, np.inf, -np.inf):
        assert interpreted(quantised)(reading, 1e-12) == reading
    assert np.isnan(interpreted(quantised)(np.nan, 1e-12))


def test_delay_shifts_by_whole_samples():
    """A delay of three samples gives the force of three samples ago, and the start's before."""
    said = readings(SensorSection(delay=0.003), FORCES)
    assert np.array_equal(said[3:], FORCES[:-3])
    assert np.array_equal(said[:3], np.full(3, FORCES[0]))


def test_noise_is_white_and_of_the_given_size():
    """Noise has the deviation asked for, no mean, no correlation from sample to sample, and follows the seed."""
    count = 20_000
    flat = np.full(count, 10.0)
    said = readings(SensorSection(noise=0.2, seed=3), flat) - 10.0
    assert np.std(said) == pytest.approx(0.2, rel=4 / np.sqrt(2 * count))
    assert abs(np.mean(said)) < 4 * 0.2 / np.sqrt(count)
    assert abs(np.mean(said[1:] * said[:-1])) < 4 * 0.04 / np.sqrt(count)
    assert np.array_equal(said, readings(SensorSection(noise=0.2, seed=3), flat) - 10.0)
    assert not np.array_equal(said, readings(SensorSection(noise=0.2, seed=4), flat) - 10.0)


def test_low_pass_answers_a_step_with_an_exponential():
    """After a step 1 − exp(−t/T) of it is read; halving the step of integration halves the difference from that."""
    T, errors = 0.02, []
    for period in (1e-3, 5e-4):
        t = period * np.arange(round(0.1 / period))
        said = readings(SensorSection(filter_time_constant=T), np.where(t > 0.0, 12.0, 10.0), period)
        errors.append(np.max(np.abs(said - (12.0 - 2.0 * np.exp(-np.maximum(t - period, 0.0) / T)))))
    assert errors[0] < 0.03
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.15)


def test_drift_grows_and_the_range_ends():
    """The error after t seconds is b + b' t; beyond its range a sensor reads the end of it."""
    drifted = readings(SensorSection(bias=0.1, drift=2.0), FORCES)
    assert within(16, drifted, FORCES + 0.1 + 2.0 * H * np.arange(len(FORCES)))
    cut = readings(SensorSection(saturation=11.0, bias=0.5), FORCES)
    assert within(16, cut, np.minimum(FORCES + 0.5, 11.0))
    assert np.max(FORCES) > 12.0


# A tip that slides under a ramp of force: friction of μ f along −t2.
SLIDING = {
    "time.duration": 0.4,
    "reference": {"kind": "line", "direction": [0, 1, 0], "speed": 0.1, "start": 0.0, "stop": 1.0},
    "friction": {"kind": "coulomb", "coefficient": 0.3},
    "force_profile": {"kind": "waypoints", "times": [0.0, 0.4], "forces": [10.0, 14.0]},
    "sensor.axes": 3,
}


def test_cross_talk_adds_shares_of_the_other_axes():
    """The reading of n has its own share of the force along each axis, with one axis too; a low-pass lies behind it."""
    talk = [[0.02, 0.0, 0.1], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    for axes in (1, 3):
        run = cl.simulate(cl.load_scenario("wam_slide", SLIDING | {"sensor.cross_talk": talk, "sensor.axes": axes}))
        f, tangential = run.contact_force, run.friction_force[:, 1]
        assert np.min(tangential) < -3.0
        assert np.allclose(run.measured_force, 1.02 * f + 0.1 * tangential, rtol=0, atol=1e-12)
    section = {"sensor.cross_talk": talk, "sensor.filter_time_constant": 0.01}
    run = cl.simulate(cl.load_scenario("wam_slide", SLIDING | section))
    felt, filtered = 1.02 * run.contact_force + 0.1 * run.friction_force[:, 1], 10.0 * 1.02
    for k in range(len(run)):
        assert run.measured_force[k] == pytest.approx(filtered, abs=1e-9)
        filtered += 0.1 * (felt[k] - filtered)


def test_jitter_reads_a_ramp_late_by_what_is_drawn():
    """On a line between two samples the reading is that of the instant of the sample: late by up to the bound."""
    late = 6e-4
    runs = [cl.simulate(cl.load_scenario("wam_slide", SLIDING | {"sensor.jitter": x})) for x in (0.0, late)]
    assert np.array_equal(runs[0].contact_force, runs[1].contact_force)
    f, drawn = runs[1].contact_force, draws(SensorSection(jitter=late), len(runs[1]))[:, 3]
    expected = f[1:] - late / H * drawn[1:] * np.diff(f)
    assert np.allclose(runs[1].measured_force[1:], expected, rtol=0, atol=1e-12)
    assert 0.45 < np.mean(drawn) < 0.55
    assert np.max(np.abs(f[1:] - expected)) > 1e-3


def test_a_law_reads_the_tangential_force_of_three_axes():
    """The reading along t2 is friction, of the last row; with one axis there is none."""
    for axes in (3, 1):
        seen = []

        def law(x, seen=seen):
            seen.append(np.array([x.t, *x.f_tangential]))
            return x.C - x.A[0] * 10.0 + x.A[2] * 4.0

        changes = {"time.duration": 0.05, "sensor.axes": axes, "force_profile": {"kind": "constant"}}
        run = cl.simulate(cl.load_scenario("wam_slide", SLIDING | changes), law=law)
        told = np.array(seen)
        rows = [int(np.flatnonzero(np.isclose(told[:, 0], t))[0]) for t in run.time[1:]]
        wanted = run.friction_force[:-1, :2] if axes == 3 else np.zeros((len(run) - 1, 2))
        assert np.allclose(told[rows, 1:], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("change", [{"noise": 0.1}, {"quantisation": 0.1}, {"delay": H}, {"jitter": H}])
def test_each_error_of_a_sample_makes_the_sensor_sampled(change):
    """Noise, steps and delay each by themselves; a bias and a low-pass are there between samples too."""
    assert pack_sensor(SensorSection(**change), H).sampled is True
    assert pack_sensor(SensorSection(bias=1.0, filter_time_constant=0.01), H).sampled is False


def test_a_delay_may_be_written_with_ten_digits():
    """A thousand samples of 1/3 ms are a whole number of them as 0.3333333333 s; a ten-thousandth of one is none."""
    assert pack_sensor(SensorSection(delay=0.3333333333), 1.0 / 3000.0).ring == 1001
    with pytest.raises(ScenarioError, match="whole number of samples"):
        pack_sensor(SensorSection(delay=0.3333333333 + 1e-4 / 3000.0), 1.0 / 3000.0)


def test_continuous_reading_is_low_passed_and_biased_only():
    """Between samples the sensor has neither noise, nor steps, nor delay."""
    section = SensorSection(noise=1.0, bias=0.5, quantisation=1.0, delay=0.002, filter_time_constant=0.01)
    sensor = pack_sensor(section, H)
    assert sensor.sampled is True
    assert sensor.ring == 3
    assert interpreted(signal_of)(99.0, sensor.par, np.array([10.2])) == 10.2
    assert interpreted(continuous_reading)(10.2, interpreted(bias_at)(3.0, 0, sensor.par), sensor.par) == 10.7


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"delay": 0.0015},
            r"sensor\.delay = 0\.0015 s: must be a whole number of samples of 0\.001 s, such as 0\.002 s",
        ),
        ({"delay": 1e-5}, r"sensor\.delay = 1e-05 s: must be a whole number of samples .* such as 0\.001 s"),
        ({"jitter": 0.002}, r"sensor\.jitter = 0\.002 s: must be at most the 0\.001 s between two samples"),
        ({"delay": 1e6}, r"sensor\.delay = 1e\+06 s: must be at most 10000 samples, 10 s"),
        ({"delay": 1e9}, r"sensor\.delay = 1e\+09 s: must be at most 10000 samples"),
        (
            {"filter_time_constant": 5e-4},
            r"sensor\.filter_time_constant = 0\.0005 s: must be 0, or at least the 0\.001 s",
        ),
    ],
)
def test_what_does_not_fit_the_samples_is_refused(changes, text):
    """A delay between samples, one without end, and a low-pass faster than the samples."""
    with pytest.raises(ScenarioError, match=text):
        pack_sensor(SensorSection(**changes), H)
