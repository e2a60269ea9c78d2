"""The worst of the errors of many cases, and where it was found."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import numpy as np

from validation.oracle.spatial import Array

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
