"""The mass matrix two ways: composite bodies, and a Newton–Euler pass a column.

The paper takes Featherstone's composite-rigid-body algorithm for H and calls the double recursion of Walker and Orin
(1982) easy to implement but computationally expensive. Both here by Pinocchio, so that nothing but the method differs.
"""

import numpy as np
import pinocchio as pin

from closedloop.simulation.engines.problem import Problem
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant


def composite_bodies(arm: str, problem: Problem) -> Contestant:
    """Return `pinocchio.crba`: H in one sweep over composite bodies."""
    model = problem.robot.model.pinocchio_model()
    data, q, steps = model.createData(), problem.q.copy(), problem.steps

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(steps):
            pin.crba(model, data, q)
        return None, np.triu(data.M).ravel()

    return Contestant("crba", arm, problem.robot.n, steps, lap, what="H by composite bodies")


def newton_euler_columns(arm: str, problem: Problem) -> Contestant:
    """Return H column by column from `pinocchio.rnea`: rest, no weight, and one unit acceleration a pass."""
    model = problem.robot.model.pinocchio_model().copy()
    model.gravity.linear = np.zeros(3)
    data, q, n, steps = model.createData(), problem.q.copy(), problem.robot.n, problem.steps
    rest, units, H = np.zeros(n), list(np.eye(n)), np.empty((n, n))

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(steps):
            for j in range(n):
                H[:, j] = pin.rnea(model, data, q, rest, units[j])
        return None, np.triu(H).ravel()

    theirs = composite_bodies(arm, problem).lap()[1]
    assert theirs is not None
    scale = float(np.max(np.abs(theirs)))
    return Contestant("rnea_columns", arm, n, steps, lap, theirs, 1e-12 * scale, "H by Newton–Euler columns")
