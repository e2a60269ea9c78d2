"""A log, what was measured of a robot that moved, by joint, and whether it can be what it says; its motion and torque.

The positions go through a Butterworth filter of order 4, forwards and backwards, and are differentiated twice by
central differences: no phase, so that the acceleration belongs to the torque of the same instant. Regressor and torque
are then averaged over the same windows ("parallel decimation": what the one loses the other loses too), one after the
other, so that white noise of the torque stays white. Sources: M. Gautier, Dynamic identification of robots with power
model, ICRA 1997; A. Janot, P.-O. Vandanjon, M. Gautier, A generic instrumental variable approach for industrial robot
identification, IEEE Trans. Control Systems Technology 22 (2014) 132-145.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import signal, stats
from scipy.interpolate import Akima1DInterpolator, CubicSpline

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from robot_models import RobotModel

# A joint angle above this, in rad, is taken for one in degrees.
LARGEST_TURN = 30.0
# So far beyond the limit of its file no joint turns, rad: the angle is another joint's, or has another unit or zero.
BEYOND = 1.0
# Beyond its limit by more than this, m, and by its whole range, no joint slides.
BEYOND_SLIDE = 0.2
# Steps of the time that differ by more than this share of their median are a jump.
UNEVEN = 0.5
# Rows over which a speed is measured: noise of single rows is no motion.
SPAN = 10
# A usual top speed of a joint, rad/s (m/s). Joints all slower than this share of it, and of their limits, in rows
# further apart than this, s, have their time in a smaller unit than s; one so many times faster has it in a larger one.
USUAL_SPEED, SLOWEST, FAR_APART, FASTEST = 5.0, 2e-3, 0.05, 20.0
# A joint has to move so far before its speeds are judged, rad (m).
MOVES = 1e-2
# Torques beyond so many times what the weight of the robot needs, and its drives can, have another unit; so have those
# below this share of its weight.
STRONGEST, WEAKEST = 20.0, 3e-3
# Postures of a log in which its weight is evaluated.
POSTURES = 100
# Torques outside this, N m (N), are of no robot.
LEAST_TORQUE, MOST_TORQUE = 1e-9, 1e9


class LogError(ModelError):
    """The log is at fault: a column is missing, an order or a unit cannot be, the robot rests."""


@dataclass(frozen=True, eq=False)
@fields_checked
class Log:
    """Measurements of a robot: N rows of n joints.

    Attributes
    ----------
    time : (N,)
        s, evenly spaced.
    q, torque : (N, n)
        Joint positions, rad (m), and torques of the drives at the joints, N m (N).
    joint_names : tuple of str
        Joints of the columns; empty if they are those of the robot, in its order.
    v : (N, n), optional
        Joint velocities, rad/s (m/s). They are used only to check the positions; the identification differentiates the
        positions.
    source : str
        Named in messages.
    """

    time: Array
    q: Array
    torque: Array
    joint_names: tuple[str, ...] = ()
    v: Array | None = None
    source: str = "the log"

    @property
    def step(self) -> float:
        """Time between two rows, s."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    def part(self, first: float, last: float) -> "Log":
        """Return the rows between two shares of the log: ``part(0, 0.75)`` is its first three quarters."""
        N = len(self.time)
        rows = slice(round(first * N), round(last * N))
        v = None if self.v is None else self.v[rows]
        return replace(self, time=self.time[rows], q=self.q[rows], torque=self.torque[rows], v=v)


def checked(log: Log, robot: RobotModel) -> Log:
    """Return the log with its joints in the robot's order.

    Raises LogError: a number of rows or joints is wrong, a value is not finite, time jumps or runs backwards, the
        joints are others, units cannot be those of SI, velocities are not the rates of the positions, or no joint
        moves.
    """
    where, n = log.source, robot.n
    time, q, torque = (np.ascontiguousarray(x, dtype=np.float64) for x in (log.time, log.q, log.torque))
    v = None if log.v is None else np.ascontiguousarray(log.v, dtype=np.float64)
    N = len(time)
    if time.ndim != 1 or N < 100:
        raise LogError(f"{where}: {N} rows: an identification needs at least 100")
    for name, x in (("q", q), ("torque", torque), ("v", v)):
        if x is not None and x.shape != (N, n):
            raise LogError(
                f"{where}: {name} has shape {x.shape}: {robot.name} needs ({N}, {n}), a column for each joint"
            )
        if x is not None and not np.isfinite(x).all():
            row, joint = np.argwhere(~np.isfinite(x))[0]
            raise LogError(
                f"{where}: {name} of joint {robot.joint_names[joint]} in row {row} is {x[row, joint]}: must be finite"
            )
    if log.joint_names:
        if sorted(log.joint_names) != sorted(robot.joint_names):
            raise LogError(
                f"{where}: its joints are {', '.join(log.joint_names)}: those of {robot.name} are "
                f"{', '.join(robot.joint_names)}"
            )
        order = [log.joint_names.index(name) for name in robot.joint_names]
        q, torque, v = q[:, order], torque[:, order], None if v is None else v[:, order]
    step = check_time(time, where)
    check_positions(q, robot, where)
    if np.ptp(q, axis=0).max() < 1e-3:
        raise LogError(
            f"{where}: the robot rests: no joint moves by more than {np.ptp(q, axis=0).max():.2g}, nothing can be found"
        )
    check_motion(q, v, step, robot, where)
    check_torques(q, torque, robot, where)
    return Log(time, q, torque, robot.joint_names, v, where)


