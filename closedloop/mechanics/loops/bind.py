"""What the loop joints of a robot bind, as the rows that the loop reads."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import plain
from closedloop.mechanics.loops.memory import (
    DISTANCE,
    GEAR,
    IDLE,
    POSITION,
    ROTATION,
    VALUES,
    Bound,
    LoopMemory,
    make_loop_memory,
)
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import Tree, work_size
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.kinematics import motion, sines
from robot_models.loop_joint import BINDS, LoopJoint

# A row that is no longer than this, and open by no more, m or rad, at every one of so many postures is so everywhere.
NOTHING, POSTURES = 1e-13, 4
# A row that is shorter than the longest by this factor there is rounding: no joint of the tree moves what it binds.
NO_ROW = 1e-11


@lru_cache(maxsize=8)
def bound_by_loops(robot: Robot) -> Bound:
    """Return what the loop joints of a robot bind."""
    model, tree = robot.model, robot.tree
    poses = link_poses(tree, model.loop_home)
    rows: list[tuple[int, int, int, Array, Array, Array, Array, Array]] = []
    sums = np.zeros((2, sum(loop.rows for loop in model.loops), tree.n))
    none, zero = np.zeros(5), np.zeros(3)
    for loop in model.loops:
        if loop.type == "gear":
            for each, found in zip(loop.sums, sums, strict=True):
                for joint, coefficient in each.items():
                    found[len(rows), model.joint_names.index(joint)] = coefficient
            one, *other = (model.joint_names.index(name) for name in loop.joints)
            value = np.array(loop.polynomial)
            rows.append((GEAR, one, other[0] if other else -1, zero, zero, zero, zero, value))
            continue
        (a, at_a, axes_a), (b, at_b, axes_b) = (_side(robot, poses, loop, k) for k in range(2))
        if loop.type == "distance":
            value = np.array([loop.length, 0.0, 0.0, 0.0, 0.0])
            rows.append((DISTANCE, a, b, at_a, at_b, zero, zero, value))
            continue
        positions, rotations = BINDS[loop.type]
        rows += [(POSITION, a, b, at_a, at_b, zero, axes_b[:, i], none) for i in positions]
        for i, j in rotations:
            rows.append((ROTATION, a, b, at_a, at_b, axes_a[:, j], _sign(i, j) * axes_b[:, i], none))
    kinds, one_sides, other_sides, *parts = zip(*rows, strict=True)
    at_a, at_b, along_a, along_b, value = (np.array(part, dtype=np.float64) for part in parts)
    sides = np.array([kinds, one_sides, other_sides, np.zeros(len(kinds))], dtype=np.int64)
    made = Bound(
        sides.ravel(), at_a, at_b, along_a, along_b, value, sums[0], sums[1], np.ones(len(kinds)), model.undriven,
        robot.moved,
    )  # fmt: skip
    idle, lengths = _lengths(tree, made)
    sides[0, idle & np.all(sides[1:3] >= -1, axis=0)] = IDLE  # what moves as it is told may open any row
    return _with_points_shared(made._replace(sides=sides.ravel(), scale=1.0 / lengths))


def _with_points_shared(bound: Bound) -> Bound:
    """Return what is bound with the mark of rows whose points are those of the row before, three to a point at most."""
    sides, first = bound.sides.reshape(4, -1).copy(), 0
    for k in range(bound.m):
        same = k > 0 and all(np.array_equal(x[k], x[k - 1]) for x in (bound.at_a, bound.at_b, sides[:3].T))
        sides[3, k] = same and sides[0, k] == POSITION and k - first < len(BINDS["point"][0])
        first = first if sides[3, k] else k
    return bound._replace(sides=sides.ravel())


def _lengths(tree: Tree, bound: Bound) -> tuple[NDArray[np.bool_], Array]:
    """Return which rows bind what no joint of the tree can move, and is as it should be, and how long the rows are.

    That is the longest that each is at some postures; at others, where the mechanism lies flat, it may be nothing.
    """
    memory, random = make_loop_memory(tree, bound), np.random.default_rng(0)
    idle, lengths = np.ones(bound.m, dtype=np.bool_), np.zeros(bound.m)
    for _ in range(POSTURES):
        memory.rows.q[:] = random.normal(size=tree.n)
        interpreted(locate_rows)(memory.links, memory.rows)
        idle &= (np.max(np.abs(memory.rows.G), axis=1) <= NOTHING) & (np.abs(memory.rows.error) <= NOTHING)
        lengths = np.maximum(lengths, np.linalg.norm(memory.rows.G, axis=1))
    longest = np.max(lengths, initial=0.0) or 1.0
    return idle, np.where(lengths > NO_ROW * longest, lengths, longest)


def loop_memory(robot: Robot) -> LoopMemory:
    """Return a new memory of a robot's loops."""
    return make_loop_memory(robot.tree, bound_by_loops(robot))


