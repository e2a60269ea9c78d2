"""What a log says of a contact, part by part, with intervals: the force sensor, a surface that gives, friction.

The force sensor: its bias and the payload behind it where the tip is free, gain and delay beside the torques. Free of
contact a sensor whose axes are those of the tip's frame, R in the base's, reads in the base's axes

    F = R b + m (g − a),

its bias b and a payload m that moves with the tip, a. Only where the tip turns are both told apart. A log of the normal
force alone has one bias along it. Gain and delay are of the recorded normal force beside the force that follows
from q, v and torques (`closedloop.studies.comparison.recording.expected_force`),
f(t) = bias + gain f_expected(t − delay), fitted with the expected force on the left: it has accelerations in it, and so
more noise than the recorded one. Where torques jump, or a drive holds them for a sample, they are half a row from the
accelerations beside them: the delay is not known better than that.

Of the surface stiffness, damping, where it is without a force, and how late the force is read.

    f(t + τ) = k (d − n·r(t)) − c n·ṙ(t)

Small delays enter as τ k n·ṙ + τ c n·r̈: beside damping a delay is told by the acceleration alone. It is found by
steps of Gauss and Newton, each a linear fit with the positions of every other row as instruments for those between.
Positions that encoders count are those between their counts (`closedloop.studies.identify.motion.between_counts`);
what these leave is no noise, and is in the intervals by `closedloop.studies.identify.contact.identify_contact`.

Friction of a tip that slides on a plane: Coulomb's and a viscous part.

    −F_t·u = μ f + b |ṙ_t|,   u = ṙ_t/|ṙ_t|

Where u turns within a window the means of F_t and u are shorter alike. Noise of the positions, or counts of encoders,
turn u by δ, and F_t·u is smaller by the cosine of that. The mean square of F_t sin δ, across, beyond the noise of the
force tells by how much. Both forces are read by one sensor with noise, so that least
squares would make μ too small by the share of the noise in f²; f of the windows before and behind, whose noise is
another, is the instrument. Windows in which the tip may stick, or turns round, do not count. F_t across u has to
vanish in the mean: it does not if the normal is another, or friction is not the same in all directions.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from closedloop.base.arrays import Array, Mask
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.studies.comparison.recording import EDGE, Recording, expected_force
from closedloop.studies.identify import motion
from closedloop.studies.identify.identify import WHITENESS_LEVEL, Estimate, known, unknown
from closedloop.studies.identify.motion import Log, LogError, Motion, white_noise
from closedloop.studies.identify.regressor import NOISY, Fit, fit, whiteness
from robot_models.model import carried_by

# A force above this share of its range is surely of a contact; it counts as one above the other, or this many noises.
SURELY, LEAST, NOISES = 0.5, 0.02, 5.0
# So many times deeper than such forces sink in, and the tip is free.
DEEPER = 1.5
# Windows on either side of a change that do not count: the filter smears what happens in one into those beside it.
MARGIN = 2
# Rows of a speed that the next one continues.
CONTINUED = 5
# Windows that a cutoff should leave.
WINDOWS = 200


@dataclass(frozen=True, eq=False)
class Touch:
    """A log of a tip and a plane, N rows."""

    time: Array  # (N,): s
    position: Array  # (N, 3): of the tip, m, base axes
    # (N, 3) or (N, 1), optional: as recorded, N, on the robot: along the base's axes, or along the normal
    force: Array | None
    # the same of positions between the counts of encoders: of all rows, and of every other row, see `half_of`
    between: tuple[Array, Array, Array]
    axes: Array  # (N, 3, 3): columns: the axes of the tip's frame, in those of the base
    normal: Array  # (3,): of the plane, out of it
    # free, closed: (N,) bool: rows in which the tip touches nothing for sure, and touches for sure. Neither without a
    # force.
    free: Mask
    closed: Mask
    source: str

    @property
    def step(self) -> float:
        """Time between two rows, s."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def height(self) -> Array:
        """n·r, m, (N,)."""
        return np.asarray(self.position @ self.normal)

    @property
    def along(self) -> Array:
        """Force along the normal, as recorded, N, (N,)."""
        assert self.force is not None
        return np.asarray(self.force @ self.normal if self.force.shape[1] == 3 else self.force[:, 0])


