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
    """Return cases as parameters of a test: each `step`-th, and with the full budget the others, in the slow suite."""
    every = enumerate(cases)
    return [
        pytest.param(*case, marks=pytest.mark.slow if k % step else ()) for k, case in every if FULL or not k % step
    ]


def others(cases: Iterable[Any]) -> list[Any]:
    """Return cases, each a value or a tuple, as parameters of a test for the slow suite: a third of them, or all."""
    some = list(cases)[:: budget(3, 1)]
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in some]
