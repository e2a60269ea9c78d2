"""How much the tests that draw cases at random do.

The usual budget reaches every generator, every kind of case and every branch that a test asks for; the full one is many
more of the same, for a run by hand:

    CLOSEDLOOP_TESTS=full python -m pytest -m slow
"""

import os
from collections.abc import Iterable
from typing import Any, TypeVar

import pytest

T = TypeVar("T")

FULL = os.environ.get("CLOSEDLOOP_TESTS", "") == "full"


def budget(usual: T, full: T) -> T:
    """Return the first, or the second where the full budget is asked for."""
    return full if FULL else usual


def seeds(quick: int, usual: int) -> list[Any]:
    """Return 0, 1 ... as parameters of a test: `quick` for the quick suite, the rest of `usual` for the slow."""
    return [pytest.param(seed, marks=() if seed < quick else pytest.mark.slow) for seed in range(usual)]


def every(step: int, cases: Iterable[tuple[Any, ...]]) -> list[Any]:
    """Return cases as parameters of a test: each `step`-th for the quick suite, the others for the slow."""
    return [pytest.param(*case, marks=pytest.mark.slow if k % step else ()) for k, case in enumerate(cases)]
