"""How much force feedback a sampled sensor allows on a rigid surface.

With an exact model f = f_c + d holds at every instant, so the sampled force loop is linear and does not depend
on the arm:

    f_k = f_des + K_f (f_des − m_{k−1}) + K_I z_k + d        m: reading, through low-pass and delay
    z_{k+1} = z_k + h (f_des − s_k)                          s: reading without the sampling, or m

It converges if every eigenvalue of that recursion lies within the unit circle. The disturbance observer reads the
sensor too: along n its estimate follows f_c + d − f as the sensor gives it, so K_o is bounded as K_I is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from closedloop.control.sections import CompensationSection, ForceLaw, ObserverCompensationSection, SensorSection
from closedloop.control.sensor import pack_sensor
from closedloop.errors import ScenarioError


def force_loop_radius(feedback: float, integral: float, sensor: SensorSection, period: float) -> float:
    """Return the largest modulus of an eigenvalue of the sampled force loop: it converges below 1.

    Parameters
    ----------
    feedback, integral : float
        K_f, and K_I, 1/s.
    sensor : SensorSection
    period : float
        Time between two samples, s.

    Raises
    ------
    ScenarioError
        If the sensor does not fit the period.
    """
    packed = pack_sensor(sensor, period)
    # State: low-passed force y, integral z, and the readings r_1 (the latest) .. r_D+1 (the one that reaches the law).
    size = 2 + packed.ring
    y, z, latest, oldest = 0, 1, 2, size - 1
    force = np.zeros(size)  # f as a row on the state, without its constants
    force[oldest] -= feedback
    force[z] += integral
    unit = np.eye(size)
    time_constant = sensor.filter_time_constant
    now = unit[y] if time_constant > 0.0 else force  # what the sensor feels now
    step = np.zeros((size, size))
    share = period / time_constant if time_constant > 0.0 else 1.0  # Euler's, a little above the true one
    step[y] = (1.0 - share) * unit[y] + share * force
    step[z] = unit[z] - period * (unit[oldest] if packed.sampled else now)
    step[latest] = now
    for place in range(latest + 1, size):
        step[place] = unit[place - 1]
    if integral == 0.0:  # z is then not part of the loop
        step = np.delete(np.delete(step, z, axis=0), z, axis=1)
    return float(np.max(np.abs(np.linalg.eigvals(step))))


def check_sampling(
    law: ForceLaw, compensation: CompensationSection | None, sensor: SensorSection, period: float
) -> None:
    """Refuse gains with which the sampled loop diverges.

    Parameters
    ----------
    law, compensation, sensor : sections
    period : float
        Time between two evaluations of the law, s.

    Raises
    ------
    ScenarioError
        With the gain that is too large, and the most that would do.
    """
    if law.force_integral > 0.0 and force_loop_radius(0.0, law.force_integral, sensor, period) > 1.0:
        most = _most(lambda k: force_loop_radius(0.0, k, sensor, period), law.force_integral)
        raise ScenarioError(
            f"law.force_integral = {law.force_integral:g}: diverges with this sensor and {period:g} s between two "
            f"samples; must be below {most:.3g}"
        )
    if law.force_feedback > 0.0 and force_loop_radius(law.force_feedback, law.force_integral, sensor, period) > 1.0:
        most = _most(lambda k: force_loop_radius(k, law.force_integral, sensor, period), law.force_feedback)
        raise ScenarioError(
            f"law.force_feedback = {law.force_feedback:g}: diverges, because a reading is {period + sensor.delay:g} s "
            f"old; must be below {most:.3g} (a longer sensor.filter_time_constant allows more)"
        )
    if isinstance(compensation, ObserverCompensationSection):
        rate = compensation.rate
        slow = force_loop_radius(0.0, rate, sensor, period) > 1.0
        if slow or not rate * period < 1.0:
            most = _most(lambda k: force_loop_radius(0.0, k, sensor, period), rate) if slow else rate
            raise ScenarioError(
                f"compensation.rate = {rate:g}: diverges with this sensor and {period:g} s between two samples; must "
                f"be below {min(most, 1.0 / period):.4g}"
            )


def _most(radius: Callable[[float], float], above: float) -> float:
    """Return the largest gain below `above` with radius(gain) <= 1, rounded down a little, by bisection."""
    low, high = 0.0, above
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if radius(middle) <= 1.0 else (low, middle)
    return 0.999 * low
