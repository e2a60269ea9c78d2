"""What the loop joints of a mechanism carried: reactions, and wrenches in axes that a user names.

Of every kind between two frames: on the first side, in the axes of the second frame, about the joint's point on the
second side. The rows have axes of their own (`closedloop.mechanics.loops.bind`), which nothing outside needs to know.

And what a law asks of joints without a drive, of which the drives can give a part through the loops. A joint without a
drive gives no torque, and a drive that pulls several joints gives torques in one ratio. What all
drives give is a space of torques; what is perpendicular to it they give none of. But a force of the loops gives no
power to a motion that they allow, so that torques Q and Q' move the mechanism alike if vᵀQ = vᵀQ' for each v with
G v = 0. Let d be the part of a vector in that space, as in the joints with a drive, and p the rest, along
`robot_models.model.RobotModel.undriven`, and W an orthonormal basis of the motions of p alone, w with G w = 0 and
w_d = 0: the mechanism's drives held.

    Q'_p = 0,   Q'_d = Q_d + the shortest x with v_dᵀ x = v_pᵀ (1 − W Wᵀ) Q_p for each v with G v = 0

So where the drives span what the loops leave free, W is empty and Q' moves the mechanism just as Q would. Where they
do not, W Wᵀ Q_p, which is what gives power to motions that no drive takes part in, is lost, and the rest goes through
the loops. In a tree all of Q_p is lost.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, Mask
from closedloop.jit.background import make_ready
from closedloop.jit.calls import row_of, vector_at
from closedloop.jit.interim import call_now
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.mechanics.loops.bind import bound_by_loops, loop_memory, rotation_axes, side_axes
from closedloop.mechanics.loops.factor import DEPENDENT, factor
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, loops_at
from closedloop.mechanics.loops.moved import place_frames
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import combine_rows, dot, free_motion, meet_rows, orthonormal_rows, take_off
from closedloop.mechanics.robot.pinocchio import Robot
from robot_models import RobotModel
from robot_models.loop_coordinate import new_side
from robot_models.loop_joint import BINDS, LoopJoint


@kernel
def lose_undriven(undriven: Array, count: int, x: Array) -> None:
    """Take off a torque or motion x (n,) its components along `count` rows of `undriven`, which are orthonormal."""
    for u in range(count):
        take_off(x, row_of(undriven, u), x.shape[0])


@kernel
def through_drives(links: LoopLinks, rows: LoopRows, torque: Array) -> int:
    """Replace a torque (n,) by one of the drives alone, with the rows factored last; return how many motions W has."""
    if links.undriven == 0:
        return 0
    n, count = links.n, links.n - links.rank
    powers_of_undriven(links, rows, torque)
    for i in range(count):
        Z = row_of(rows.drive_basis, i)
        free_motion(links, rows, i, Z)
        whole = dot(Z, Z, n)
        lose_undriven(rows.undriven, links.undriven, Z)
        if not dot(Z, Z, n) > DEPENDENT * DEPENDENT * whole:  # no drive takes part in it: what is left is rounding
            for j in range(n):
                Z[j] = 0.0
    rank = orthonormal_rows(rows.drive_basis, count, rows.drive_order, rows.drive_coefficients, rows.drive_lengths)
    if rank < count:
        lose_power_of_undriven(links, rows, torque, rank)
        powers_of_undriven(links, rows, torque)
    lose_undriven(rows.undriven, links.undriven, torque)
    meet_rows(
        rows.wanted, rows.drive_order, rows.drive_coefficients, rows.drive_basis, rank, rows.drive_lengths, rows.share
    )
    for j in range(n):
        torque[j] += rows.share[j]
    return int(count - rank)


@kernel
def powers_of_undriven(links: LoopLinks, rows: LoopRows, torque: Array) -> None:
    """Write the power of the joints without a drive in each free motion, of one free joint at rate one, `wanted`."""
    for i in range(links.n - links.rank):
        power = 0.0
        free_motion(links, rows, i, rows.share)
        for u in range(links.undriven):
            direction = row_of(rows.undriven, u)
            power += dot(rows.share, direction, links.n) * dot(torque, direction, links.n)
        rows.wanted[i] = power


@kernel
def lose_power_of_undriven(links: LoopLinks, rows: LoopRows, torque: Array, rank: int) -> None:
    """Take W Wᵀ Q_p off the torque; W, with the drives at rest, is written into the basis after its `rank` directions.

    What the drives do in the i-th free motion is Σ aₖ of what they do in `rank` others: less these, they do nothing.
    """
    n, count, a = links.n, links.n - links.rank, rows.drive_lengths
    for i in range(rank, count):
        W = row_of(rows.drive_basis, i)
        combine_rows(row_of(rows.drive_coefficients, i), rows.drive_coefficients, rank, a)
        free_motion(links, rows, int(rows.drive_order[i]), W)
        for k in range(rank):
            free_motion(links, rows, int(rows.drive_order[k]), rows.share)
            for j in range(n):
                W[j] -= a[k] * rows.share[j]
        for j in range(n):
            rows.share[j] = W[j]
        lose_undriven(rows.undriven, links.undriven, rows.share)
        for j in range(n):
            W[j] -= rows.share[j]
        for _ in range(2):
            for m in range(rank, i):
                take_off(W, row_of(rows.drive_basis, m), n)
        length = math.sqrt(dot(W, W, n))
        for j in range(n):
            W[j] /= length
        take_off(torque, W, n)


def torque_of_drives(robot: Robot, q: Array, torque: Array) -> tuple[Array, int]:
    """Return the torque (n,) of the drives alone, N m (N), for a given one of a mechanism at q, and W's dimension."""
    links, rows = loop_memory(robot)
    rows.q[:], found = robot.rotation_vectors(q), np.array(torque)
    interpreted(locate_rows)(links, rows)
    interpreted(factor)(links, rows, rows.error, links.m)
    return found, int(interpreted(through_drives)(links, rows, found))