def touch_of(recording: Recording, robot: Robot, normal: Array) -> Touch:
    """Return where the tip of a recording is, and when it touches a plane."""
    time, q, force = recording.time, recording.positions, recording.force
    ways = [q, motion.between_counts(q), motion.half_of(q, 0), motion.half_of(q, 1)]
    time, *ways = map(_averaged, (time, *ways))
    force = None if force is None else _averaged(force)
    arm = carried_by(robot.model.tools, robot.tip)[1]
    poses = [robot.frame_poses(robot.tip, way) for way in ways]
    position, whole, even, odd = (wrist + turned @ arm for turned, wrist in poses)
    none = np.zeros(len(time), dtype=bool)
    forces = None if force is None else force.reshape(len(time), -1)
    between = (whole, even, odd)
    touch = Touch(time, position, forces, between, poses[0][0], normal, none, none, recording.source)
    return touch if forces is None else _told(touch)


def touch_of_speed(recording: Recording, normal: Array) -> Touch:
    """Return the same of a recording of force and speed alone, of a tip that moves along the normal.

    Its height above where it is in the first row is the integral of its speed. Of a size the sign is that which
    continues the rows before, and of both signs of the whole the one with which a deeper tip has a larger force.
    """
    time, force, speed = recording.time, recording.force, recording.speed
    if force is None or speed is None:
        raise LogError(f"{recording.source}: has no joint positions q: without them it needs both force and speed")
    force = force @ normal if force.ndim == 2 else force
    rate = np.array(speed)
    if rate.min() >= 0.0:
        steady = np.arange(CONTINUED) - 0.5 * (CONTINUED - 1)
        slope = steady / float(steady @ steady)
        for k in range(CONTINUED, len(rate)):
            before = rate[k - CONTINUED : k]
            next_one = float(before.mean() + slope @ before * 0.5 * (CONTINUED + 1))
            rate[k] = np.copysign(rate[k], next_one)
    height = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])
    if np.cov(height, force)[0, 1] > 0.0:
        height = -height
    time, height, force = map(_averaged, (time, height, force))
    axes, none = np.broadcast_to(np.eye(3), (len(time), 3, 3)), np.zeros(len(time), dtype=bool)
    place = np.outer(height, normal)
    between = place, motion.half_of(place, 0), motion.half_of(place, 1)
    return _told(Touch(time, place, force[:, None], between, axes, normal, none, none, recording.source))


