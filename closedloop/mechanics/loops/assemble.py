"""The start of a mechanism with loops: a posture and a velocity that close them."""

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.jit.interim import call_now
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import TOLERANCE, closed_to
from closedloop.mechanics.robot.pinocchio import Robot
from robot_models.coordinates import with_quaternions
from robot_models.model import AT_LIMIT

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

    `q`, `v`, (n,) arrays: joint positions, rad (m), and velocities, rad/s (m/s).
    `assemble`: whether a posture that is far from closing is to be closed; else it is refused.
    Raises ScenarioError if the posture or the velocity does not close the loops, or no posture near it does.
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
