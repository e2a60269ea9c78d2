"""The loop joints of a mechanism in space: a mark for each where it is, and the force that it carries.

A mark's place follows from the rows of the closure (`closedloop.mechanics.loops.bind`), its force from the joint's
reaction (`closedloop.mechanics.loops.wrench`), so that a later kind of loop joint is drawn as well: as a ball.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.scene.shapes import Shape, mark_shape
from closedloop.mechanics.loops.bind import bound_by_loops, link_poses, loop_memory
from closedloop.mechanics.loops.memory import GEAR
from closedloop.mechanics.loops.reactions import loop_rows, rows_along
from closedloop.mechanics.loops.wrench import named_side, parts_of
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.columns.derived import reactions_of
from closedloop.record.run import Run
from closedloop.scenario.arm import robot_of
from closedloop.simulation.cache import Cache
from closedloop.simulation.prepare import robot_key

# The robots of the runs drawn last: what is computed of a robot's loops is kept with it, and takes as long as a run of
# few steps.
_robots = Cache(limit=4)
# A robot has one memory for Pinocchio's results, and several threads draw.
_one_at_a_time = threading.Lock()


class _Side(NamedTuple):
    """A side of a loop joint: the number of its joint's frame, 0 for the base, and there its point (3,), m."""

    frame: int
    point: Array


@dataclass(frozen=True)
class _Loop:
    """A loop joint: its name, what its mark looks like, its two sides, and its axes, in the first side's frame.

    `named` are the joint's frame, 0 for the base, and there the axes, as columns, in which its reaction is; `force`
    says which parts of all reactions are its force: none of a gear.
    """

    name: str
    shape: Shape
    sides: tuple[_Side, _Side]
    axes: Array
    named: tuple[int, Array]
    force: tuple[int, ...]
    rod: bool  # from one side to the other


@dataclass(frozen=True, eq=False)
class Joined:
    """The loop joints of a robot."""

    robot: Robot  # with loops or without
    size: float  # the reach of the robot, m, which decides how large the marks are

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
        reactions : (c,) array
            On the first side, see `closedloop.mechanics.loops.reactions.LoopReactions`.
        axes, origins : (n + 1, 3, 3) and (n + 1, 3) arrays
            The frames of the base and the joints.
        """
        found = np.zeros((len(self.loops), 3))
        for k, loop in enumerate(self.loops):
            if loop.force:
                number, turn = loop.named
                found[k] = -axes[number] @ turn @ reactions[list(loop.force)]
        return found


@lru_cache(maxsize=8)
def _loops_of(robot: Robot, size: float) -> tuple[_Loop, ...]:
    """Return the loop joints of a robot, their marks as large as its reach `size`, m, asks for."""
    model = robot.model
    if not model.loops:
        return ()
    bound, mechanism = bound_by_loops(robot), model.pinocchio_model()
    poses = link_poses(robot.tree, model.loop_home)
    kinds, first, second, _ = bound.sides.reshape(4, -1)
    data = mechanism.createData()
    pin.forwardKinematics(mechanism, data, robot.pinocchios(model.home))
    frames = [(place.rotation, place.translation) for place in data.oMi]

    def side(link: int, point: Array) -> _Side:
        place = poses[link][1] + poses[link][0] @ point
        return _Side(link + 1, frames[link + 1][0].T @ (place - frames[link + 1][1]))

    found, at, parts = [], 0, 0
    for loop in model.loops:
        a, b = int(first[at]), int(second[at])
        sides = side(a, bound.at_a[at]), side(a if kinds[at] == GEAR else b, bound.at_b[at])
        axis, named, force = np.array([0.0, 0.0, 1.0]), (0, np.eye(3)), range(0)
        if kinds[at] == GEAR:
            axis = frames[a + 1][0].T @ poses[a][0] @ axis
        elif loop.frames:
            number, turn, _ = robot.frame_at(named_side(robot, loop)[0], model.home)
            named, force = (number + 1, frames[number + 1][0].T @ turn), range(parts, parts + 3)
            axis = mechanism.frames[mechanism.getFrameId(loop.frames[0])].placement.rotation @ np.array(loop.axes[0])
        shape = mark_shape(loop.type, size, loop.length)
        found.append(_Loop(loop.name, shape, sides, _upright(axis), named, tuple(force), bool(loop.length)))
        at, parts = at + loop.rows, parts + len(parts_of(model, loop))
    return tuple(found)


def reactions_in(run: Run, rows: NDArray[np.int64]) -> Array:
    """Return the reactions (k, c) of a mechanism's loops in some rows (k,) of its run, N or N m; (k, 0) of a tree."""
    if not run.model.loops:
        return np.zeros((len(rows), 0))
    few = {name: column[rows] for name, column in run.columns.items() if run.specs[name].dims[0] == "time"}
    robot = robot_in(run, whole=True)
    with _one_at_a_time:
        return reactions_of(replace(run, columns={**run.columns, **few}), robot).reactions


def robot_in(run: Run, whole: bool = False) -> Robot:
    """Return the robot of a run, with the tool that the scenario puts on its tip: one for all runs with the same.

    If asked for, links that stand for coordinates of loop joints share no mass, as for their reactions.
    """
    key = run.model, whole, robot_key(run.scenario)
    model = replace(run.model, whole=True) if whole else run.model
    return _robots.get_shared(key, lambda: robot_of(run.scenario, model), lambda robot: 1)


def errors_in(run: Run, rows: NDArray[np.int64]) -> Array:
    """Return the errors (k, m) of a mechanism's loops in some rows (k,) of its run, m or sines of angles."""
    robot = robot_in(run)
    compile_rows(robot)
    with _one_at_a_time:
        return loop_rows(robot, run.q[rows], run.v[rows])[1]


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
