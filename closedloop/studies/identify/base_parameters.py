"""Base parameters: the combinations of a robot's parameters that its torques depend on.

W has columns that are combinations of others whatever the motion is. A QR factorisation with pivoting of W at
random states tells how many are not; without pivoting, in the order of preference, it tells which ones: a column whose
diagonal entry of R vanishes is a combination of those before it, W₂ = W₁ β, and W χ = W₁ (χ₁ + β χ₂).
Source: M. Gautier, Numerical calculation of the base inertial parameters of robots, J. Robotic Systems 8 (1991)
485-506.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from closedloop.base.arrays import Array
from closedloop.studies.identify.regressor import Regressor

# Of columns of length one at random states, a diagonal entry of R: rounding gives 1e-14, true ones exceed 1e-5.
RANK = 1e-9
# A coefficient of a grouping below this is rounding.
ROUNDING = 1e-8


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The columns of W that are independent, and the contributions of the others to them."""

    kept: NDArray[np.int64]  # (b,): numbers of the columns that are independent
    grouping: Array  # (b, p): χ_base = grouping @ χ
    names: tuple[str, ...]  # "Izz_J2 + drive_inertia_J2 + 0.0506 m_J3", the parameters in each


def base_parameters(regressor: Regressor, seed: int = 0) -> BaseParameters:
    """Return the base parameters of a robot with given terms, whatever the log."""
    rng = np.random.default_rng(seed)
    n, p = regressor.n, len(regressor.names)
    count = max(60, 4 * p // n)
    q, v, a = rng.uniform(-np.pi, np.pi, (count, n)), rng.uniform(-2, 2, (count, n)), rng.uniform(-5, 5, (count, n))
    if regressor.terms.stribeck_speed is not None:  # whatever v_s is, its column is one of its own
        regressor = Regressor(regressor.robot, replace(regressor.terms, stribeck_speed=1.0))
    W = regressor.rows(q, v, a).reshape(-1, p)
    size = np.linalg.norm(W, axis=0)
    order = _preferred(regressor, np.flatnonzero(size > RANK))
    R = linalg.qr(W[:, order] / size[order], mode="r")[0][: len(order)]
    rank = int((np.abs(np.diag(linalg.qr(R, mode="r", pivoting=True)[0])) > RANK).sum())
    diagonal = np.abs(np.diag(R))
    # The diagonal of R without pivoting can stay away from zero where a column nearly depends: the rank decides.
    first = np.sort(np.argsort(-diagonal, kind="stable")[:rank])
    kept = order[first]
    second = np.setdiff1d(np.arange(len(order)), first)
    grouping = np.zeros((len(kept), p))
    grouping[np.arange(len(kept)), kept] = 1.0
    if len(second):
        beta = linalg.lstsq(R[:, first], R[:, second])[0]
        grouping[:, order[second]] = beta * size[order[second]] / size[kept][:, None]
    grouping[np.abs(grouping) < ROUNDING] = 0.0
    by_number = np.argsort(kept)
    kept, grouping = kept[by_number], grouping[by_number]
    return BaseParameters(
        kept, grouping, tuple(_name(row, k, regressor.names) for row, k in zip(grouping, kept, strict=True))
    )


def _preferred(regressor: Regressor, there: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the columns in the order in which they are kept: friction, moments of links, then masses and drives.

    The inertia of a drive comes last: where it acts as a link's moment of inertia does, it is part of that.
    """
    inertial = 10 * regressor.n
    names = regressor.names

    def rank(k: int) -> tuple[int, int]:
        if k >= inertial:
            return (2, k) if names[k].startswith("drive_inertia_") else (0, k)
        return (1, k)

    return np.array(sorted(map(int, there), key=rank))


def _name(row: Array, kept: int, names: tuple[str, ...]) -> str:
    terms = [names[kept]]
    for k in np.flatnonzero(row):
        if k != kept:
            size = "" if abs(abs(row[k]) - 1.0) < ROUNDING else f"{abs(row[k]):.4g} "
            terms.append(f"{'-' if row[k] < 0 else '+'} {size}{names[k]}")
    return " ".join(terms)
