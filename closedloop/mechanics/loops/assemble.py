"""Postures and velocities that close the loops of a mechanism: at the start, and along a path of the tip.

The state that obeys the loops is the nearest one to a given state, joints counting alike. The measure is the same at
every state. With one that is not, such as that of H, a stage of a Runge-Kutta step would be moved along the loops by
what the measure has changed since the last stage, which takes an order from the scheme.
"""

import math
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.jit.calls import row_of
from closedloop.jit.dual8 import has_derivatives, sought
from closedloop.jit.interim import call_now
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.factor import factor, meet
from closedloop.mechanics.loops.memory import LoopLinks, LoopMemory, LoopRows, loops_at, tree_at
from closedloop.mechanics.loops.rows import locate_rows, place_rows
from closedloop.mechanics.loops.solve import basis_alike, dot, leave_free, take_free
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree.layout import move_posture
from robot_models.coordinates import with_quaternions
from robot_models.model import AT_LIMIT

# Newton steps at most, and the error, m or rad, below which there is no other: rounding.
MOST_MOVES, CLOSED = 50, 1e-15
# A loop is closed if no error is above this, m or rad.
TOLERANCE = 1e-12
# Where a step has left no more than this share of the error, the next is taken with the rows as they were: it leaves
# about the same share of it.
FAST = 1e-3


@kernel
def factor_rows(links: LoopLinks, rows: LoopRows, b: Array, most: int) -> None:
    """Factor the rows G, of `most` independent ones at most, for b (m,), and write the basis; joints count alike."""
    factor(links, rows, b, most)
    basis_alike(links, rows)


@kernel
def largest_error(links: LoopLinks, rows: LoopRows) -> float:
    """Return the largest error of the rows, m or rad."""
    largest = 0.0
    for k in range(links.m):
        size = abs(rows.error[k])
        if not size <= largest:
            largest = size
    return largest


@kernel
def close_state(links: LoopLinks, rows: LoopRows, q: Array, v: Array) -> float:
    """Move q and q̇ to the nearest state that the loops allow; return the error left, m or rad.

    Newton's method on the error, each step the shortest, until the error is rounding or no longer shrinks; then the
    velocity. The rows are factored again only where they have changed much since.
    """
    n, tree, before, left, factored_here = links.n, tree_at(links), math.inf, math.inf, False
    # Rows that depend on others where the loops are closed seem not to where they are open.
    most = links.known if links.known > 0 else links.m
    for _ in range(MOST_MOVES):
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        place_rows(links, rows)
        left = largest_error(links, rows)
        factored_here = not (before < math.inf and left <= FAST * before)
        if factored_here:
            factor_rows(links, rows, rows.error, most)
        if left <= CLOSED or not left < math.inf or (left <= TOLERANCE and left >= 0.25 * before):
            break
        if not factored_here:
            meet(links, rows, rows.error)
        take_free(links, rows, rows.met)
        move_posture(tree, q, rows.met, -1.0)
        if not factored_here and left * left <= 0.01 * CLOSED * before:
            left = left * left / before  # what this step leaves, below rounding
            break
        before = left
    if has_derivatives(left):  # the derivatives of q are moved onto the loops too, and the rows are those there
        for k in range(links.m):
            rows.error[k] -= sought(rows.error[k])
        meet(links, rows, rows.error)
        take_free(links, rows, rows.met)
        move_posture(tree, q, rows.met, -1.0)
        for j in range(n):
            rows.q[j] = q[j]
        place_rows(links, rows)
        factor_rows(links, rows, rows.error, most)
        factored_here = True
    if links.frames > 0:  # G q̇ is minus the rate with which frames that move open the rows
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        locate_rows(links, rows)
        factor_rows(links, rows, rows.rate, most)
        take_free(links, rows, rows.met)
        for j in range(n):
            v[j] -= rows.met[j]
        return left
    leave_free(links, rows, v)
    if not factored_here:  # that was where the loops were not closed yet
        for k in range(links.m):
            rows.rate[k] = dot(row_of(rows.G, k), v, n)
        meet(links, rows, rows.rate)
        take_free(links, rows, rows.met)
        for j in range(n):
            v[j] -= rows.met[j]
    return left


@entry_kernel
def closed_to(address: int, q: Array, v: Array) -> float:
    """Do `close_state` with the memory of the loops at an address."""
    links, rows = loops_at(address)
    return close_state(links, rows, q, v)


# What is asked.
TANGENT, NEAREST = range(2)


@entry_kernel
def along_path(address: int, what: int) -> int:
    """Answer for the loops at `q` of their memory, by its address; joints count alike.

    TANGENT     replace `tip`, rows of joint velocities, by what the loops leave of them
    NEAREST     replace `q` by the nearest posture that closes the loops
    """
    links, rows = loops_at(address)
    if what == TANGENT:
        for j in range(links.n):
            rows.v[j] = 0.0
        locate_rows(links, rows)
        factor_rows(links, rows, rows.error, links.m)
        links.known = links.rank
        for k in range(6):
            leave_free(links, rows, rows.tip[k])
    else:
        for j in range(links.n):
            rows.column[j], rows.still[j] = rows.q[j], 0.0
        close_state(links, rows, rows.column, rows.still)
        for j in range(links.n):
            rows.q[j] = rows.column[j]
    return 0


