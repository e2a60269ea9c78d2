"""Where the tip is, what the sensor reads, and when they touch: what the fits of a contact begin with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.studies.comparison.recording import Recording
from closedloop.studies.identify.log import Log
from closedloop.studies.identify.motion import EVALUATIONS, Motion, motion, usual_cutoff, white_noise
from robot_models.tool import carried_by

# A force above this share of its range is surely of a contact; it counts as one above the other, or this many noises.
SURELY, LEAST, NOISES = 0.5, 0.02, 5.0
# So many times deeper than such forces sink in, and the tip is free.
DEEPER = 1.5
# Windows on either side of a change that do not count: the filter smears what happens in one into those beside it.
MARGIN = 2
# Windows that a cutoff should leave.
WINDOWS = 200


@dataclass(frozen=True, eq=False)
class Touch:
    """A log of a tip and a plane, N rows."""

    time: Array  # (N,): s
    position: Array  # (N, 3): of the tip, m, base axes
    # (N, 3) or (N, 1), optional: as recorded, N, on the robot: along the base's axes, or along the normal
    force: Array | None
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
    stride = -(-len(time) // EVALUATIONS)
    if stride > 1:
        time, q = _averaged(time, stride), _averaged(q, stride)
        force = None if force is None else _averaged(force, stride)
    axes, wrist = robot.frame_poses(robot.tip, q)
    position = wrist + axes @ carried_by(robot.model.tools, robot.tip)[1]
    none = np.zeros(len(time), dtype=bool)
    forces = None if force is None else force.reshape(len(time), -1)
    touch = Touch(time, position, forces, axes, normal, none, none, recording.source)
    return touch if forces is None else _told(touch)


def _averaged(x: Array, stride: int) -> Array:
    count = len(x) // stride
    return x[: count * stride].reshape(count, stride, *x.shape[1:]).mean(axis=1)


def _told(touch: Touch) -> Touch:
    """Return it with the rows that are free and closed.

    What lifts the tip above where large forces are, by more than such forces sink in, is free, whatever the sensor's
    bias is; what has a force beyond that of free rows is closed.
    """
    f, height = touch.along, touch.height
    noise = float(white_noise(f[:, None])[0])
    low, high = np.percentile(f, [0.5, 99.5])
    if high - low <= 2.0 * NOISES * noise:  # one level throughout
        return replace(touch, closed=np.full(len(f), bool(abs(f.mean()) > NOISES * noise)))
    sure = height[f > low + SURELY * (high - low)]
    bottom, top = np.percentile(sure, [1.0, 99.0])
    above = top + DEEPER * (top - bottom) + NOISES * float(white_noise(height[:, None])[0]) + 1e-9
    free = height > above
    level = float(np.median(f[free])) if free.any() else 0.0
    closed = ~free & (f - level > max(LEAST * (high - level), NOISES * noise))
    return replace(touch, free=free, closed=closed)


@dataclass(frozen=True, eq=False)
class Windows:
    """The motion of a tip and its force, averaged over windows."""

    # x, even, odd: of all rows of the positions, and of every other row, whose noise is independent
    x: Motion
    even: Motion
    odd: Motion
    touch: Touch
    cutoff: float  # Hz

    @classmethod
    def of(cls, touch: Touch, cutoff: float | None) -> Windows:
        """Filter, differentiate and average a log with a force."""
        assert touch.force is not None
        log = Log(touch.time, touch.position, touch.force, source=touch.source)
        if cutoff is None:  # slow motions too need windows enough
            cutoff = max(usual_cutoff(log), 0.5 * WINDOWS / (touch.time[-1] - touch.time[0]))
        x, even, odd = (motion(log, cutoff, rows) for rows in (None, slice(0, None, 2), slice(1, None, 2)))
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
        return motion(Log(touch.time, touch.position, moved), self.cutoff).torque

    def within(self, rows: Mask, margin: int = MARGIN) -> Mask:
        """Return the windows, (R,), all rows of which, and of so many beside them, are among `rows` (N,)."""
        width = self.x.time[1] - self.x.time[0] if len(self.x.time) > 1 else self.touch.step
        others = np.concatenate([[0], np.cumsum(~rows)])
        reach = (margin + 0.5) * width
        first = np.clip(np.searchsorted(self.touch.time, self.x.time - reach), 0, len(rows) - 1)
        last = np.clip(np.searchsorted(self.touch.time, self.x.time + reach), 1, len(rows))
        return np.asarray(others[last] == others[first])