FORCES = tuple((f"force along {axis}", "N") for axis in "xyz")
COUPLES = tuple((f"couple about {axis}", "N m") for axis in "xyz")
PUSH = ("push between its points", "N")


def parts_of(model: RobotModel, loop: LoopJoint) -> tuple[tuple[str, str], ...]:
    """Return name and unit of each part of a loop joint's reaction."""
    if loop.type == "gear":
        types = dict(zip(model.joint_names, model.joint_types, strict=True))
        kinds = {"prismatic": ("force on", "N")}
        parts = [(name, *kinds.get(types[name], ("torque on", "N m"))) for name in loop.joints]
        return tuple((f"{what} {name}", unit) for name, what, unit in parts)
    if loop.type == "distance":
        return (*FORCES, PUSH)
    return FORCES if loop.type == "point" else FORCES + COUPLES


def labels_of(model: RobotModel) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what each part of the reactions of a mechanism is called, such as "coupler: force along x"; their units.

    No name and unit depend on a state, so what is to be shown is known before it is worked out.
    """
    parts = [(f"{loop.name}: {what}", unit) for loop in model.loops for what, unit in parts_of(model, loop)]
    return tuple(label for label, _ in parts), tuple(unit for _, unit in parts)


def named_side(robot: Robot, loop: LoopJoint) -> tuple[str, Array]:
    """Return the second frame of a loop joint as the user named it, and the joint's point there (3,), m.

    A joint with friction, a drive or stops may be welded to a new link, which hangs on the link that was named.
    """
    if loop.coordinates and new_side(loop) == 1:
        return robot.link_below(loop.coordinates[0])
    return loop.frames[1], np.array(loop.points[1])


def wrenches(robot: Robot, q: Array, time: Array, rows: Array, forces: Array) -> Array:
    """Return the parts of the reactions (N, c), in the order of `labels_of`, N or N m.

    `robot`: with loops.
    `q` (N, nq).
    `time` (N,): s.
    `rows` (N, m, n): G, see `closedloop.mechanics.loops.reactions.loop_rows`.
    `forces` (N, m): of the rows, on the first side.
    """
    found, at = [], 0
    between = [loop for loop in robot.model.loops if loop.type != "gear"]
    poses = robot.poses_of({n for loop in between for n in (*loop.frames, named_side(robot, loop)[0])}, q)
    for frame in robot.moved:
        turns, shifts = frame.displacements(time)
        for name in poses.keys() & frame.names:
            axes, origins = poses[name]
            poses[name] = turns @ axes, np.einsum("kij,kj->ki", turns, origins) + shifts
    for loop in robot.model.loops:
        own = slice(at, at + loop.rows)
        at = own.stop
        if loop.type == "gear":
            joints = [robot.joint_names.index(name) for name in loop.joints]
            found.append(forces[:, own] * rows[:, own.start][:, joints])
        else:
            found.append(_wrench(robot, loop, poses, forces[:, own]))
    return np.concatenate(found, axis=1) if found else np.zeros((len(q), 0))


def _wrench(robot: Robot, loop: LoopJoint, poses: Mapping[str, tuple[Array, Array]], forces: Array) -> Array:
    """Return the parts of the reaction (N, c) of a joint between two frames, from the forces of its rows (N, k)."""
    (first, one), (second, other) = (poses[name] for name in loop.frames)
    a = one + first @ np.array(loop.points[0])
    if loop.type == "distance":
        apart = a - other - second @ np.array(loop.points[1])
        force = forces * apart / np.linalg.norm(apart, axis=1, keepdims=True)
        return np.concatenate([_turned(second, force), forces], axis=1)
    positions, rotations = BINDS[loop.type]
    force = np.einsum("kij,jr,kr->ki", second, side_axes(loop, 1)[:, list(positions)], forces[:, : len(positions)])
    couple = np.zeros_like(force)
    for k, pair in enumerate(rotations, len(positions)):
        u, w = rotation_axes(loop, pair)
        couple += forces[:, [k]] * np.cross(first @ u, second @ w)
    name, point = named_side(robot, loop)
    named, other = poses[name]
    couple += np.cross(a - other - named @ point, force)  # the force of the rows acts at the point of the first side
    parts = [force] if loop.type == "point" else [force, couple]
    return np.concatenate([_turned(named, part) for part in parts], axis=1)


def loop_wrenches(robot: Robot, q: Array, reactions: Array) -> Iterator[tuple[tuple[str, ...], Array, Array]]:
    """Yield, of each loop joint but gears, its frames, a point (N, 3), m, and the wrench (N, 6) about it, base axes.

    It is that on the first side; the second has the opposite. A gear moves its joints from within, as their drives do.

    `robot`: with loops.
    `q` (N, nq).
    `reactions` (N, c): see `wrenches`.
    """
    at = 0
    for loop in robot.model.loops:
        parts, own = parts_of(robot.model, loop), at
        at += len(parts)
        if loop.type == "gear":
            continue
        name, point = (loop.frames[1], np.array(loop.points[1])) if loop.type == "distance" else named_side(robot, loop)
        turn, origin = robot.poses_of({name}, q)[name]
        force, couple = reactions[:, own : own + 3], np.zeros((len(q), 3))
        if parts[-1] in COUPLES:
            couple = reactions[:, own + 3 : own + 6]
        yield loop.frames, origin + turn @ point, np.concatenate([_out(turn, force), _out(turn, couple)], axis=1)


def _out(axes: Array, vector: Array) -> Array:
    """Return vectors (N, 3) of other axes (N, 3, 3), columns, in base axes."""
    return np.einsum("kij,kj->ki", axes, vector)


def _turned(axes: Array, vector: Array) -> Array:
    """Return vectors (N, 3) of base axes in other axes (N, 3, 3), columns."""
    return np.einsum("kij,ki->kj", axes, vector)


# Of no more states the rows are there, interpreted, before their kernel is compiled.
FEW_STATES = 1000


class LoopReactions(NamedTuple):
    """Reactions of a mechanism's loop joints at N instants, and errors of the m rows that they bind."""

    # of the c parts of the reactions: the loop joint's name, and what, such as "coupler: force along x"
    labels: tuple[str, ...]
    units: tuple[str, ...]  # of each: N, or N m
    # (N, c): on the first side of each joint (`frames[0]`), in the axes of its second frame (`frames[1]`; the base
    # frame if that is "world"): the force, and but for a point and a distance the couple about the joint's point on the
    # second side (`points[1]`). Friction, stops and the drive of a loop joint are part of it. A distance has the push
    # between its points too, of which the force is made: positive pushes them apart. A gear has the torque, N m, or
    # force, N, on each of its joints. Where rows depend on each other they are those of least norm
    reactions: Array
    joints: tuple[str, ...]  # the loop joint of each row
    multipliers: Array  # (N, m): forces of the rows of `loop_rows`, which act on the joints with Gᵀ multipliers
    errors: Array  # (N, m): of the rows, m, or the sine of an angle
    rank: NDArray[np.int64]  # (N,): how many rows were independent
    # (N,): the largest torque that neither the law, friction, the contact nor the loops account for, N m (N)
    unexplained: Array


