"""The loop joints of a mechanism in space: a mark for each where it is, and the force that it carries.

Both follow from the rows of the closure (`closedloop.loops.bind`), so that a later kind of loop joint is drawn as
well: as a ball, with an arrow for the force of those of its rows that have one.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from closedloop.columns.derived import reactions_of
from closedloop.lab.shapes import Shape, mark_shape
from closedloop.loops.bind import bound_by_loops, link_poses, loop_memory
from closedloop.loops.memory import DISTANCE, GEAR, POSITION
from closedloop.loops.reactions import loop_rows, rows_along
from closedloop.record.run import Run
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.arm import robot_of
from closedloop.simulation.cache import Cache
from closedloop.simulation.prepare import robot_key

Array = NDArray[np.float64]

# The robots of the runs drawn last: what is computed of a robot's loops is kept with it, and takes as long as a run of
# few steps.
_robots = Cache(limit=4)
# A robot has one memory for Pinocchio's results, and several threads draw.
_one_at_a_time = threading.Lock()


class _Row(NamedTuple):
    """A row that has a force: its number, its kind, and in the frame of the second side's joint its direction (3,)."""

    at: int
    kind: int
    direction: Array


class _Side(NamedTuple):
    """A side of a loop joint: the number of its joint's frame, 0 for the base, and there its point (3,), m."""

    frame: int
    point: Array


@dataclass(frozen=True)
class _Loop:
    """A loop joint: its name, what its mark looks like, its two sides, and its axes, in the first side's frame."""

    name: str
    shape: Shape
    sides: tuple[_Side, _Side]
    axes: Array
    rows: tuple[_Row, ...]
    rod: bool  # from one side to the other


@dataclass(frozen=True, eq=False)
class Joined:
    """The loop joints of a robot.

    Attributes
    ----------
    robot : Robot
        With loops or without.
    size : float
        The reach of the robot, m, which decides how large the marks are.
    """

    robot: Robot
    size: float

    @property
    def loops(self) -> tuple[_Loop, ...]:
        """The loop joints, in the order of the model."""
        return _loops_of(self.robot, self.size)

    def places(self, axes: Array, origins: Array) -> tuple[Array, Array]:
        """Return the axes (k, 3, 3), as columns, and the origins (k, 3), m, base frame, of the marks.

        Parameters
        ----------
        axes, origins : (n + 1, 3, 3) and (n + 1, 3) arrays
            The frames of the base and the joints.
        """
        turns, points = np.zeros((len(self.loops), 3, 3)), np.zeros((len(self.loops), 3))
        for k, loop in enumerate(self.loops):
            (first, points[k]), (_, other) = ((s.frame, origins[s.frame] + axes[s.frame] @ s.point) for s in loop.sides)
            turns[k] = _upright(other - points[k]) if loop.rod else axes[first] @ loop.axes
        return turns, points

    def forces(self, reactions: Array, axes: Array, origins: Array) -> Array:
        """Return the force (k, 3) of each loop joint on its second side, N, base frame.

        Where a rod ends on a platform it is the second: the force on the rod would be drawn inside of it.

        Parameters
        ----------
        reactions : (m,) array
            Of all rows, on the first side, see `closedloop.loops.reactions.LoopReactions`.
        axes, origins : (n + 1, 3, 3) and (n + 1, 3) arrays
            The frames of the base and the joints.
        """
        found = np.zeros((len(self.loops), 3))
        for k, loop in enumerate(self.loops):
            a, b = (origins[s.frame] + axes[s.frame] @ s.point for s in loop.sides)
            for row in loop.rows:
                apart = a - b
                along = (
                    apart / np.linalg.norm(apart) if row.kind == DISTANCE else axes[loop.sides[1].frame] @ row.direction
                )
                found[k] -= reactions[row.at] * along
        return found


@lru_cache(maxsize=8)
def _loops_of(robot: Robot, size: float) -> tuple[_Loop, ...]:
    """Return the loop joints of a robot, their marks as large as its reach `size`, m, asks for."""
    model = robot.model
    if not model.loops:
        return ()
    bound, mechanism = bound_by_loops(robot), model.pinocchio_model()
    poses = link_poses(robot.tree, model.home)
    kinds, first, second, _ = bound.sides.reshape(4, -1)
    data = mechanism.createData()
    pin.forwardKinematics(mechanism, data, model.home)
    frames = [(place.rotation, place.translation) for place in data.oMi]

    def turned(link: int, vector: Array) -> Array:  # from a link of the tree to the frame of its joint
        along: Array = frames[link + 1][0].T @ poses[link][0] @ vector
        return along

    def side(link: int, point: Array) -> _Side:
        place = poses[link][1] + poses[link][0] @ point
        return _Side(link + 1, frames[link + 1][0].T @ (place - frames[link + 1][1]))

    found, at = [], 0
    for loop in model.loops:
        rows = range(at, at + loop.rows)
        a, b = int(first[at]), int(second[at])
        sides = side(a, bound.at_a[at]), side(a if kinds[at] == GEAR else b, bound.at_b[at])
        forces = [_Row(k, int(kinds[k]), turned(b, bound.along_b[k])) for k in rows if kinds[k] in (POSITION, DISTANCE)]
        axis = np.array([0.0, 0.0, 1.0])
        if kinds[at] == GEAR:
            axis = turned(a, axis)
        elif loop.frames:
            axis = mechanism.frames[mechanism.getFrameId(loop.frames[0])].placement.rotation @ np.array(loop.axes[0])
        shape = mark_shape(loop.type, size, loop.length)
        found.append(_Loop(loop.name, shape, sides, _upright(axis), tuple(forces), bool(loop.length)))
        at += loop.rows
    return tuple(found)


def reactions_in(run: Run, robot: Robot, rows: NDArray[np.int64]) -> Array:
    """Return the reactions (k, m) of a mechanism's loops in some rows (k,) of its run, N or N m; (k, 0) of a tree."""
    if not run.model.loops:
        return np.zeros((len(rows), 0))
    few = {name: column[rows] for name, column in run.columns.items() if run.specs[name].dims[0] == "time"}
    with _one_at_a_time:
        return reactions_of(replace(run, columns={**run.columns, **few}), robot).reactions


def robot_in(run: Run) -> Robot:
    """Return the robot of a run, with the tool that the scenario puts on its tip: one for all runs with the same."""
    key = run.model, robot_key(run.scenario)
    return _robots.get_shared(key, lambda: robot_of(run.scenario, run.model), lambda robot: 1)


def errors_in(run: Run) -> Array:
    """Return the errors (N, m) of a mechanism's loops in all rows of its run, m or sines of angles."""
    robot = robot_in(run)
    compile_rows(robot)
    with _one_at_a_time:
        return loop_rows(robot, run.q, run.v)[1]


def compile_rows(robot: Robot) -> None:
    """Have compiled what evaluates the rows of loops: interpreted it takes 1 ms for each row of a run."""
    memory, n, m = loop_memory(robot), robot.n, sum(loop.rows for loop in robot.model.loops)
    states = np.zeros((0, n))
    states.flags.writeable = False  # as a run's columns are: for another type it would be compiled again
    rows_along(memory.address, states, states, np.zeros((0, m, n)), np.zeros((0, m)))


def _upright(axis: Array) -> Array:
    """Return axes, as columns, of which the last is along `axis` (3,), however long."""
    z = axis / (np.linalg.norm(axis) or 1.0)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x) or 1.0
    return np.column_stack([x, np.cross(z, x), z])
