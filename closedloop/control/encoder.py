"""The encoders: what the controller knows of the joints' positions and velocities.

    q_m = quantised(q + noise)
    v_m = v + noise                                       velocity = "measured"
    v_m = v_m⁻ + h/(T + h) ((q_m − q_m⁻)/h − v_m⁻)        velocity = "difference": a difference quotient and a low-pass

A reading is taken once a step, at the row, where white noise has a meaning: within a step of Runge and Kutta it has
none. So with encoders the law is sampled, each step unless `law.sample_period` is longer, and its torque is held in
between. A controller computes everything from its readings, so H, C, the tip's position, Jacobian and the contact frame
that it sees are those of q_m and v_m.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import PERIOD, Gain, NotNegative, Section, Size, gains_not_negative
from closedloop.control.sensor import Seed, quantised
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import parameter_block

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

    Parameters
    ----------
    kind : int
        See `encoder_kind`.
    state : two floats
        True position and velocity.
    j : int
        The joint.
    par : EncoderParameters
        Parameters by name.
    normal : (2 n,) array
        Standard normal numbers, see `encoder_draws`.
    h : float
        Time since the reading before, s; 0: there is none.
    before : two (n,) arrays
        Positions and velocities read then.
    """
    (q, v), (last, speed) = state, before
    position: float = quantised(q + par.noise[j] * normal[j], par.quantisation[j])
    if kind != DIFFERENCE:
        return position, v + par.velocity_noise[j] * normal[last.shape[0] + j]
    if h == 0.0:
        return position, v
    share = h / (par.filter_time_constant + h)
    return position, speed[j] + share * ((position - last[j]) / h - speed[j])
