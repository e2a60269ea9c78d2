"""The arrays that numbers are in, as types; and results as plain values, which JSON can hold."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]


def plain(value: Any) -> Any:
    """Return mappings, lists, tuples, arrays and numbers as dicts, lists and numbers; what is not finite is None."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