def check_time(time: Array, where: str) -> float:
    """Return the median time between rows (N,), s; raise LogError if time runs backwards, or jumps."""
    steps = np.diff(time)
    if not np.isfinite(time).all():
        raise LogError(f"{where}: time in row {int(np.flatnonzero(~np.isfinite(time))[0])} is not finite")
    usual = float(np.median(steps))
    if usual <= 0.0:
        raise LogError(f"{where}: time does not increase: it must be in s, a row after the other")
    odd = np.flatnonzero(np.abs(steps - usual) > UNEVEN * usual)
    if len(odd):
        k = int(odd[0])
        raise LogError(
            f"{where}: time jumps by {steps[k]:.6g} s after row {k} ({len(odd)} such places), where rows are "
            f"{usual:.6g} s apart: cut the log there, or resample it"
        )
    return usual


def check_positions(q: Array, robot: RobotModel, where: str) -> None:
    """Raise LogError if positions (N, n) cannot be those of the robot in rad."""
    if not len(q):
        return
    turns = np.array([kind != "prismatic" for kind in robot.joint_types])
    largest = np.abs(q).max(axis=0)
    for joint in map(int, np.flatnonzero(turns & (largest > LARGEST_TURN))):
        raise LogError(
            f"{where}: joint {robot.joint_names[joint]} reaches {largest[joint]:.4g}: angles look like degrees, and "
            "must be in rad: convert them, or give --degrees"
        )
    beyond = np.maximum(q.max(axis=0) - robot.position_upper, robot.position_lower - q.min(axis=0))
    for joint in map(int, np.flatnonzero(turns & (beyond > BEYOND))):
        raise LogError(
            f"{where}: joint {robot.joint_names[joint]} reaches {largest[joint]:.4g} rad, {beyond[joint]:.3g} beyond "
            "its limit: angles in degrees, joints in another order, or a zero elsewhere?"
        )
    span = robot.position_upper - robot.position_lower
    for joint in map(int, np.flatnonzero(~turns & (beyond > np.maximum(span, BEYOND_SLIDE)))):
        raise LogError(
            f"{where}: joint {robot.joint_names[joint]} reaches {largest[joint]:.4g} m, {beyond[joint]:.3g} beyond its "
            f"limit: give its unit, as in {_unit('q', 'mm')}"
        )


def _unit(what: str, unit: str) -> str:
    """Return the words that give the columns of a quantity a unit."""
    return f"--columns {what}='NAME{'' if what == 'time' else '_{}'} [{unit}]'"


