"""The force sensor: a low-pass, then bias and noise, then quantisation, then a delay.

The low-pass is a state that is integrated with the arm's; all else happens to samples. A controller's reading
is always a sample, hence of an earlier instant than its own.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import FORCE, PERIOD, NotNegative, Number, Section, Size, Unit
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel, plain
from closedloop.jit.parameters import pack, parameter_block

# Samples of the longest delay that is accepted.
MOST_DELAYED = 10_000
# Above this many quanta a double is no finer than a quantum.
MOST_QUANTA = 2.0**52


# No generator draws more from a seed.
MOST_SEED = 2**128


def _seed(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError("must be a whole number, 0 or above")
    if value > MOST_SEED:
        raise ValueError("must be at most 2**128: no generator draws more from a seed")
    return value


Seed = Annotated[int, BeforeValidator(_seed), Unit("")]
QUANTUM = Size(1e9, "N", "no sensor is so coarse", 1e-12, "no sensor is so fine")


class SensorSection(Section):
    """[sensor]: the force sensor; by default ideal: the force at the latest sample."""

    noise: Annotated[NotNegative, FORCE] = Field(0.0, description="standard deviation of white noise, N")
    bias: Annotated[Number, FORCE] = Field(0.0, description="constant error, N")
    quantisation: Annotated[NotNegative, QUANTUM] = Field(0.0, description="step between two readings, N; 0: none")
    filter_time_constant: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="time constant of a first-order low-pass, s; 0: none"
    )
    delay: Annotated[NotNegative, PERIOD] = Field(0.0, description="delay of a reading, s; a whole number of samples")
    seed: Seed = Field(0, description="seed of the noise")


SensorParameters = parameter_block(SensorSection)


class PackedSensor(NamedTuple):
    """A sensor as the kernels read it."""

    par: Block  # its parameters by name
    states: int  # 1 with a low-pass, else 0
    ring: int  # length of the ring buffer that `sense` needs: 1 and the delay in samples
    sampled: bool  # whether noise, quantisation or delay make a reading differ from the continuous signal


def pack_sensor(section: SensorSection, period: float) -> PackedSensor:
    """Turn the section into numbers for a sensor that is sampled every `period`, s.

    Raises
    ------
    ScenarioError
        If the delay is no whole number of samples, or the low-pass is faster than the sampling.
    """
    delay = round(section.delay / period) if section.delay / period < 2 * MOST_DELAYED else 2 * MOST_DELAYED
    if delay > MOST_DELAYED:
        raise ScenarioError(
            f"sensor.delay = {section.delay:g} s: must be at most {MOST_DELAYED} samples, {MOST_DELAYED * period:g} s"
        )
    if abs(delay * period - section.delay) > 1e-9 * max(section.delay, period):
        near = max(1, delay) * period
        raise ScenarioError(
            f"sensor.delay = {section.delay:g} s: must be a whole number of samples of {period:g} s, "
            f"such as {near:.10g} s"
        )
    constant = section.filter_time_constant
    if 0.0 < constant < period:
        raise ScenarioError(
            f"sensor.filter_time_constant = {constant:g} s: must be 0, or at least the {period:g} s between two samples"
        )
    par = SensorParameters(pack(section, 0, "sensor"), 0)
    sampled = delay > 0 or section.noise > 0.0 or section.quantisation > 0.0
    return PackedSensor(par, int(constant > 0.0), delay + 1, sampled)


def draws(section: SensorSection, count: int) -> Array:
    """Return `count` standard normal numbers from the sensor's seed, one a sample."""
    if section.noise == 0.0:
        return np.zeros(count)
    return np.random.default_rng(section.seed).standard_normal(count)


@kernel
def sensor_rates(f_true: float, par: Any, z: Array, dz: Array) -> None:
    """Write the rate of the low-pass z (1,), or nothing if there is none: ż = (f − z)/T."""
    if par.filter_time_constant > 0.0:
        dz[0] = (f_true - z[0]) / par.filter_time_constant


@kernel
def continuous_reading(f_true: float, par: Any, z: Array) -> float:
    """Return the continuous reading at this instant, N: with low-pass and bias, without sampling."""
    return float((z[0] if par.filter_time_constant > 0.0 else f_true) + par.bias)


@kernel
def quantised(reading: float, quantum: float) -> float:
    """Return the reading in whole quanta, N; unchanged if the quantum is 0 or below the resolution of a double."""
    if quantum > 0.0 and abs(reading) < MOST_QUANTA * quantum:
        return float(quantum * math.floor(reading / quantum + 0.5))
    return reading


@kernel
def sense(f_true: float, sample: int, par: Any, z: Array, normal: float, ring: Array) -> float:
    """Take a sample and return the controller's present reading, N.

    Parameters
    ----------
    f_true : float
        Contact force, N.
    sample : int
        How many samples were taken before this one.
    par, z
        See `PackedSensor`; z (1,) is the low-pass, read if there is one.
    normal : float
        A standard normal number, for the noise.
    ring : (delay + 1,) array
        The latest samples; written.
    """
    reading = quantised(continuous_reading(f_true, par, z) + par.noise * normal, par.quantisation)
    size = ring.shape[0]
    ring[sample % size] = reading
    return float(ring[(sample + 1) % size])


def start_sensor(f_true: float, par: Any, z: Array, ring: Array) -> None:
    """Write z and the ring of a sensor in steady state at f_true, N, without noise."""
    if par.filter_time_constant > 0.0:
        z[0] = f_true
    reading = plain(quantised)(f_true + par.bias, par.quantisation)
    for i in range(ring.shape[0]):
        ring[i] = reading