def _averaged(x: Array) -> Array:
    """Return means of so many rows (N, ...) at a time that no more are left than are evaluated."""
    stride = -(-len(x) // motion.EVALUATIONS)
    count = len(x) // stride
    return x[: count * stride].reshape(count, stride, *x.shape[1:]).mean(axis=1)


def _told(touch: Touch) -> Touch:
    """Return it with the rows that are free and closed.

    What lifts the tip above where large forces are, by more than such forces sink in, is free, whatever the sensor's
    bias is; what has a force beyond that of free rows is closed.
    """
    f, height = touch.along, touch.height
    noise = float(motion.white_noise(f[:, None])[0])
    low, high = np.percentile(f, [0.5, 99.5])
    if high - low <= 2.0 * NOISES * noise:  # one level throughout
        return replace(touch, closed=np.full(len(f), bool(abs(f.mean()) > NOISES * noise)))
    sure = height[f > low + SURELY * (high - low)]
    bottom, top = np.percentile(sure, [1.0, 99.0])
    above = top + DEEPER * (top - bottom) + NOISES * float(motion.white_noise(height[:, None])[0]) + 1e-9
    free = height > above
    level = float(np.median(f[free])) if free.any() else 0.0
    closed = ~free & (f - level > max(LEAST * (high - level), NOISES * noise))
    return replace(touch, free=free, closed=closed)


@dataclass(frozen=True, eq=False)
class Windows:
    """The motion of a tip and its force, averaged over windows."""

    # x, even, odd: of all rows of the positions, and of every other row, whose noise is independent
    x: motion.Motion
    even: motion.Motion
    odd: motion.Motion
    touch: Touch
    cutoff: float  # Hz

    @classmethod
    def of(cls, touch: Touch, cutoff: float | None) -> "Windows":
        """Filter, differentiate and average a log with a force."""
        assert touch.force is not None
        log = Log(touch.time, touch.position, touch.force, source=touch.source)
        if cutoff is None:  # slow motions too need windows enough
            cutoff = max(motion.usual_cutoff(log), 0.5 * WINDOWS / (touch.time[-1] - touch.time[0]))
        x, even, odd = (motion.motion(replace(log, q=place), cutoff) for place in touch.between)
        x = replace(x, noise=motion.speed_noise(log, cutoff))
        return cls(x, even, odd, touch, cutoff)

    def mean(self, rows: Array) -> Array:
        """Return the mean over each window of what is known at each evaluation, (R D, ...) to (R, ...)."""
        return np.asarray(rows.reshape(len(self.x.time), self.x.size, *rows.shape[1:]).mean(axis=1))

    def forces(self, delay: float) -> Array:
        """Return the force of each window as it is recorded so much later, (R, 1 or 3)."""
        touch = self.touch
        assert touch.force is not None
        if delay == 0.0:
            return self.x.torque
        moved = np.stack([np.interp(touch.time + delay, touch.time, column) for column in touch.force.T], axis=1)
        return motion.motion(Log(touch.time, touch.position, moved), self.cutoff).torque

    def within(self, rows: Mask, margin: int = MARGIN) -> Mask:
        """Return the windows, (R,), all rows of which, and of so many beside them, are among `rows` (N,)."""
        width = self.x.time[1] - self.x.time[0] if len(self.x.time) > 1 else self.touch.step
        others = np.concatenate([[0], np.cumsum(~rows)])
        reach = (margin + 0.5) * width
        first = np.clip(np.searchsorted(self.touch.time, self.x.time - reach), 0, len(rows) - 1)
        last = np.clip(np.searchsorted(self.touch.time, self.x.time + reach), 1, len(rows))
        return np.asarray(others[last] == others[first])


# Windows that a fit needs.
FEWEST = 20
# A term that the model has not is missed if it is so many deviations from 0 and takes this share of the residual's RMS.
SURE, GAINED = 5.0, 0.01
# A residual that is not white counts if it is above the noise of the log by this factor, and this share of the signal.
ABOVE, MATTERS = 1.3, 2e-3


@dataclass
class Part:
    """Parameters of one law, of a log."""

    what: str  # of the axis of a figure
    estimates: list[Estimate] = field(default_factory=list)
    misses: list[str] = field(default_factory=list)  # effects that the law does not have, in words
    # time, measured, predicted (R,): of the windows that were used; empty if there are none
    time: Array = field(default_factory=lambda: np.zeros(0))
    measured: Array = field(default_factory=lambda: np.zeros(0))
    predicted: Array = field(default_factory=lambda: np.zeros(0))

    def untold(self, names: Iterable[tuple[str, str]], why: str) -> "Part":
        """Return it with parameters, names and units, that the log does not tell."""
        self.estimates = [unknown(name, unit, why) for name, unit in names]
        return self


def one(W: Array, y: Array, used: Mask, Z: Array | None = None) -> Fit:
    """Fit y (R,) by columns W (R, b), with instruments Z (R, b)."""
    return fit(W[:, None, :], y[:, None], used[:, None], None if Z is None else Z[:, None, :])


def missed(
    W: Array, y: Array, used: Mask, Z: Array | None, extra: Mapping[str, Array], found: Fit, noise: float
) -> list[str]:
    """Return the column of `extra` (R,) a law lacks, or that its residual, of such a `noise`, is not white."""
    names = []
    for name, column in extra.items():
        wider = np.column_stack([W, column])
        more = one(wider, y, used, None if Z is None else np.column_stack([Z, column]))
        beside = more.told.sum() > found.told.sum()  # and not in place of a term of the law
        sure = beside and more.told[-1] and abs(more.value[-1]) > SURE * more.deviation[-1]
        if sure and more.sigma[0] < (1.0 - GAINED) * found.sigma[0]:
            names.append((float(more.sigma[0]), name))
    if names:
        return [min(names)[1]]
    size = float(np.sqrt(np.mean(y[used] ** 2)))
    matters = found.sigma[0] > max(ABOVE * noise, MATTERS * size)
    if matters and whiteness(found.residual, used[:, None])[0] < WHITENESS_LEVEL:
        return ["something: the residual is not white"]
    return []


def spread(values: Callable[[Array], Array], at: Array, covariance: Array) -> Array:
    """Return the covariance that values of nuisance parameters `at` (m,) with a covariance (m, m) have because of it.

    The values are differentiated by central differences of one deviation.
    """
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    slopes = [
        (values(at + s * e) - values(at - s * e)) / (2.0 * s) if s > 0.0 else np.zeros_like(values(at))
        for s, e in zip(size, np.eye(len(at)), strict=True)
    ]
    J = np.stack(slopes, axis=1)
    return np.asarray(J @ covariance @ J.T)


# A force that varies by less than so many times what is left tells neither gain nor delay.
VARIES = 2.0
# Steps of Gauss and Newton to the delay.
STEPS = 5
# What gain and delay beside the torques, and friction, are called, with their units.
BESIDE, SLIDING = (("gain", "1"), ("sensor_delay", "s")), (("friction", "1"), ("viscous_friction", "N s/m"))
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
        part.untold([(name, "N") for name in names] + [("payload", "kg")] * wide, FREE)
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
        return part.untold(BESIDE, TOUCH)
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
        part.untold(BESIDE, why)
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


# The tip has to sink in by so many times the noise of its filtered height, and by this, m.
OVER_NOISE, LEAST_DEPTH = 3.0, 1e-8
# Steps of the search for the delay, and the longest that is looked for, in periods of the filter.
LATE_STEPS, LONGEST = 12, 2.0
NAMES = (("stiffness", "N/m"), ("damping", "N s/m"), ("delay", "s"), ("surface_offset", "m"))


def compliance_of(windows: Windows, sensor: Sensor, z: float) -> Part:
    """Return stiffness, damping, offset of the surface, and the delay of the force if the sensor's is not known."""
    part = Part("normal force, N")
    touch, n = windows.touch, windows.touch.normal
    used = windows.within(touch.closed)
    height = windows.mean(windows.x.q @ n)
    if used.sum() < FEWEST:
        return part.untold(NAMES, TOUCH)
    noise = float(white_noise(touch.height[:, None])[0]) * np.sqrt(2.0 * touch.step * windows.cutoff)
    sinks = float(height[used].std())
    if sinks < max(OVER_NOISE * noise, LEAST_DEPTH):
        why = (
            f"the tip moves by {sinks:.2g} m along the normal while it touches, which is no more than noise: the "
            "surface is too stiff for this log; press harder, or measure closer to the tip"
        )
        return part.untold(NAMES, why)
    middle = float(height[used].mean())

    def rows(x: Motion) -> Array:
        return np.stack([windows.mean(row @ n) for row in (x.q, x.v, x.a)], axis=1) - [middle, 0.0, 0.0]

    even, odd = rows(windows.even), rows(windows.odd)

    def force(value: Array) -> Array:
        wrench = sensor.contact_force(windows, value)
        return wrench @ n if wrench.shape[1] == 3 else wrench[:, 0]

    def read(late: float) -> Array:
        return np.append(sensor.value[:-1], late)

    def columns(s: Array, k: float, c: float) -> Array:
        """Return those of k, k (d − middle), c and, of a delay that is looked for, its change."""
        return np.column_stack(
            [-s[:, 0], np.ones(len(s)), -s[:, 1]] + ([] if sensor.delay_known else [k * s[:, 1] + c * s[:, 2]])
        )

    late, k, c = float(sensor.value[-1]), 1.0, 1.0
    if not sensor.delay_known:
        late, k, c = _begin(even, odd, force(read(0.0)), used)
    longest = LONGEST / windows.cutoff
    for _ in range(LATE_STEPS):
        y = force(read(late))
        W, Z = columns(even, k, c), columns(odd, k, c)
        found = one(W, y, used, Z)
        k, c = float(found.value[0]), float(found.value[2])
        if sensor.delay_known or not found.told.all():
            break
        step = float(np.clip(found.value[3], -0.5 * longest, 0.5 * longest))
        late = float(np.clip(late + step, -longest, longest))
        if abs(step) < 1e-3 * float(found.deviation[3]):
            break

    def solved(value: Array) -> Array:
        return one(W, force(value), used, Z).value

    covariance = found.covariance + spread(solved, read(late), sensor.covariance)
    part.estimates = _estimates(found, covariance, late, middle, sensor, z)
    deep = odd[:, 0].max() - odd[:, 0]  # from the highest point of the contact
    extra = {
        "a stiffness that grows or falls with depth": deep**2,
        "damping that grows with depth (Hunt and Crossley)": deep * odd[:, 1],
    }
    rate_noise = 2.0 * np.pi * windows.cutoff / np.sqrt(3.0) * noise
    of_log = float(np.sqrt(np.sum(windows.x.torque_noise**2) + 2.0 * ((k * noise) ** 2 + (c * rate_noise) ** 2)))
    part.misses = [f"surface: {what}" for what in missed(W, y, used, Z, extra, found, of_log)]
    part.time, part.measured, part.predicted = windows.x.time[used], y[used], (y - found.residual[:, 0])[used]
    return part


def _begin(even: Array, odd: Array, y: Array, used: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Return delay, stiffness and damping to begin with: from f = −k s − (c − k τ) ṡ − (k τ²/2 − c τ) s̈ + constant."""
    found = one(*(np.column_stack([-even, np.ones(len(even))]), y, used), np.column_stack([-odd, np.ones(len(odd))]))
    k, a, b = (float(x) for x in found.value[:3])
    if k <= 0.0:
        return 0.0, max(k, 1.0), 1.0
    c = float(np.sqrt(max(a * a - 2.0 * k * b, 0.0)))
    return (c - a) / k, k, c


def _estimates(found: Fit, covariance: Array, late: float, middle: float, sensor: Sensor, z: float) -> list[Estimate]:
    """Return stiffness, damping, delay and offset of the surface."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    k = float(found.value[0])
    told = [known("stiffness", k, float(deviation[0]), "N/m", z)]
    apart = sensor.delay_known or bool(found.told[2:].all())
    if apart:
        told.append(known("damping", float(found.value[2]), float(deviation[2]), "N s/m", z))
    else:
        why = "damping cannot be distinguished from a delay here: press faster and slower, or give the delay"
        told.append(unknown("damping", "N s/m", why))
    if apart and not sensor.delay_known:
        told.append(known("delay", late, float(deviation[3]), "s", z))
    elif not apart:
        told.append(unknown("delay", "s", "a delay cannot be distinguished from damping here: press faster and slower"))
    if sensor.part.estimates[0].why:
        why = "it looks like a bias of the sensor, which is known if the tip is free for a while"
        told.append(unknown("surface_offset", "m", why))
        return told
    # d = middle + (k (d − middle))/k
    slope = np.array([-found.value[1] / k**2, 1.0 / k])
    variance = float(slope @ covariance[:2, :2] @ slope)
    return [*told, known("surface_offset", middle + float(found.value[1]) / k, np.sqrt(variance), "m", z)]


# Below this share of its largest speed a tip may stick.
SLOW = 0.05
# The speed has to vary by this share beside the normal force, or both parts of the friction are one.
SPEED_VARIES = 0.05
# Windows on either side that the instrument is averaged over.
NEAR = 4
# A tip that slides less than this, m/s, rests.
REST = 1e-5
# A force across the slip above this share of the one along it is none of friction.
ACROSS = 0.05


def friction_of(windows: Windows, sensor: Sensor, z: float) -> Part:
    """Return μ and the viscous coefficient, N s/m."""
    part = Part("friction, N")
    touch, x, n = windows.touch, windows.x, windows.touch.normal
    assert touch.force is not None
    if x.torque.shape[1] != 3:
        why = "the log has the normal force only: give three components of the force"
        return part.untold(SLIDING, why)
    slip = x.v - np.outer(x.v @ n, n)
    speed = np.linalg.norm(slip, axis=1)
    noise = float(np.linalg.norm(x.noise - (x.noise @ np.abs(n)) * np.abs(n)))
    least = max(SLOW * float(speed.max()), NOISY * noise, REST)
    one_way = windows.mean((speed > least).astype(np.float64)) == 1.0
    along, mean_speed = windows.mean(slip / np.maximum(speed, 1e-300)[:, None]), windows.mean(speed)
    turning = np.maximum(np.linalg.norm(along, axis=1), 1e-300)  # shorter by as much as friction that turns with it
    along /= turning[:, None]
    across = np.cross(n, along)
    used = windows.within(touch.closed) & one_way & (turning > 0.99)
    used[1:-1] &= one_way[2:] & one_way[:-2]

    def forces(value: Array) -> tuple[Array, Array]:
        force = sensor.contact_force(windows, value)
        f = force @ n
        return f, force - np.outer(f, n)

    rows = (x.time[1] - x.time[0]) / touch.step  # of a window
    read = across**2 @ (white_noise(touch.force @ (np.eye(3) - np.outer(n, n))) ** 2 / rows)

    def size_of(tangential: Array) -> Array:
        """Return the size of friction, of which noise of the slip turns a part across it, to second order."""
        size, aside = -np.einsum("ij,ij->i", tangential, along), np.einsum("ij,ij->i", tangential, across)
        turned, whole = (
            uniform_filter1d(np.where(used, each, 0.0), 2 * NEAR + 1) for each in (aside**2 - read, size**2)
        )
        return np.asarray(size * (1.0 + 0.5 * np.clip(turned / np.maximum(whole, 1e-300), -1.0, 1.0)) / turning)

    f, tangential = forces(sensor.value)
    if used.sum() < FEWEST:
        closed = windows.within(touch.closed)
        ratio = np.linalg.norm(tangential[closed], axis=1) / np.maximum(f[closed], 1e-300)
        low = float(np.percentile(ratio, 99.0)) if len(ratio) else 0.0
        why = f"{TOUCH}, and slide it"
        if len(ratio):
            why = f"the tip hardly slides while it touches (μ is at least {low:.3g}): slide it, both ways"
        part.estimates = [unknown("friction", "1", why, low), unknown("viscous_friction", "N s/m", why)]
        return part
    ratio = (mean_speed / np.maximum(f, 1e-300))[used]
    varies = float(ratio.std() / ratio.mean()) > SPEED_VARIES

    def columns(f: Array) -> tuple[Array, Array]:
        near = (uniform_filter1d(f, 2 * NEAR + 1) * (2 * NEAR + 1) - f) / (2 * NEAR)
        W, Z = np.column_stack([f, mean_speed]), np.column_stack([near, mean_speed])
        return (W, Z) if varies else (W[:, :1], Z[:, :1])

    def solved(value: Array) -> Array:
        f, tangential = forces(value)
        W, Z = columns(f)
        return one(W, size_of(tangential), used, Z).value

    W, Z = columns(f)
    y = size_of(tangential)
    found = one(W, y, used, Z)
    covariance = found.covariance + spread(solved, sensor.value, sensor.covariance)
    deviation = np.sqrt(np.diag(covariance))
    mean = float(mean_speed[used].mean() / f[used].mean())
    grouping = "" if varies else f"friction + {mean:.4g} viscous_friction"
    part.estimates.append(known("friction", float(found.value[0]), float(deviation[0]), "1", z, grouping))
    if varies:
        part.estimates.append(known("viscous_friction", float(found.value[1]), float(deviation[1]), "N s/m", z))
    else:
        why = "the tip slides at one speed: slide it at several, under one force"
        part.estimates.append(unknown("viscous_friction", "N s/m", why))
    top = float(mean_speed[used].max())
    smooth = Z[:, 0]
    extra = {
        "more friction at low speed (Stribeck)": smooth * np.exp(-((mean_speed / (0.25 * top)) ** 2)),
        "friction that grows with the square of the speed": mean_speed**2,
        "friction that is not in proportion to the force": smooth**2,
        "friction even without a force: a bias of the sensor, or another normal": np.ones(len(y)),
    }
    noise_of_force = float(np.linalg.norm(x.torque_noise))
    part.misses = [f"friction: {what}" for what in missed(W, y, used, Z, extra, found, noise_of_force)]
    aside = one(np.ones((len(y), 1)), np.einsum("ij,ij->i", tangential, across), used)
    sideways = abs(float(aside.value[0]))
    if sideways > SURE * aside.deviation[0] and sideways > ACROSS * float(np.abs(y[used]).mean()):
        part.misses.append(
            f"friction: {sideways:.3g} N across the slip: another normal, a bias, or friction that has a direction"
        )
    part.time, part.measured, part.predicted = x.time[used], y[used], (y - found.residual[:, 0])[used]
    return part
