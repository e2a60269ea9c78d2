"""How far two correct engines may be apart, and why.

A tolerance is a named quantity with its argument: which error dominates, and how large it can grow. Every relative
error is a difference over a scale that is stated with it.

The worst of the errors of many cases, and where it was found.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from validation.oracle.spatial import Array

EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Tolerance:
    """A bound on a relative error, and the argument for it."""

    name: str
    value: float
    argument: str


TERMS = Tolerance(
    "terms",
    1e-12,
    "sums of some hundred products a joint over at most a dozen joints round to 1000 ε = 2e-13; relative to the "
    "largest value of the quantity over the robot's states",
)

SOLVES = Tolerance(
    "solves",
    64 * EPS,
    "H and A carry a few ten ε of rounding, which Eq. 24 amplifies by its condition number and by how small a part of "
    "the tip's Jacobian A is; relative to what q̈ and f are summed from",
)
"""Per unit of `amplification`: 1.4e-14; at an ordinary pose the product is 1e-12 to 1e-11."""


def amplification(H: Array, J: Array, A: Array) -> float:
    """Return by how much Eq. 24 can magnify a relative error of its entries.

    The matrix is scaled first so that every joint and the closure count alike (D H D has ones on its diagonal and
    |A D| = 1), which takes the units out. What the scaling of A hides, that rounding in A is relative to all of Jᵣ and
    not to the part along n, comes back as (|Jᵣ D| / |A D|)².

    H, J, A: (n, n), (3, n), (n,), mass matrix, tip Jacobian and closure row
    """
    D = 1.0 / np.sqrt(np.diag(H))
    size = float(np.linalg.norm(A * D))
    return condition(H, A[None]) * (float(np.linalg.norm(J * D)) / size) ** 2 if size > 0.0 else np.inf


def condition(H: Array, A: Array) -> float:
    """Return by how much Eq. 24 with the rows A (m, n) can magnify a relative error of its entries, joints to scale."""
    D = 1.0 / np.sqrt(np.diag(H))
    rows = A * D
    size = float(np.linalg.norm(rows))
    if size == 0.0:
        return np.inf
    K = np.block([[H * np.outer(D, D), rows.T / size], [rows / size, np.zeros((len(A), len(A)))]])
    return float(np.linalg.cond(K))


C = TypeVar("C")
T = TypeVar("T")


def size(x: Array) -> float:
    """Return the largest magnitude in x; inf where something in it is not finite."""
    return float(np.max(np.abs(x))) if np.all(np.isfinite(x)) else math.inf


def worst_of(
    cases: Iterable[C], truth: Callable[[C], T], errors: Callable[[C, T], Mapping[str, float]]
) -> tuple[float, str]:
    """Return the worst error over cases, and which quantity of which case it is.

    truth: case -> what the oracle says
    errors: case, truth -> error of each quantity, by its name. What has no solution is off by inf.
    """
    worst, where = -1.0, "nothing was compared"
    for case in cases:
        true = truth(case)
        try:
            found = errors(case, true)
        except np.linalg.LinAlgError as error:
            return math.inf, f"{case}: {error}"
        name = max(found, key=lambda key: found[key])
        if found[name] > worst:
            worst, where = found[name], f"{name}, {case}"
    return (worst, where) if worst >= 0.0 else (math.inf, where)
