"""What the loop joints of a mechanism carried in a run: their reactions, and how far they were from closed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.interim import call_now
from closedloop.jit.kernel import entry_kernel
from closedloop.loops.bind import DIRECTIONS, bound_by_loops, loop_memory
from closedloop.loops.factor import DEPENDENT
from closedloop.loops.memory import loops_at
from closedloop.loops.rows import locate_rows
from closedloop.robot.pinocchio import Robot

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class LoopReactions(NamedTuple):
    """Reactions and errors of the m rows of a mechanism's loops at N instants.

    Attributes
    ----------
    labels : tuple of str
        Of the rows: the loop joint's name, and what the row binds, such as "coupler: force along x". Axes are those of
        the joint on its second side, z its axis.
    units : tuple of str
        Of their reactions: N, or N m.
    reactions : (N, m) array
        On the first side of each joint. Where rows depend on each other they are those of least norm.
    errors : (N, m) array
        m, or the sine of an angle.
    rank : (N,) array of int
        How many rows were independent.
    unexplained : (N,) array
        The largest torque that neither the law, friction, the contact nor the loops account for, N m (N).
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    reactions: Array
    errors: Array
    rank: NDArray[np.int64]
    unexplained: Array


def loop_reactions(
    robot: Robot, q: Array, v: Array, acceleration: Array, torque: Array, force: Array, at_stop: Mask | None = None
) -> LoopReactions:
    """Return what the loops carried: Gᵀλ = H q̈ + C − Q − Jᵣᵀ F, with H, C and Jᵣ of Pinocchio.

    Parameters
    ----------
    robot : Robot
        With loops.
    q, v, acceleration, torque : (N, n) arrays
        q̇ and q̈; Q and friction in the joints together, N m (N).
    force : (N, 3) array
        F of the surface on the tip, N, base frame.
    at_stop : (N, n) array of bool, optional
        Joints that are at a stop, which carries its own part.
    """
    rows, errors = loop_rows(robot, q, v)
    missing = missing_torque(robot, q, v, acceleration, torque, force)
    # rows differ in unit: what depends on what is decided with each by its usual length
    scaled = bound_by_loops(robot).scale[:, None] * rows
    rank = np.linalg.matrix_rank(scaled, tol=DEPENDENT * np.sqrt(rows.shape[1])) if len(q) else np.zeros(0, dtype=int)
    reactions, stops = share_of_rows(rows, missing, at_stop)
    left = missing - stops - np.einsum("kmn,km->kn", rows, reactions)
    labels, units = _labels(robot)
    return LoopReactions(labels, units, reactions, errors, np.asarray(rank), np.max(np.abs(left), axis=1, initial=0.0))


def loop_rows(robot: Robot, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the rows G (N, m, n) of a robot's loops at states (N, n), and their errors (N, m), m or sines of angles.

    Parameters
    ----------
    robot : Robot
        With loops.
    q, v : (N, n) arrays
    """
    memory = loop_memory(robot)
    count, n, m = len(q), robot.n, int(memory.links.m)
    rows, errors = np.zeros((count, m, n)), np.zeros((count, m))
    written = memory.rows.memory, memory.links.memory, rows, errors
    call_now(rows_along, written, memory.address, np.ascontiguousarray(q), np.ascontiguousarray(v), rows, errors)
    return rows, errors


def share_of_rows(rows: Array, missing: Array, at_stop: Mask | None) -> tuple[Array, Array]:
    """Return the part of the rows (N, m) in a torque (N, n), and that of the stops (N, n): together of least norm."""
    m, n = rows.shape[1:]
    held = np.zeros((len(rows), n, n)) if at_stop is None else np.eye(n) * at_stop[:, None, :]
    inverse = np.linalg.pinv(np.swapaxes(np.concatenate([rows, held], axis=1), 1, 2), rcond=DEPENDENT)
    found = np.einsum("kmn,kn->km", inverse, missing)
    return found[:, :m], found[:, m:]


def missing_torque(robot: Robot, q: Array, v: Array, acceleration: Array, torque: Array, force: Array) -> Array:
    """Return H q̈ + C − Q − Jᵣᵀ F, (N, n), N m (N): what else acts on the joints. The arguments are those above."""
    missing = np.empty(q.shape)
    for k in range(len(q)):
        terms = robot.terms(q[k], v[k])
        missing[k] = terms.mass_matrix @ acceleration[k] + terms.bias - torque[k] - terms.jacobian.T @ force[k]
    return missing


def _labels(robot: Robot) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what each row is called, and the unit of its reaction."""
    labels, units = [], []
    for loop in robot.model.loops:
        for what, unit in DIRECTIONS[loop.type]:
            labels.append(f"{loop.name}: {what}")
            units.append(unit)
    return tuple(labels), tuple(units)


@entry_kernel
def rows_along(address: int, q: Array, v: Array, rows: Array, errors: Array) -> None:
    """Write the rows (N, m, n) and their errors (N, m) at states (N, n), by the address of the loops' memory."""
    links, there = loops_at(address)
    for k in range(q.shape[0]):
        for j in range(links.n):
            there.q[j], there.v[j] = q[k, j], v[k, j]
        locate_rows(links, there)
        for i in range(links.m):
            errors[k, i] = there.error[i]
            for j in range(links.n):
                rows[k, i, j] = there.G[i, j]
