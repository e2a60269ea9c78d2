"""The arrays that numbers are in, as types; numbers in texts and ranges; results as plain values, as in JSON."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]


def evenly(count: int, most: int) -> IntArray:
    """Return so many of `count` numbers from 0 at most, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.int64))


def number_of(text: str) -> float | None:
    """Return the number that a text is, None if it is none."""
    try:
        return float(text)
    except ValueError:
        return None


def number_at(low: float, high: float, log: bool, share: float) -> float:
    """Return the number at a share of the way from `low` to `high`, which may be even in its logarithm."""
    return float(low * (high / low) ** share if log else low + (high - low) * share)


def share_of(low: float, high: float, log: bool, number: float) -> float:
    """Return the share of the way from `low` to `high` at which a number is."""
    return math.log(number / low) / math.log(high / low) if log else (number - low) / (high - low)


def plain(value: Any) -> Any:
    """Return mappings, lists, tuples, arrays and numbers as dicts, lists and numbers; what is not finite is None."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
