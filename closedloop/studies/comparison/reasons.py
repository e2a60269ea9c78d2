"""Why joint positions and torques of a log might differ from those of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.studies.comparison.explain import Hypothesis

# Rows at which torques are explained.
ROWS = 3000


def of_joints(residual: Array, names: Sequence[str], v: Array, torque: Array) -> tuple[Array, list[Hypothesis]]:
    """Return the residual of positions as one column, and why it might not be zero."""
    N, n = residual.shape
    hypotheses = [
        Hypothesis("delay", "s", -v.reshape(-1, 1)),
        Hypothesis("offset", "rad (m)", _blocks(np.ones((N, n))), names),
        Hypothesis("give under the drives' torque", "rad/(N m)", _blocks(torque), names),
    ]
    return residual.reshape(-1), hypotheses


def of_torques(
    residual: Array,
    time: Array,
    names: Sequence[str],
    motion: tuple[Array, Array, Array],
    torque: Array,
    robot: Robot | None,
    normal: Array | None,
) -> tuple[Array, list[Hypothesis]]:
    """Return the residual of torques, at some rows, as one column, and why it might not be zero."""
    q, v, a = motion
    rows = np.unique(np.linspace(0, len(time) - 1, ROWS).astype(int))
    rate = np.gradient(torque, time, axis=0)
    slow = 1e-3 * np.abs(v).max(axis=0) + 1e-9
    hypotheses = [
        Hypothesis("offset", "N m (N)", _blocks(np.ones((len(rows), v.shape[1]))), names),
        Hypothesis("dry friction", "N m (N)", _blocks(np.tanh(v[rows] / slow)), names),
        Hypothesis("viscous friction", "N m s/rad", _blocks(v[rows]), names),
        Hypothesis("delay", "s", -rate[rows].reshape(-1, 1)),
        Hypothesis("gain beyond 1", "1", _blocks(torque[rows]), names),
    ]
    if robot is not None:
        gravity = np.asarray(robot.model.pinocchio_model().gravity.linear)
        payload, pressing = np.empty((2, len(rows), v.shape[1]))
        for k, row in enumerate(rows):
            terms = robot.terms(q[row], v[row])
            payload[k] = terms.jacobian.T @ (terms.jacobian @ a[row] + terms.drift - gravity)
            if normal is not None:
                pressing[k] = -terms.jacobian.T @ normal[row]
        hypotheses.append(Hypothesis("payload at the tip", "kg", payload.reshape(-1, 1)))
        if normal is not None:
            hypotheses.append(Hypothesis("force along the normal at the tip", "N", pressing.reshape(-1, 1)))
    return residual[rows].reshape(-1), hypotheses


def _blocks(columns: Array) -> Array:
    """Return (N n, n): for each joint a column that is zero in the rows of the others."""
    N, n = columns.shape
    spread = np.zeros((N, n, n))
    spread[:, np.arange(n), np.arange(n)] = columns
    return spread.reshape(N * n, n)