def check_motion(q: Array, v: Array | None, step: float, robot: RobotModel, where: str) -> None:
    """Raise LogError if positions (N, n), rad (m), at rows `step` s apart are no motion of the robot, or v (N, n),
    rad/s (m/s), is not its rate."""
    turns = np.ptp(q, axis=0) if len(q) else np.zeros(q.shape[1])
    span = min(SPAN, len(q) // 4)
    if span == 0 or turns.max(initial=0.0) < MOVES:
        return
    moved = np.abs(np.diff(q, axis=0)) * [kind in ("revolute", "continuous") for kind in robot.joint_types]
    if moved.max() > np.pi:
        row, joint = divmod(int(moved.argmax()), len(robot.joint_names))
        raise LogError(
            f"{where}: joint {robot.joint_names[joint]} turns by {moved[row, joint]:.4g} rad from row {row} to the "
            "next, more than half a turn: do its angles begin anew there? Unwrap them (numpy.unwrap), or take more rows"
        )
    if v is not None:
        check_velocities(q, v, step, robot, where)
    speed = np.percentile(np.abs(q[span:] - q[:-span]), 99.0, axis=0) / (span * step)
    limit = np.where(robot.velocity_limit > 0.0, robot.velocity_limit, USUAL_SPEED)
    slow, fast = speed / np.minimum(limit, USUAL_SPEED), speed / np.maximum(limit, USUAL_SPEED)
    if slow.max() < SLOWEST and step > FAR_APART:
        unit = next((u for u, k in (("ms", 1e-3), ("us", 1e-6)) if step * k < 10.0 * FAR_APART), "ns")
        raise LogError(
            f"{where}: rows are {step:.4g} s apart, and no joint is faster than {speed.max():.2g} rad/s: is its time "
            f"in s? Give its unit, as in {_unit('time', unit)}"
        )
    if fast.max() > FASTEST:
        joint = int(fast.argmax())
        raise LogError(
            f"{where}: joint {robot.joint_names[joint]} is as fast as {speed[joint]:.3g} rad/s in rows {step:.4g} s "
            f"apart: give the units, as in {_unit('q', 'deg')} or {_unit('time', 'minutes')}"
        )


def check_torques(q: Array, torque: Array, robot: RobotModel, where: str) -> None:
    """Raise LogError if torques (N, n) at positions q (N, n) are far too large or too small for the robot."""
    largest = np.abs(torque).max(initial=0.0)
    if largest and not LEAST_TORQUE < largest < MOST_TORQUE:
        raise LogError(f"{where}: torques reach {largest:.3g} N m: give their unit, as in {_unit('torque', 'mN m')}")
    if robot.loops or not largest:
        return
    import pinocchio as pin

    model: Any = robot.pinocchio_model()
    data = model.createData()
    rows = q[:: max(1, len(q) // POSTURES)]
    weight = np.sqrt(np.mean([np.sum(pin.computeGeneralizedGravity(model, data, row) ** 2) for row in rows]))
    limits = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 0.0)
    size, most = float(np.sqrt((torque**2).sum(axis=1).mean())), max(weight, float(np.linalg.norm(limits)))
    if 0.0 < STRONGEST * most < size or size < WEAKEST * weight:
        raise LogError(
            f"{where}: torques are {size:.3g} N m (RMS of all joints), where the robot's weight needs {weight:.3g}: "
            f"give their unit, as in {_unit('torque', 'mN m')}, or a gain"
        )


def check_velocities(q: Array, v: Array, step: float, robot: RobotModel, where: str) -> None:
    """Raise LogError if velocities (N, n) are not the rates of the positions, or of another joint's."""
    span = min(SPAN, len(q) // 4)
    rate = (q[span:] - q[:-span]) / (span * step)
    sums = np.cumsum(v, axis=0)
    mean = (sums[span:] - sums[:-span] + 0.5 * (v[:-span] - v[span:])) / span  # by the trapezoidal rule
    for joint, name in enumerate(robot.joint_names):
        size = float(rate[:, joint] @ rate[:, joint])
        if np.ptp(q[:, joint]) < MOVES or size == 0.0:
            continue
        products, sizes = rate[:, joint] @ mean, np.sqrt(size * (mean * mean).sum(axis=0))
        share, alike = products / size, products / np.where(sizes > 0.0, sizes, np.inf)
        best = int(alike.argmax())
        if alike[joint] < 0.9 and best != joint and alike[best] > 0.95:
            raise LogError(
                f"{where}: the velocity of {name} is the rate of no position of it, but that of "
                f"{robot.joint_names[best]} is: are the joints in another order?"
            )
        if alike[joint] > 0.9 and not 0.5 < share[joint] < 2.0:
            reasons = {
                180.0 / np.pi: f"they look like degrees, and must be in rad/s: {_unit('v', 'deg/s')}",
                np.pi / 180.0: f"positions look like degrees, and must be in rad: {_unit('q', 'deg')}",
                1e3: f"one of them, or time, has another unit, such as {_unit('time', 'ms')}",
                1e6: f"one of them, or time, has another unit, such as {_unit('time', 'us')}",
                1e9: f"one of them, or time, has another unit, such as {_unit('time', 'ns')}",
            }
            near = next((text for k, text in reasons.items() if 0.75 < share[joint] / k < 1.33), None)
            raise LogError(
                f"{where}: velocities of {name} are {share[joint]:.3g} times the rate of its positions: "
                f"{near or 'one of them, or time, has another unit'}"
            )


# Rows at which the regressor is evaluated, at most; a longer log is evaluated at every third, fifth ... row.
EVALUATIONS = 240_000
# Averages that are kept, at most.
WINDOWS = 24_000
# The cutoff over the frequency below which the motion has 99 % of its velocity.
ABOVE_MOTION = 10.0
# Joints slower than this share of the fastest (RMS) do not count for the cutoff.
EXCITED = 0.02
# The probability with which noise alone has so much power at a frequency that it counts as motion.
NOISE_ONLY = 1e-6
# A change of a position below this share of it is rounding, and no count of an encoder.
ROUNDING = 1e-9
# Of changes by less than so many counts more than this share are whole multiples of one, to this share of it.
FEW, MOSTLY, NEARLY = 5.5, 0.9, 0.1
# Changes of a count that tell the position between them.
FEWEST_CHANGES = 4


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the regressor is evaluated, and the torque of each window."""

    # q, v, a (R D, n): positions, velocities and accelerations, D rows a window
    q: Array
    v: Array
    a: Array
    time: Array  # (R,): middle of each window, s
    torque: Array  # (R, n): mean over the window, N m
    size: int  # D
    noise: Array  # (n,): standard deviation of the noise of `v`, rad/s, from that of the positions, or their counts
    torque_noise: Array  # (n,): standard deviation of the noise of `torque`, N m, if it is white
    cutoff: float  # of the low-pass, Hz


def joined(motions: Sequence[Motion]) -> Motion:
    """Return several motions as one, one after the other in time."""
    if len(motions) == 1:
        return motions[0]
    if len({x.size for x in motions}) > 1:
        raise LogError("the logs have different rates: resample them to the same one")
    shift, times = 0.0, []
    for x in motions:
        times.append(x.time - x.time[0] + shift)
        shift = times[-1][-1] + (x.time[1] - x.time[0])
    q, v, a, torque = (np.concatenate([getattr(x, name) for x in motions]) for name in ("q", "v", "a", "torque"))
    noise, torque_noise = (np.max([getattr(x, name) for x in motions], axis=0) for name in ("noise", "torque_noise"))
    return Motion(q, v, a, np.concatenate(times), torque, motions[0].size, noise, torque_noise, motions[0].cutoff)


def white_noise(x: Array) -> Array:
    """Return the standard deviation of the white noise in each column, (n,), from its fourth differences."""
    # The coefficients 1 -4 6 -4 1 have the sum of squares 70.
    return np.median(np.abs(np.diff(x, 4, axis=0)), axis=0) / (0.6745 * np.sqrt(70.0))


def count_of(x: Array) -> Array:
    """Return the size of a count in each column, (n,), the least change of it; 0 where it does not count.

    What counts has rows that repeat others, and its changes are whole multiples of the least. A joint that rests and
    then moves smoothly has changes of any size.
    """
    steps = np.abs(np.diff(x, axis=0))
    repeated = (steps == 0.0).any(axis=0)
    steps[steps <= ROUNDING * np.abs(x).max(axis=0)] = np.inf
    least = steps.min(axis=0)
    counts = repeated & np.isfinite(least)
    for j in np.flatnonzero(counts):
        few = steps[steps[:, j] < FEW * least[j], j] / least[j]
        counts[j] = np.mean(np.abs(few - np.round(few)) < NEARLY) > MOSTLY
    return np.where(counts, least, 0.0)


def between_counts(q: Array) -> Array:
    """Return positions (N, n) that encoders count, with those between two counts where there are counts.

    A row tells a position to half a count; two rows between which the count changes tell it to the way of one row,
    which is less where a joint is slow: there the error of a count lasts for many rows, and is no white noise. Between
    such instants the position is interpolated (Akima's cubics), within half a count of its reading.
    """
    found = np.array(q)
    for j, count in enumerate(count_of(q)):
        before = np.flatnonzero(np.diff(q[:, j]))
        if count == 0.0 or len(before) < FEWEST_CHANGES:
            continue
        changes = Akima1DInterpolator(before + 0.5, 0.5 * (q[before, j] + q[before + 1, j]))
        rows = np.arange(before[0] + 1, before[-1] + 1)
        half = 0.5 * count
        found[rows, j] = np.clip(changes(rows), q[rows, j] - half, q[rows, j] + half)
    return found


def low_passed(q: Array, cutoff: float, step: float) -> Array:
    """Return columns (N, n) without what is above the cutoff, Hz, and without lag."""
    return np.asarray(signal.sosfiltfilt(signal.butter(4, 2.0 * cutoff * step, output="sos"), q, axis=0))


def counted_from_elsewhere(q: Array, size: Array, draw: np.random.Generator) -> Array:
    """Return positions (N, n) as encoders of this size of a count (n,) have them, 0 for none, with counts that begin
    anywhere."""
    begin, unit = draw.uniform(size=len(size)) * size, np.where(size > 0.0, size, 1.0)
    return np.where(size > 0.0, np.round((q + begin) / unit) * unit - begin, q)


def half_of(q: Array, k: int) -> Array:
    """Return positions (N, n) of every other row, from row k on, with those of the rows between from a cubic."""
    known = np.arange(k, len(q), 2)
    return np.asarray(CubicSpline(known, between_counts(q[known]), axis=0)(np.arange(len(q))))


def usual_cutoff(log: Log) -> float:
    """Return a cutoff, Hz: ten times the frequency below which 99 % of the joints' squared velocity lies."""
    step = log.step
    rate = np.gradient(log.q, step, axis=0)
    segment = min(len(rate), max(256, round(4.0 / step)))
    f, power = signal.welch(rate, 1.0 / step, nperseg=segment, axis=0)
    # Of noise of the positions the power of the velocity grows with f²: it is taken off, and what noise may be is not
    # counted, as little of it at high frequencies would be more than the motion.
    counted = np.maximum(white_noise(log.q), count_of(log.q) / np.sqrt(12.0))
    noise = 2.0 * step * counted**2 * (2.0 * np.pi * f[:, None]) ** 2
    degrees = 2.0 * max(1.0, 2.0 * len(rate) / segment - 1.0)
    power = np.where(power > stats.chi2.isf(NOISE_ONLY, degrees) / degrees * noise, power - noise, 0.0)
    whole = power.sum(axis=0)
    share = np.cumsum(power, axis=0) / np.maximum(whole, 1e-300)
    moves = whole > EXCITED**2 * whole.max()
    at = [min(int(np.searchsorted(share[:, j], 0.99)), len(f) - 1) for j in np.flatnonzero(moves)]
    highest = float(f[max(at, default=0)])
    return float(min(ABOVE_MOTION * max(highest, f[1]), 0.2 / step))


def speed_noise(log: Log, cutoff: float) -> Array:
    """Return the standard deviation (n,) of the speeds of a log's motion, rad/s (m/s), by the noise of its positions.

    A count passes the filter as a pulse of about one count times the cut-off.
    """
    white = 2.0 * np.pi * white_noise(log.q) * np.sqrt(2.0 * log.step * cutoff**3 / 3.0)
    return np.asarray(np.maximum(white, count_of(log.q) * cutoff))


def motion(log: Log, cutoff: float, half: int | None = None) -> Motion:
    """Return the motion and the torques of a log.

    `cutoff`: of the low-pass, Hz, below half the rate of the log. A window is half its period.
    `half`: every other row of the positions is used, from this one on: the others are replaced by what lies between
        them, so that two motions of one log have noise that is independent.
    """
    step, N = log.step, len(log.time)
    if not 0.0 < cutoff < 0.5 / step:
        raise LogError(
            f"{log.source}: cutoff is {cutoff:.6g} Hz: it must be above 0 and below half the rate, {0.5 / step:.6g} Hz"
        )
    window = max(1, round(0.5 / (cutoff * step)))
    window = max(window, -(-N // WINDOWS))
    stride = max(1, -(-N // EVALUATIONS))
    stride += 1 - stride % 2  # odd: the evaluation is in the middle of the rows that it stands for
    size = max(1, round(window / stride))
    edge = min(round(2.0 / (cutoff * step)), N // 10)
    count = (N - 2 * edge) // (stride * size)
    if count < 50:
        raise LogError(
            f"{log.source}: {N} rows are {max(count, 0)} windows of {size * stride} at a cutoff of {cutoff:.4g} Hz: "
            "50 are needed; take a longer log, or a higher cutoff"
        )
    q = between_counts(log.q) if half is None else half_of(log.q, half)
    filtered = low_passed(q, cutoff, step)
    v = np.gradient(filtered, step, axis=0)
    a = np.gradient(v, step, axis=0)
    at = edge + (stride - 1) // 2 + stride * np.arange(count * size)
    used = slice(edge, edge + count * size * stride)
    averaged = (count, size * stride)
    return Motion(
        filtered[at], v[at], a[at],
        log.time[used].reshape(averaged).mean(axis=1),
        log.torque[used].reshape(*averaged, -1).mean(axis=1),
        size, speed_noise(log, cutoff), white_noise(log.torque) / np.sqrt(size * stride), cutoff,
    )  # fmt: skip
