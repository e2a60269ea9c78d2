"""The force sensor: noise, bias, steps, low-pass and delay, each by what it is defined by."""

import numpy as np
import pytest
from rounding import within

from closedloop.base.errors import ScenarioError
from closedloop.control.sensor import (
    SensorSection,
    continuous_reading,
    draws,
    pack_sensor,
    quantised,
    sense,
    sensor_rates,
    start_sensor,
)
from closedloop.jit.interpreted import interpreted

H = 1e-3


def readings(section, forces, period=H):
    """Return what the sensor says to a row of forces, one a sample, at rest in the first of them before."""
    sensor = pack_sensor(section, period)
    ring, z, dz = np.zeros(sensor.ring), np.zeros(sensor.states), np.zeros(sensor.states)
    start_sensor(forces[0], sensor.par, z, ring)
    normal = draws(section, len(forces))
    out = []
    for k, f in enumerate(forces):
        out.append(interpreted(sense)(f, k, sensor.par, z, normal[k], ring))
        interpreted(sensor_rates)(f, sensor.par, z, dz)
        z += period * dz
    return np.array(out)


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


@pytest.mark.parametrize("change", [{"noise": 0.1}, {"quantisation": 0.1}, {"delay": H}])
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
    assert interpreted(continuous_reading)(99.0, sensor.par, np.array([10.2])) == 10.7
    assert interpreted(continuous_reading)(10.2, pack_sensor(SensorSection(bias=0.5), H).par, np.zeros(0)) == 10.7


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"delay": 0.0015},
            r"sensor\.delay = 0\.0015 s: must be a whole number of samples of 0\.001 s, such as 0\.002 s",
        ),
        ({"delay": 1e-5}, r"sensor\.delay = 1e-05 s: must be a whole number of samples .* such as 0\.001 s"),
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
