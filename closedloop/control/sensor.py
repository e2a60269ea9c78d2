"""The sensors. Of force: cross-talk, a low-pass, then bias, drift and noise, saturation, quantisation, a delay.

    s = (1 + X)(F − m r̈)     X: cross-talk; F: the force on the tip along n, t1, t2 of the frame that the law sees
    T ċ = s − c              low-pass
    c_k = c(t_k − τ_k)       τ_k: jitter, uniform between 0 and its bound; c is linear between two samples
    m_k = c_k + b + b' t_k + noise, cut to the range, in whole quanta          b, b': bias and drift, along n alone

m is the mass between sensor and surface: what holds it carries F less what moves it. Its weight is known and taken off.
The low-pass is a state that is integrated with the arm's; what follows it happens to samples, but bias, drift and the
range act between them too. A controller's reading is always a sample, hence of an earlier instant than its own.

The encoders are what the controller knows of the joints' positions and velocities:

    q_m = quantised(q + noise)
    v_m = v + noise                                       velocity = "measured"
    v_m = v_m⁻ + h/(T + h) ((q_m − q_m⁻)/h − v_m⁻)        velocity = "difference": a difference quotient and a low-pass

A reading is taken once a step, at the row, where white noise has a meaning: within a step of Runge and Kutta it has
none. So with encoders the law is sampled, each step unless `law.sample_period` is longer, and its torque is held in
between. A controller computes everything from its readings, so H, C, the tip's position, Jacobian and the contact frame
that it sees are those of q_m and v_m.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import FORCE, PERIOD, Gain, NotNegative, Number, Section, Size, Unit, gains_not_negative
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
DRIFT = Size(1e9, "N/s", "no sensor drifts so fast")
SHARE = Size(1e3, "", "no sensor is so wrong")
_Share = Annotated[Number, SHARE]
_Row = tuple[_Share, _Share, _Share]


class SensorSection(Section):
    """[sensor]: the force sensor; by default ideal: the force at the latest sample."""

    mass: Annotated[NotNegative, Size(1e6, "kg", "no tool is so heavy")] = Field(
        0.0,
        description="mass of what the sensor carries, kg: its reading has the force that moves it, as a mass at the "
        "tip; a part of the mass of [tool] or the last link, whose weight is taken off",
    )
    axes: Literal[1, 3] = Field(1, description="1: it reads the force along the normal; 3: along the two tangents too")
    noise: Annotated[NotNegative, FORCE] = Field(0.0, description="standard deviation of white noise, N")
    bias: Annotated[Number, FORCE] = Field(0.0, description="constant error along the normal, N")
    drift: Annotated[Number, DRIFT] = Field(0.0, description="growth of the error along the normal, N/s")
    cross_talk: tuple[_Row, _Row, _Row] = Field(
        ((0.0, 0.0, 0.0),) * 3,
        description="share of the force along n, t1 and t2 that is added to the reading of n, of t1 and of t2: three "
        "rows of three",
    )
    saturation: Annotated[NotNegative, FORCE] = Field(
        0.0, description="largest magnitude of a reading along an axis, N; 0: no limit"
    )
    quantisation: Annotated[NotNegative, QUANTUM] = Field(0.0, description="step between two readings, N; 0: none")
    filter_time_constant: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="time constant of a first-order low-pass, s; 0: none"
    )
    delay: Annotated[NotNegative, PERIOD] = Field(0.0, description="delay of a reading, s; a whole number of samples")
    jitter: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="by how much a sample is late at most, s, evenly distributed from 0; at most one sample"
    )
    seed: Seed = Field(0, description="seed of noise and jitter")


SensorParameters = parameter_block(SensorSection)


class PackedSensor(NamedTuple):
    """A sensor as the kernels read it."""

    par: Block  # its parameters by name
    axes: int
    states: int  # one for each axis with a low-pass, else 0
    ring: int  # length of the ring buffer that `sense` needs: 1 and the delay in samples
    sampled: bool  # whether noise, quantisation, delay or jitter make a reading differ from the continuous signal


def pack_sensor(section: SensorSection, period: float) -> PackedSensor:
    """Turn the section into numbers for a sensor that is sampled every `period`, s.

    Raises ScenarioError if the delay is no whole number of samples, or the low-pass is faster than the sampling.
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
    if section.jitter > period:
        raise ScenarioError(
            f"sensor.jitter = {section.jitter:g} s: must be at most the {period:g} s between two samples"
        )
    par = SensorParameters(pack(section, 0, "sensor"), 0)
    sampled = delay > 0 or section.noise > 0.0 or section.quantisation > 0.0 or section.jitter > 0.0
    return PackedSensor(par, section.axes, section.axes * int(constant > 0.0), delay + 1, sampled)


