"""The force sensor: its bias and the payload behind it where the tip is free, gain and delay beside the torques.

Free of contact a sensor whose axes are those of the tip's frame, R in the base's, reads in the base's axes

    F = R b + m (g − a),

its bias b and a payload m that moves with the tip, a. Only where the tip turns are both told apart. A log of the normal
force alone has one bias along it. Gain and delay are of the recorded normal force beside the force that follows
from q, v and torques (`closedloop.studies.comparison.audit.expected_force`), f(t) = bias + gain f_expected(t − delay),
fitted with the expected force on the left: it has accelerations in it, and so more noise than the recorded one. Where
torques jump, or a drive holds them for a sample, they are half a row from the accelerations beside them: the delay is
not known better than that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.studies.comparison.audit import EDGE, expected_force
from closedloop.studies.comparison.recording import Recording
from closedloop.studies.identify.contact.found import FEWEST, Part, known, one, unknown
from closedloop.studies.identify.contact.touch import Touch, Windows
from closedloop.studies.identify.fit import fit

# A force that varies by less than so many times what is left tells neither gain nor delay.
VARIES = 2.0
# Steps of Gauss and Newton to the delay.
STEPS = 5
TOUCH = "the tip never touches for long: press it on the surface"
FREE = "the tip is never free for long: lift it off the surface for a while"
TURN = "the tip does not turn while it is free: turn it, or the payload looks like a bias"


@dataclass
class Sensor:
    """What is known of the sensor."""

    part: Part
    value: Array  # (m,): bias (3,), or (1,) of the normal force, the payload, kg, and the delay, s; 0 where not known
    covariance: Array  # (m, m): of them; 0 of what is not known
    columns: Array  # (R, c, m - 1): what bias and payload add to the force of each window, c components
    delay_known: bool = False

    def read_late(self, delay: float, deviation: float) -> None:
        """Take a delay as known, s, with its standard deviation."""
        self.value[-1], self.covariance[-1, -1], self.delay_known = delay, deviation**2, True

    def contact_force(self, windows: Windows, value: Array) -> Array:
        """Return the force of the contact in each window, (R, c), N, if these are bias, payload and delay."""
        return windows.forces(float(value[-1])) - np.einsum("tcm,m->tc", self.columns, value[:-1])


def of_free_rows(windows: Windows, gravity: Array, z: float) -> Sensor:
    """Return bias and payload, from the windows in which the tip touches nothing."""
    touch, x = windows.touch, windows.x
    R, wide = len(x.time), x.torque.shape[1] == 3
    names = ["bias_x", "bias_y", "bias_z"] if wide else ["bias"]
    if wide:
        at = np.clip(np.searchsorted(touch.time, x.time), 0, len(touch.time) - 1)
        columns = np.concatenate([touch.axes[at], (gravity - windows.mean(x.a))[:, :, None]], axis=2)
    else:
        columns = np.ones((R, 1, 1))
    used = windows.within(touch.free)
    part = Part("force while free, N")
    if used.sum() < FEWEST:
        part.estimates = [unknown(name, "N", FREE) for name in names]
        part.estimates += [unknown("payload", "kg", FREE)] if wide else []
        m = columns.shape[2]
        return Sensor(part, np.zeros(m + 1), np.zeros((m + 1, m + 1)), columns)
    counts = np.repeat(used[:, None], columns.shape[1], axis=1)
    turned = not wide or float(columns[used][:, :, :3].std(axis=0).max()) > 0.02
    found = fit(columns, x.torque, counts, told=None if turned else np.array([True, True, True, False]))
    for k, name in enumerate([*names, "payload"][: columns.shape[2]]):
        unit = "kg" if name == "payload" else "N"
        if found.told[k]:
            part.estimates.append(known(name, float(found.value[k]), float(found.deviation[k]), unit, z))
        else:
            part.estimates.append(unknown(name, unit, TURN))
    level = windows.x.torque[used] - np.einsum("tcm,m->tc", columns[used], found.value)
    part.time, part.measured, part.predicted = x.time[used], level[:, -1], np.zeros(int(used.sum()))
    return Sensor(part, np.append(found.value, 0.0), np.pad(found.covariance, (0, 1)), columns)


def beside_torques(recording: Recording, robot: Robot, touch: Touch, cutoff: float | None, z: float) -> Part:
    """Return gain, delay and offset of the recorded normal force beside what motion and torques say."""
    part = Part("normal force beside that of the torques, N")
    if recording.torque is None:
        return part
    at, expected, recorded, _, cutoff = expected_force(recording, robot, cutoff)
    whole = recorded @ touch.normal if recorded.ndim == 2 else recorded
    f, wanted, time = whole[at], expected @ touch.normal, recording.time[at]
    # An impact is in the motion and not in the force: rows near a change from free to closed do not count.
    others = np.concatenate([[0], np.cumsum(~touch.closed)])
    ends = (np.searchsorted(touch.time, time + side / cutoff) for side in (-EDGE, EDGE))
    first, last = (np.clip(end, 0, len(touch.time)) for end in ends)
    used = others[last] == others[first]
    if used.sum() < FEWEST:
        part.estimates = [unknown("gain", "1", TOUCH), unknown("sensor_delay", "s", TOUCH)]
        return part
    rate, late, ones = np.gradient(whole, recording.time), 0.0, np.ones(len(at))
    for _ in range(STEPS):
        moved, slope = (np.interp(time + late, recording.time, x) for x in (whole, rate))
        found = one(np.column_stack([moved, slope, ones]), wanted, used)
        if not found.told[:2].all() or abs(found.value[1]) < 1e-9 * abs(found.value[0]):
            break
        late = float(np.clip(late + found.value[1] / found.value[0], -1.0 / cutoff, 1.0 / cutoff))
    level = float(np.median(wanted[used]))
    if not found.told[0] or f[used].std() < VARIES * float(found.sigma[0]):
        why = f"the force varies too little about {level:.3g} N to tell a gain from a bias: press harder and softer"
        part.estimates = [unknown("gain", "1", why), unknown("sensor_delay", "s", why)]
    else:
        share, deviation = float(found.value[0]), float(found.deviation[0])
        part.estimates = [known("gain", 1.0 / share, deviation / share**2, "1", z)]
        if found.told[1]:
            unsure = float(np.hypot(found.deviation[1] / share, 0.5 * recording.step))
            part.estimates.append(known("sensor_delay", late, unsure, "s", z))
        else:
            part.estimates.append(unknown("sensor_delay", "s", "the force hardly changes: change it faster"))
    part.time, part.measured, part.predicted = time[used], wanted[used], (wanted - found.residual[:, 0])[used]
    return part
