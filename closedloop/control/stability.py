"""Stability of sampled force feedback on a rigid surface.

With an exact model f = f_c + d holds at every instant, so the sampled force loop is linear and does not depend
on the arm:

    f_k = f_des + K_f (f_des − m_{k−1}) + K_I z_k + d        m: reading, through low-pass and delay
    z_{k+1} = z_k + h (f_des − s_k)                          s: reading without the sampling, or m

It converges if every eigenvalue of that recursion lies within the unit circle. The disturbance observer reads the
sensor too: along n its estimate follows f_c + d − f as the sensor gives it, so K_o is bounded as K_I is.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.compensation.observer import ObserverCompensation
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.sensor import SensorSection, pack_sensor

# The contour is this much outside the unit circle, for the rounding of a root on it.
ON_CIRCLE = 1e-12
# Points on each turn of the phase of the delay along half the circle, before any halving.
POINTS_A_TURN = 8
MOST_HALVINGS = 50
# Bisections between a stable gain and four times it, for the limit in a message: three decimal digits.
DIGITS = 12


def force_loop_settles(feedback: float, integral: float, sensor: SensorSection, period: float) -> bool:
    """Whether the sampled force loop converges: no root of its characteristic equation lies outside the unit circle.

    With the delay as w⁻ᵐ, the low-pass as G(w) = (h/T)/(w − 1 + h/T), or 1, and a reading that is m samples old

        F(w) = (w − 1)(1 + K_f w⁻ᵐ G) + h K_I (w⁻ᵐ or 1) G = 0        (without w − 1 where K_I = 0)

    Nyquist's criterion: F has no pole outside the circle but that at infinity, so the winding number of F along it is
    the number of roots outside. That costs as many evaluations as the delay has samples, where the eigenvalues of the
    recursion cost their cube. The contour is refined where F comes near zero, so the result is that of the eigenvalues
    but for gains within rounding of the limit, which count as stable.

    `feedback`, `integral`: K_f, and K_I, 1/s.
    `period`: time between two samples, s.
    """
    packed = pack_sensor(sensor, period)
    age = packed.ring  # m
    share = period / sensor.filter_time_constant if sensor.filter_time_constant > 0.0 else 0.0

    def characteristic(angle: Array) -> NDArray[np.complex128]:
        w = (1.0 + ON_CIRCLE) * np.exp(1j * angle)
        late = (1.0 + ON_CIRCLE) ** -age * np.exp(-1j * age * angle)
        felt = share / (w - 1.0 + share) if share > 0.0 else np.ones_like(w)
        F: NDArray[np.complex128] = 1.0 + feedback * late * felt
        if integral > 0.0:
            F = (w - 1.0) * F + period * integral * felt * (late if packed.sampled else 1.0)
        return F

    angles = np.linspace(0.0, math.pi, POINTS_A_TURN * (age + 8))
    values = characteristic(angles)
    for _ in range(MOST_HALVINGS):
        sizes = np.abs(values)
        wide = np.flatnonzero(np.abs(np.diff(values)) > 0.5 * np.minimum(sizes[1:], sizes[:-1]))
        if not wide.size:
            break
        between = 0.5 * (angles[wide] + angles[wide + 1])
        angles, values = np.insert(angles, wide + 1, between), np.insert(values, wide + 1, characteristic(between))
    turns = round(float(np.sum(np.angle(values[1:] * values[:-1].conj()))) / math.pi)  # round the whole circle
    return turns == (1 if integral > 0.0 else 0)


def check_sampling(law: ControlLaw, compensation: Compensation | None, sensor: SensorSection, period: float) -> None:
    """Refuse gains with which the sampled loop diverges.

    `period`: time between two evaluations of the law, s.
    """
    if law.force_integral > 0.0 and not force_loop_settles(0.0, law.force_integral, sensor, period):
        most = _most(lambda k: force_loop_settles(0.0, k, sensor, period), law.force_integral)
        raise ScenarioError(
            f"law.force_integral = {law.force_integral:g}: diverges with this sensor and {period:g} s between two "
            f"samples; must be below {most:.3g}"
        )
    if law.force_feedback > 0.0 and not force_loop_settles(law.force_feedback, law.force_integral, sensor, period):
        most = _most(lambda k: force_loop_settles(k, law.force_integral, sensor, period), law.force_feedback)
        raise ScenarioError(
            f"law.force_feedback = {law.force_feedback:g}: diverges, because a reading is {period + sensor.delay:g} s "
            f"old; must be below {most:.3g} (a longer sensor.filter_time_constant allows more)"
        )
    if isinstance(compensation, ObserverCompensation):
        rate = compensation.rate
        slow = not force_loop_settles(0.0, rate, sensor, period)
        if slow or not rate * period < 1.0:
            most = _most(lambda k: force_loop_settles(0.0, k, sensor, period), rate) if slow else rate
            raise ScenarioError(
                f"compensation.rate = {rate:g}: diverges with this sensor and {period:g} s between two samples; must "
                f"be below {min(most, 1.0 / period):.4g}"
            )


def _most(settles: Callable[[float], bool], above: float) -> float:
    """Return the largest gain with which the loop settles, rounded down a little; it does not with `above`."""
    low, high = 0.25 * above, above
    while not settles(low):  # it does with a gain of 0
        low, high = 0.25 * low, low
    for _ in range(DIGITS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if settles(middle) else (low, middle)
    return 0.999 * low