def draws(section: SensorSection, count: int) -> Array:
    """Return the numbers drawn from the sensor's seed, (count, 4), one row a sample.

    They are standard normal ones for the noise of each axis, and one from 0 to 1 for the jitter. A part that is not
    asked for is zero, and changes none of the others.
    """
    found, generator = np.zeros((count, 4)), np.random.default_rng(section.seed)
    if section.noise > 0.0:
        found[:, 0] = generator.standard_normal(count)
    if section.noise > 0.0 and section.axes > 1:
        found[:, 1:3] = generator.standard_normal((count, 2))
    if section.jitter > 0.0:
        found[:, 3] = np.random.default_rng([section.seed, 1]).random(count)
    return found


@kernel
def across(F: Array, axis: int, par: Any) -> float:
    """Return what an axis of the sensor feels of a force F (3,), N."""
    X = par.cross_talk
    return float(F[axis] + (X[axis, 0] * F[0] + X[axis, 1] * F[1] + X[axis, 2] * F[2]))


@kernel
def sensor_rates(f_true: float, par: Any, z: Array, dz: Array) -> None:
    """Write the rate of the low-pass z (1,) of one axis, or nothing if there is none: ż = (f − z)/T."""
    if par.filter_time_constant > 0.0:
        dz[0] = (f_true - z[0]) / par.filter_time_constant


@kernel
def signal_of(f_true: float, par: Any, z: Array) -> float:
    """Return what is sampled of one axis, N: behind the low-pass z (1,), if there is one."""
    return float(z[0] if par.filter_time_constant > 0.0 else f_true)


@kernel
def bias_at(t: float, axis: int, par: Any) -> float:
    """Return the error of an axis at t, s, N."""
    return float(par.bias + par.drift * t) if axis == 0 else 0.0


@kernel
def cut(reading: float, most: float) -> float:
    """Return the reading within the sensor's range, N; 0: it has no end."""
    return min(max(reading, -most), most) if most > 0.0 else reading


@kernel
def continuous_reading(signal: float, bias: float, par: Any) -> float:
    """Return the reading of an axis at this instant, N, without sampling; see `signal_of` and `bias_at`."""
    return float(cut(signal + bias, par.saturation))


@kernel
def quantised(reading: float, quantum: float) -> float:
    """Return the reading in whole quanta, N; unchanged if the quantum is 0 or below the resolution of a double."""
    if quantum > 0.0 and abs(reading) < MOST_QUANTA * quantum:
        return float(quantum * math.floor(reading / quantum + 0.5))
    return reading


@kernel
def sense(signal: float, bias: float, sample: int, par: Any, normal: float, ring: Array) -> float:
    """Take a sample of one axis and return the controller's present reading, N.

    `signal`, `bias`: see `signal_of` and `bias_at`, N.
    `sample`: how many samples were taken before this one.
    `par`: see `PackedSensor`.
    `normal`: a standard normal number, for the noise.
    `ring` (delay + 1,): the latest samples; written.
    """
    reading = quantised(cut(signal + bias + par.noise * normal, par.saturation), par.quantisation)
    size = ring.shape[0]
    ring[sample % size] = reading
    return float(ring[(sample + 1) % size])


def start_sensor(f_true: float, sensor: PackedSensor, z: Array, signal: Array, ring: Array) -> None:
    """Write the states, signals (3,) and rings (3, delay + 1) of a sensor in steady state, without noise.

    The force is f_true, N, along the normal.
    """
    for axis, (felt, reading) in enumerate(_steady(sensor, f_true + 0.0)):
        signal[axis] = felt
        z[axis : axis + 1] = felt
        ring[axis] = reading