# A start that is open by no more than this, m or rad, or moves a loop by no more, m/s or rad/s, is meant to be closed.
START_OPEN, START_RATE = 1e-3, 1e-3
# As many postures a search for one that closes the loops starts from, and evaluations of each.
STARTS, EVALUATIONS = 8, 200


# A distance between points in one place has no direction: that it is open is said, and no division warns.
_undefined_passes = np.errstate(invalid="ignore", divide="ignore")


@_undefined_passes
def errors_at(robot: Robot, memory: LoopMemory, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the errors of the rows, m or rad, and their rates, at a state (q, q̇)."""
    memory.rows.q[:], memory.rows.v[:] = q, v
    interpreted(locate_rows)(memory.links, memory.rows)
    return memory.rows.error.copy(), memory.rows.rate.copy()


@_undefined_passes
def assembled(robot: Robot, memory: LoopMemory, q: Array) -> Array:
    """Return a posture within the limits that nearly closes the loops, from one (n,), rad (m), that is far from it.

    Newton's steps from far away go anywhere. Here the sum of the squares of the errors is minimised, each step within
    a region in which the rows have been found to hold (Branch, Coleman, Li, SIAM J. Sci. Comput. 21, 1999). Where that
    ends beside a closed posture, it starts again from postures around, the farther the more there have been.
    """
    from scipy.optimize import least_squares

    model, v = robot.model, np.zeros(robot.n)

    def errors(x: Array) -> Array:
        return errors_at(robot, memory, x, v)[0]

    def rows(x: Array) -> Array:
        errors_at(robot, memory, x, v)
        return memory.rows.G.copy()

    slopes: Any = "2-point" if model.balls else rows  # a rotation vector's rates are not those of its joint
    low, high = model.position_lower - AT_LIMIT, model.position_upper + AT_LIMIT
    random, found = np.random.default_rng(0), []
    for k in range(STARTS):
        around = q + random.normal(size=robot.n) * k / STARTS
        inside = np.clip(around, low + AT_LIMIT, high - AT_LIMIT)
        found.append(least_squares(errors, inside, slopes, (low, high), max_nfev=EVALUATIONS))
        if np.max(np.abs(found[-1].fun)) <= START_OPEN:
            break
    return np.array(min(found, key=lambda each: each.cost).x)


@_undefined_passes
def closed_start(robot: Robot, q: Array, v: Array, assemble: bool) -> tuple[Array, Array]:
    """Return the state nearest to (q, q̇) at which the loops are closed.

    Parameters
    ----------
    q, v : (n,) arrays
        Joint positions, rad (m), and velocities, rad/s (m/s).
    assemble : bool
        Whether a posture that is far from closing is to be closed; else it is refused.

    Raises
    ------
    ScenarioError
        If the posture or the velocity does not close the loops, or no posture near it does.
    """
    memory, names = loop_memory(robot), robot.model.joint_names
    error, rate = errors_at(robot, memory, q, v)
    far = assemble and float(np.max(np.abs(error))) > START_OPEN
    near, rates = assembled(robot, memory, q) if far else q.copy(), v.copy()
    written = memory.rows.memory, memory.links.memory, near, rates
    left = float(call_now(closed_to, written, memory.address, near, rates))
    turned = near - q
    low, high = robot.model.position_lower, robot.model.position_upper
    if not left <= TOLERANCE:
        raise ScenarioError(
            f"start.q: the loops are open, by {_worst(robot, error)}, and no posture near it closes them: the "
            f"remaining error is {left:.3g}; check the lengths of the links, and start nearer"
        )
    if not assemble and float(np.max(np.abs(error))) > START_OPEN:
        j = int(np.argmax(np.abs(turned)))
        nearest = with_quaternions(near, robot.model.joint_types)
        raise ScenarioError(
            f"start.q: the loops are open, by {_worst(robot, error)}; the nearest closed posture is "
            f"{[float(f'{x:.9g}') for x in nearest]} ({names[j]} turned by {turned[j]:.3g}): start there, or with "
            "start.assemble = true"
        )
    if out := [names[j] for j in range(robot.n) if not low[j] - START_OPEN <= near[j] <= high[j] + START_OPEN]:
        raise ScenarioError(
            f"start.q: in the nearest closed posture joint {out[0]} is outside its limits: start elsewhere"
        )
    if np.any(v) and float(np.max(np.abs(rate))) > START_RATE:  # at rest it starts with what moves it
        raise ScenarioError(
            f"start.v: the loops would open, by {_worst(robot, rate)} a second; the nearest velocity that they "
            f"allow is {[float(f'{x:.9g}') for x in rates]}"
        )
    return near, rates


def _worst(robot: Robot, error: Array) -> str:
    """Return the largest error, and the loop joint that has it, in words."""
    k = int(np.argmax(np.abs(error)))
    at = 0
    for loop in robot.model.loops:
        at += loop.rows
        if k < at:
            return f"{abs(error[k]):.4g} m (rad) at {loop.name!r}"
    raise AssertionError(k)