def loop_reactions(
    robot: Robot, time: Array, q: Array, v: Array, acceleration: Array, torque: Array, force: Array,
    at_stop: Mask | None = None, stops: Array | None = None,
) -> LoopReactions:  # fmt: skip
    """Return what the loops carried: Gᵀλ = H q̈ + C − Q − Jᵣᵀ F, with H, C and Jᵣ of Pinocchio.

    `robot`: with loops.
    `time` (N,): s: frames that move are where they are then.
    `q` (N, nq).
    `v`, `acceleration`, `torque`, (N, n) arrays: q̇ and q̈; Q and friction in the joints together, N m (N).
    `force` (N, 3): F of the surface on the tip, N, base frame.
    `at_stop` (N, s): stops that are reached, each of which carries its own part.
    `stops` (s, n): the torque of each of them for a force of one; those of the joints if left out, s = n.
    """
    rows, errors = loop_rows(robot, q, v, time)
    missing = robot.needed_torque(q, v, acceleration, force) - torque
    # rows differ in unit: what depends on what is decided with each by its usual length
    scaled = bound_by_loops(robot).scale[:, None] * rows
    rank = np.linalg.matrix_rank(scaled, tol=DEPENDENT * np.sqrt(rows.shape[1])) if len(q) else np.zeros(0, dtype=int)
    forces, of_stops = share_of_rows(rows, missing, at_stop, bool(np.all(rank == rows.shape[1])), stops)
    left = np.max(np.abs(missing - of_stops - np.einsum("kmn,km->kn", rows, forces)), axis=1, initial=0.0)
    joints = tuple(loop.name for loop in robot.model.loops for _ in range(loop.rows))
    parts = wrenches(robot, q, time, rows, forces)
    return LoopReactions(*labels_of(robot.model), parts, joints, forces, errors, np.asarray(rank), left)