@lru_cache(maxsize=64)
def _steady(sensor: PackedSensor, f_true: float) -> tuple[tuple[float, float], ...]:
    """Return the signal and the reading of each axis in steady state, N."""
    par: Any = sensor.par
    F, found = np.array([f_true, 0.0, 0.0]), []
    for axis in range(sensor.axes):
        felt, bias = plain(across)(F, axis, par), plain(bias_at)(0.0, axis, par)
        reading = plain(quantised)(plain(continuous_reading)(felt, bias, par), par.quantisation)
        found.append((float(felt), float(reading)))
    return tuple(found)


# Whether there are encoders, and where the velocity comes from.
NO_ENCODER, MEASURED_VELOCITY, DIFFERENCE = range(3)
POSITION_NOISE = Size(1e3, "rad (m)", "no encoder is so bad", 1e-15, "a double has no finer steps")
VELOCITY_NOISE = Size(1e4, "rad/s (m/s)", "no tachometer is so bad", 1e-15)
EachJoint = Annotated[Gain, AfterValidator(gains_not_negative)]


class EncoderSection(Section):
    """[encoder]: what the controller measures of the joints; by default their true positions and velocities."""

    noise: Annotated[EachJoint, POSITION_NOISE] = Field(
        0.0, description="standard deviation of white noise in a position, rad (m), one number or one per joint"
    )
    quantisation: Annotated[EachJoint, POSITION_NOISE] = Field(
        0.0, description="step between two positions, rad (m), one number or one per joint; 0: none"
    )
    velocity: Literal["measured", "difference"] = Field(
        "measured", description="where velocities come from: a tachometer, or differences of the positions of two steps"
    )
    velocity_noise: Annotated[EachJoint, VELOCITY_NOISE] = Field(
        0.0, description="standard deviation of white noise in a measured velocity, rad/s (m/s), one or one per joint"
    )
    filter_time_constant: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="time constant of a first-order low-pass behind a difference, s; 0: none"
    )
    seed: Seed = Field(0, description="seed of the noise")


_EXACT = EncoderSection()
EncoderParameters = parameter_block(EncoderSection)


def encoder_kind(section: EncoderSection) -> int:
    """Return NO_ENCODER, MEASURED_VELOCITY or DIFFERENCE."""
    if section is _EXACT or section == _EXACT:
        return NO_ENCODER
    return DIFFERENCE if section.velocity == "difference" else MEASURED_VELOCITY


def encoder_draws(section: EncoderSection, count: int, n: int) -> Array:
    """Return standard normal numbers (count, 2 n) from the seed, for each reading those of positions and velocities."""
    return np.random.default_rng(section.seed).standard_normal((count, 2 * n))


def check_steps(section: EncoderSection, low: Array, high: Array, names: Sequence[str]) -> None:
    """Refuse an encoder whose step is a joint's whole range, from `low` to `high` (n,), rad (m): it reads one number.

    A joint without limits has no such range.
    """
    for name, step, travel in zip(names, np.broadcast_to(section.quantisation, low.shape), high - low, strict=True):
        if step >= travel:
            raise ScenarioError(
                f"encoder.quantisation = {step:g}: joint {name} moves {travel:g} rad (m) in all, so that its encoder "
                "would always read the same; take a smaller step"
            )


@kernel
def read_encoder(
    kind: int, state: tuple[float, float], j: int, par: Any, normal: Array, h: float, before: tuple[Array, Array]
) -> tuple[float, float]:
    """Return the position and velocity that the encoder of joint j reads, rad and rad/s (m, m/s).

    `kind`: see `encoder_kind`.
    `state`: true position and velocity.
    `j`: the joint.
    `par`: parameters by name.
    `normal` (2 n,): standard normal numbers, see `encoder_draws`.
    `h`: time since the reading before, s; 0: there is none.
    `before`, two (n,) arrays: positions and velocities read then.
    """
    (q, v), (last, speed) = state, before
    position: float = quantised(q + par.noise[j] * normal[j], par.quantisation[j])
    if kind != DIFFERENCE:
        return position, v + par.velocity_noise[j] * normal[last.shape[0] + j]
    if h == 0.0:
        return position, v
    share = h / (par.filter_time_constant + h)
    return position, speed[j] + share * ((position - last[j]) / h - speed[j])
