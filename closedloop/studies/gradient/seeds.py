"""How the numbers of a scenario enter a run: derivatives of its prepared memory.

Everything that a run reads is an array of floats once it is prepared (`closedloop.simulation.engines.dual_loop`):
gains and masses, the posture, the path. Most numbers of a scenario enter linearly, some through an inverse kinematics
or a projection. Central differences of the preparation alone, without a run, are exact for the former; for the latter
Richardson's extrapolation takes them to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError
from closedloop.simulation.engines.dual_loop import Prepared, prepared, structure
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import Cache, prepare
from closedloop.studies.gradient.differences import LEVELS, two_sided
from closedloop.studies.gradient.keys import Direction, Keys
from robot_models import RobotModel

# Two differences of steps that are a factor 2 apart agree to this share of themselves where a number enters linearly,
# or to this many roundings of what they are of: entries of one array may differ by orders of magnitude.
LINEAR, ROUNDINGS = 1e-9, 64.0


class Seeds(NamedTuple):
    """Derivatives of the prepared floats along one direction."""

    parts: list[Array | None]  # in the order of `Prepared.floats`; None where there is none
    linear: bool  # whether the number enters linearly
    # (Problem, Problem, float): the problems on both sides, and how far off along the direction each is
    beside: tuple[Problem, Problem, float]


def seeds_of(keys: Keys, direction: Direction, base: Prepared, model: RobotModel | None, cache: Cache) -> Seeds | None:
    """Return the derivatives along a direction; None if beside the scenario there is another sort of run, or none."""
    frame = structure(base)
    sides: list[list[list[Array]]] = [[], []]
    nearest: list[Problem] = [base.problem, base.problem]

    def sample(level: int) -> bool:
        for i, (side, sign) in enumerate(zip(sides, (-1.0, 1.0), strict=True)):
            try:
                scenario = keys.scenario_at({direction: sign * direction.step * 0.5**level})
                beside = prepared(prepare(scenario, model, cache))
            except ClosedLoopError:
                return False
            if structure(beside) != frame:
                return False
            side.append([array.copy() for array in beside.floats])
            nearest[i] = beside.problem
        return True

    def difference(level: int, i: int) -> Array:
        minus, plus = (side[level][i] for side in sides)
        same = (minus == plus) | np.isnan(minus) & np.isnan(plus)  # infinities too
        with np.errstate(invalid="ignore"):
            found: Array = np.where(same, 0.0, plus - minus) / (2.0 * direction.step * 0.5**level)
        return found

    if not (sample(0) and sample(1)):
        return None
    parts: list[Array | None] = []
    curved = []
    for i in range(len(base.floats)):
        wide, near = difference(0, i), difference(1, i)
        if not np.any(wide) and not np.any(near):
            parts.append(None)
            continue
        parts.append(wide)
        rounding = ROUNDINGS * np.finfo(float).eps * np.abs(np.nan_to_num(base.floats[i])) / direction.step
        if np.any(np.abs(wide - near) > LINEAR * np.abs(wide) + rounding):
            curved.append(i)
    if curved:
        if not all(sample(level) for level in range(2, LEVELS)):
            return None
        for i in curved:
            at = np.nan_to_num(base.floats[i], posinf=0.0, neginf=0.0).ravel()
            minus, plus = (np.nan_to_num([each[i].ravel() for each in side], posinf=0.0, neginf=0.0) for side in sides)
            parts[i] = two_sided(direction.step, at, minus, plus).value.reshape(base.floats[i].shape)
    return Seeds(parts, not curved, (nearest[0], nearest[1], direction.step * 0.5 ** (len(sides[0]) - 1)))
