"""What differs from episode to episode: declared ranges of keys of the scenario, and what is drawn from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError

# The key of a posture: what is drawn is added to each joint of the scenario's start.
POSTURE = "start.q"
LARGEST_SEED = 2**31


@dataclass(frozen=True)
@fields_checked
class Range:
    """A range from which a number is drawn for each episode.

    Parameters
    ----------
    low, high : float
        Ends, in the unit of the key; of a posture also a tuple each, one number for each joint.
    log : bool
        Whether the logarithm is uniformly distributed, instead of the number.
    """

    low: float | tuple[float, ...]
    high: float | tuple[float, ...]
    log: bool = False

    def __post_init__(self) -> None:
        low, high = np.asarray(self.low, dtype=np.float64), np.asarray(self.high, dtype=np.float64)
        ordered = low.shape == high.shape and bool(np.all((low > -math.inf) & (low <= high) & (high < math.inf)))
        if not ordered or (self.log and not np.all(low > 0.0)):
            above = ", and above 0 with log=True" if self.log else ""
            raise ScenarioError(f"range: {self.low!r} to {self.high!r}: must be two numbers, the smaller first{above}")

    def draw(self, random: np.random.Generator, size: int | None = None) -> Any:
        """Return a number, or an array of `size` numbers."""
        if not self.log:
            return random.uniform(self.low, self.high, size)
        return np.exp(random.uniform(np.log(self.low), np.log(self.high), size))


def as_ranges(given: Mapping[str, Any]) -> dict[str, Range]:
    """Return ranges by key, of which a pair of numbers is one as well."""
    ranges = {}
    for key, value in given.items():
        try:
            if not isinstance(value, Range):
                low, high = map(float, value)
                value = Range(low, high)
            if np.ndim(value.low) and key != POSTURE:
                raise ValueError
            ranges[key] = value
        except (TypeError, ValueError):
            raise ScenarioError(
                f"ranges[{key!r}] = {value!r}: must be (low, high), or closedloop.gym.Range(low, high, log=True)"
            ) from None
    return ranges


def drawn(
    ranges: Mapping[str, Range], home: Array, random: np.random.Generator, given: Mapping[str, Any],
    seeds: tuple[str, ...] = ("sensor.seed",),
) -> dict[str, Any]:  # fmt: skip
    """Return a value for each key, and for `seeds`, the keys of seeds.

    Parameters
    ----------
    ranges
        By dotted keys of the scenario.
    home : (nq,) array
        The posture that one of `POSTURE` is added to.
    random
        All keys are drawn in order, so that a value that is given changes no other.
    given : mapping
        Values that replace what is drawn; of other keys of the scenario too.
    """
    values: dict[str, Any] = {}
    for key, each in ranges.items():
        if key == POSTURE:
            wanted = np.shape(each.low) or home.shape
            if wanted != home.shape:
                raise ScenarioError(f"ranges[{key!r}]: has {wanted[0]} numbers: must be one, or {home.size}")
            values[key] = (home + each.draw(random, home.size)).tolist()
        else:
            values[key] = float(each.draw(random))
    for key in seeds:
        values[key] = int(random.integers(LARGEST_SEED))
    values.update(given)
    return values