def loop_rows(robot: Robot, q: Array, v: Array, time: Array | None = None) -> tuple[Array, Array]:
    """Return the rows G (N, m, n) of a robot's loops at states, and their errors (N, m), m or sines of angles.

    `q`, (N, nq) array, or (N, n).
    `v` (N, n).
    `time` (N,): s: frames that move are where they are then, or at t = 0.
    """
    memory = loop_memory(robot)
    states = [np.ascontiguousarray(x).view() for x in (robot.rotation_vectors(q), v)]
    for each in states:
        each.flags.writeable = False  # as a run's columns are: another type would be compiled for this alone
    count, n, m = len(q), robot.n, int(memory.links.m)
    rows, errors = np.zeros((count, m, n)), np.zeros((count, m))
    frames = np.zeros((count, len(memory.placed)))
    for k, t in enumerate(np.zeros(count) if time is None else time) if robot.moved else ():
        interpreted(place_frames)(memory.links, float(t))
        frames[k] = memory.placed
    written = memory.rows.memory, memory.links.memory, rows, errors
    if count > FEW_STATES:
        make_ready(rows_along)
    call_now(rows_along, written, memory.address, *states, frames, rows, errors)
    return rows, errors


def share_of_rows(
    rows: Array, missing: Array, at_stop: Mask | None, independent: bool = False, stops: Array | None = None
) -> tuple[Array, Array]:
    """Return the part of the rows (N, m) in a torque (N, n), and that of the stops (N, n): together of least norm.

    Of the stops see `loop_reactions`.

    Of rows that are `independent` the part is unique: it takes a third of the time to factorise them as Q R.
    """
    m, n = rows.shape[1:]
    stops = np.eye(n) if stops is None else stops
    held = None
    if at_stop is not None and at_stop.any():
        reached = at_stop.any(axis=0)  # the others carry nothing at any instant
        held, stops = at_stop[:, reached, None], stops[reached]
    if independent and held is None:
        Q, R = np.linalg.qr(np.swapaxes(rows, 1, 2))
        return np.linalg.solve(R, np.swapaxes(Q, 1, 2) @ missing[:, :, None])[:, :, 0], np.zeros(missing.shape)
    bound = rows if held is None else np.concatenate([rows, stops * held], axis=1)
    found = np.einsum("kmn,kn->km", np.linalg.pinv(np.swapaxes(bound, 1, 2), rcond=DEPENDENT), missing)
    return found[:, :m], np.zeros(missing.shape) if held is None else found[:, m:] @ stops


@entry_kernel
def rows_along(address: int, q: Array, v: Array, frames: Array, rows: Array, errors: Array) -> None:
    """Write the rows (N, m, n) and their errors (N, m) at states (N, n), by the address of the loops' memory.

    frames (N, k) is what `place_frames` writes at each.
    """
    links, there = loops_at(address)
    placed = vector_at(links.scratch, links.scratch_size)[links.scratch_size - frames.shape[1] :]
    for k in range(q.shape[0]):
        for j in range(frames.shape[1]):
            placed[j] = frames[k, j]
        for j in range(links.n):
            there.q[j], there.v[j] = q[k, j], v[k, j]
        locate_rows(links, there)
        for i in range(links.m):
            errors[k, i] = there.error[i]
            for j in range(links.n):
                rows[k, i, j] = there.G[i, j]
