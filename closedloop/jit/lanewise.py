"""Operations on all lanes of an array: compiled as a loop, interpreted as one operation of numpy.

    @kernel_inlined
    @lanewise
    def multiply(x, y, lanes, to):
        for r in range(lanes):
            to[r] = x[r] * y[r]

Interpreted, `range` is one slice of all lanes, so that the line is done once; the numbers are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])


def lanewise(function: F) -> F:
    """Mark a function whose loops over lanes do the same for each, without a branch."""
    function.__dict__["lanewise"] = True
    return function


def _larger(x: Any, y: Any) -> Any:
    return np.where(y > x, y, x)  # what Python's `max` and compiled code's return, of what is no number too


# What stands in an interpreted lanewise function in place of these names.
LANEWISE: dict[str, Any] = {"range": lambda lanes: (slice(0, lanes),), "max": _larger}
