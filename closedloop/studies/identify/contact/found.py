"""What fits of a contact begin with, and one part of what they find.

Where the tip is, what the sensor reads, and when they touch: what the fits of a contact begin with.

One part of what is found of a contact: linear in its parameters, with intervals, and what it misses.

The force sensor: its bias and the payload behind it where the tip is free, gain and delay beside the torques.

Free of contact a sensor whose axes are those of the tip's frame, R in the base's, reads in the base's axes

    F = R b + m (g − a),

its bias b and a payload m that moves with the tip, a. Only where the tip turns are both told apart. A log of the normal
force alone has one bias along it. Gain and delay are of the recorded normal force beside the force that follows
from q, v and torques (`closedloop.studies.comparison.recording.expected_force`),
f(t) = bias + gain f_expected(t − delay), fitted with the
expected force on the left: it has accelerations in it, and so more noise than the recorded one. Where
torques jump, or a drive holds them for a sample, they are half a row from the accelerations beside them: the delay is
not known better than that.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.studies.comparison.recording import EDGE, Recording, expected_force
from closedloop.studies.identify import motion
from closedloop.studies.identify.fit import Fit, fit, whiteness
from closedloop.studies.identify.identify import WHITENESS_LEVEL, Estimate
from closedloop.studies.identify.log import Log, LogError
from robot_models.tool import carried_by

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
    stride = -(-len(time) // motion.EVALUATIONS)
    if stride > 1:
        time, *ways = (_averaged(x, stride) for x in (time, *ways))
        force = None if force is None else _averaged(force, stride)
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
    stride = -(-len(time) // motion.EVALUATIONS)
    if stride > 1:
        time, height, force = (_averaged(x, stride) for x in (time, height, force))
    axes, none = np.broadcast_to(np.eye(3), (len(time), 3, 3)), np.zeros(len(time), dtype=bool)
    place = np.outer(height, normal)
    between = place, motion.half_of(place, 0), motion.half_of(place, 1)
    return _told(Touch(time, place, force[:, None], between, axes, normal, none, none, recording.source))


def _averaged(x: Array, stride: int) -> Array:
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


def unknown(name: str, unit: str, why: str, low: float = -np.inf) -> Estimate:
    """Return a parameter that the log does not tell."""
    return Estimate(name, np.nan, low, np.inf, unit, name, why)


def known(name: str, value: float, deviation: float, unit: str, z: float, grouping: str = "") -> Estimate:
    """Return a parameter with its interval."""
    return Estimate(name, value, value - z * deviation, value + z * deviation, unit, grouping or name, "")


def one(W: Array, y: Array, used: Mask, Z: Array | None = None) -> Fit:
    """Fit y (R,) by columns W (R, b), with instruments Z (R, b)."""
    return fit(W[:, None, :], y[:, None], used[:, None], None if Z is None else Z[:, None, :])


def missed(
    W: Array, y: Array, used: Mask, Z: Array | None, extra: Mapping[str, Array], found: Fit, noise: float
) -> list[str]:
    """Return the column of `extra` (R,) that a law lacks; or that its residual is not white, if none of them helps.

    `noise` is the standard deviation that the residual has from the noise of the log.
    """
    names = []
    for name, column in extra.items():
        wider = np.column_stack([W, column])
        more = one(wider, y, used, None if Z is None else np.column_stack([Z, column]))
        sure = more.told[-1] and abs(more.value[-1]) > SURE * more.deviation[-1]
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