def step_memory(robot: Robot) -> LoopMemory:
    """Return the same for the steps of a run: without rows that no joint can move."""
    bound = bound_by_loops(robot)
    sides = bound.sides.reshape(4, -1)
    moving = sides[0] != IDLE
    parts = {name: getattr(bound, name)[moving] for name in VALUES}
    return make_loop_memory(robot.tree, _with_points_shared(bound._replace(sides=sides[:, moving].ravel(), **parts)))


def link_poses(tree: Tree, q: Array) -> list[tuple[Array, Array]]:
    """Return the axes, as columns, and the origin of every link of a tree at q, base frame, the base itself last."""
    work = np.zeros(plain(work_size)(tree.n))
    plain(sines)(tree, q, work)
    plain(motion)(tree, np.zeros(tree.n), work)
    poses = []
    for i in range(tree.n):
        s = int(tree.links[at.SCRATCH * tree.n + i])
        x, z = work[[s + at.X0, s + at.X1, s + at.X2]], work[[s + at.Z0, s + at.Z1, s + at.Z2]]
        poses.append((np.column_stack([x, np.cross(z, x), z]), work[[s + at.P0, s + at.P1, s + at.P2]]))
    return [*poses, (np.eye(3), np.zeros(3))]


def _side(robot: Robot, poses: list[tuple[Array, Array]], loop: LoopJoint, k: int) -> tuple[int, Array, Array]:
    """Return the link of a side of a loop joint, and the joint's point, m, and axes there, in the link's own axes.

    The tree has axes of its own in its links: where a frame is in them follows from where both are at one posture.
    """
    link, rotation, origin = robot.frame_at(loop.frames[k], robot.model.home)
    axes, place = poses[link]
    for i, frame in enumerate(robot.moved):
        if loop.frames[k] in frame.names:
            link, axes, place = -2 - i, frame.axes, frame.origin
    return link, axes.T @ (origin + rotation @ np.array(loop.points[k]) - place), axes.T @ rotation @ side_axes(loop, k)


def side_axes(loop: LoopJoint, k: int) -> Array:
    """Return the axes that the rows of a loop joint have on a side, as columns, in the axes of that side's frame."""
    if loop.type in ("slider", "weld"):  # all three directions agree
        first = _axes(np.array(loop.axes[0]))
        return first if k == 0 else np.array(loop.turn) @ first
    return _axes(np.array(loop.axes[k]))


def rotation_axes(loop: LoopJoint, pair: tuple[int, int]) -> tuple[Array, Array]:
    """Return the directions of a row of kind ROTATION, in the axes of either frame: its couple is about u × w."""
    i, j = pair
    return side_axes(loop, 0)[:, j], _sign(i, j) * side_axes(loop, 1)[:, i]


def _sign(i: int, j: int) -> float:
    """Return the sign with which axis j of the first side × axis i of the second is an axis of the joint."""
    return -1.0 if (i - j) % 3 == 2 else 1.0


def _axes(z: Array) -> Array:
    """Return axes, as columns, of which the last is a given direction."""
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
