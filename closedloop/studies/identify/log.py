"""A log: what was measured of a robot that moved, by joint, and whether it can be what it says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError

if TYPE_CHECKING:
    from robot_models import RobotModel

# A joint angle above this, in rad, is taken for one in degrees.
LARGEST_TURN = 30.0
# So far beyond the limit of its file no joint turns, rad: the angle is another joint's, or has another unit or zero.
BEYOND = 1.0
# Steps of the time that differ by more than this share of their median are a jump.
UNEVEN = 0.5


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

    def part(self, first: float, last: float) -> Log:
        """Return the rows between two shares of the log: ``part(0, 0.75)`` is its first three quarters."""
        N = len(self.time)
        rows = slice(round(first * N), round(last * N))
        v = None if self.v is None else self.v[rows]
        return replace(self, time=self.time[rows], q=self.q[rows], torque=self.torque[rows], v=v)


def checked(log: Log, robot: RobotModel) -> Log:
    """Return the log with its joints in the robot's order.

    Raises
    ------
    LogError
        A number of rows or joints is wrong, a value is not finite, time jumps or runs backwards, the joints are others,
        angles are in degrees, velocities are not the rates of the positions, or no joint moves.
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
    check_time(time, where)
    check_positions(q, robot, where)
    if np.ptp(q, axis=0).max() < 1e-3:
        raise LogError(
            f"{where}: the robot rests: no joint moves by more than {np.ptp(q, axis=0).max():.2g}, nothing can be found"
        )
    if v is not None:
        check_velocities(q, v, (time[-1] - time[0]) / (N - 1), robot, where)
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


def check_velocities(q: Array, v: Array, step: float, robot: RobotModel, where: str) -> None:
    """Raise LogError if velocities (N, n) are not the rates of the positions, or of another joint's."""
    rate = np.gradient(q, step, axis=0)
    for joint, name in enumerate(robot.joint_names):
        size = float(rate[:, joint] @ rate[:, joint])
        if np.ptp(q[:, joint]) < 1e-2 or size == 0.0:
            continue
        share = np.array([float(rate[:, joint] @ v[:, other]) for other in range(q.shape[1])]) / size
        alike = np.array([_alike(rate[:, joint], v[:, other]) for other in range(q.shape[1])])
        best = int(alike.argmax())
        if alike[joint] < 0.9 and best != joint and alike[best] > 0.95:
            raise LogError(
                f"{where}: the velocity of {name} is the rate of no position of it, but that of "
                f"{robot.joint_names[best]} is: are the joints in another order?"
            )
        if alike[joint] > 0.9 and 40.0 < share[joint] < 70.0:
            raise LogError(
                f"{where}: velocities of {name} are {share[joint]:.3g} times the rate of its positions: they look like "
                "degrees, and must be in rad/s"
            )
        if alike[joint] > 0.9 and not 0.5 < share[joint] < 2.0:
            raise LogError(
                f"{where}: velocities of {name} are {share[joint]:.3g} times the rate of its positions: one of "
                "them, or time, has another unit"
            )


def _alike(x: Array, y: Array) -> float:
    size = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / size if size > 0.0 else 0.0
