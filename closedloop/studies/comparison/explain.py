"""What explains a residual: each hypothesis is a column or several, fitted by least squares, alone and one by one.

The share that a hypothesis explains is that of the residual's sum of squares. The interval of its coefficient takes
into account that neighbouring rows of a residual are alike: N is divided by the number of rows that are alike, from the
sum of its autocorrelations (Bartlett). Here are hypotheses for joints and for torques, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot

# A hypothesis is added while it explains this share of what is left, and so much of the whole.
ENOUGH, OF_ALL = 0.2, 0.02
MOST = 4
# A residual below this share of its signal is rounding, and of the integrator.
NOTHING = 1e-7
# A hypothesis that explains all but this share of what the best one does is as good.
AS_WELL = 0.01
# A hypothesis that says the same as those before it, up to this share of its size, adds nothing.
DEPENDENT = 1e-6
# Lags of the autocorrelation that are summed, over the number of rows.
LAGS = 0.1


@dataclass(frozen=True)
class Hypothesis:
    """A reason why two signals might differ."""

    # name, unit: of its coefficients
    name: str
    unit: str
    columns: Array  # (N, k): what the residual would be for coefficients of 1
    labels: Sequence[str] = ()  # of its columns, such as joints; empty for one


@dataclass(frozen=True)
class Reason:
    """A hypothesis that explains a residual."""

    name: str
    unit: str
    labels: tuple[str, ...]
    # value, half (k,): coefficients, fitted with those of all reasons, and half of their 95 % intervals
    value: Array
    half: Array
    alone: float  # share of the residual that it explains alone
    left: float  # share that is left with it and the reasons before it
    as_well: tuple[str, ...] = ()  # hypotheses that explain it equally well: the log does not distinguish them


def explain(residual: Array, hypotheses: Sequence[Hypothesis], size: float = 0.0) -> list[Reason]:
    """Return the hypotheses that explain a residual (N,), the one that explains most of what is left first.

    `size` is the RMS of the signal: a residual that is rounding beside it needs no reason.
    """
    whole = float(residual @ residual)
    if whole <= len(residual) * (NOTHING * size) ** 2:
        return []
    alone = {h.name: 1.0 - _left(residual, [h]) / whole for h in hypotheses}
    chosen: list[Hypothesis] = []
    lefts: list[float] = []
    others: list[tuple[str, ...]] = []
    left = whole
    while len(chosen) < MOST:
        rest = {h.name: _left(residual, [*chosen, h]) for h in hypotheses if h not in chosen}
        if not rest:
            break
        best = min(rest, key=rest.__getitem__)
        if left - rest[best] < max(ENOUGH * left, OF_ALL * whole):
            break
        gained, left = left - rest[best], rest[best]
        others.append(tuple(name for name in rest if name != best and rest[name] - left < AS_WELL * gained))
        chosen.append(next(h for h in hypotheses if h.name == best))
        lefts.append(left / whole)
    if not chosen:
        return []
    value, half = _fitted(residual, chosen)
    reasons, at = [], 0
    for h, still, equal in zip(chosen, lefts, others, strict=True):
        k = h.columns.shape[1]
        reasons.append(
            Reason(h.name, h.unit, tuple(h.labels), value[at : at + k], half[at : at + k], alone[h.name], still, equal)
        )
        at += k
    return reasons


def _fitted(residual: Array, hypotheses: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """Return all coefficients, and half of their 95 % intervals."""
    A, sizes, value, left = _solved(residual, hypotheses)
    variance = float(left @ left) / max(len(left) - A.shape[1], 1) * alike_rows(left)
    covariance = np.linalg.pinv(A.T @ A, rcond=DEPENDENT)
    return value / sizes, 1.96 * np.sqrt(variance * np.diag(covariance)) / sizes


def _solved(residual: Array, hypotheses: Sequence[Hypothesis]) -> tuple[Array, Array, Array, Array]:
    """Return columns of length one (N, k), their lengths, their coefficients (k,), and what they leave (N,)."""
    A = np.concatenate([h.columns for h in hypotheses], axis=1)
    sizes = np.linalg.norm(A, axis=0)
    sizes[sizes == 0.0] = 1.0
    value = np.linalg.lstsq(A / sizes, residual, rcond=DEPENDENT)[0]
    return A / sizes, sizes, value, residual - (A / sizes) @ value


def _left(residual: Array, hypotheses: Sequence[Hypothesis]) -> float:
    """Return the sum of squares that hypotheses leave."""
    left = _solved(residual, hypotheses)[3]
    return float(left @ left)


def alike_rows(x: Array) -> float:
    """Return how many neighbouring rows of a signal count as one: 1 if it is white."""
    centred = x - x.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return 1.0
    lags = max(1, min(int(LAGS * len(x)), len(x) - 1))
    spectrum = np.fft.rfft(centred, 2 * len(x))
    correlation = np.fft.irfft(spectrum * spectrum.conj())[: lags + 1] / power
    ends = np.flatnonzero(correlation <= 0.0)
    upto = int(ends[0]) if len(ends) else lags + 1
    return float(max(1.0, 1.0 + 2.0 * correlation[1:upto].sum()))


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
    residual: Array, time: Array, names: Sequence[str], motion: tuple[Array, Array, Array], torque: Array,
    robot: Robot | None, normal: Array | None,
) -> tuple[Array, list[Hypothesis]]:  # fmt: skip
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
