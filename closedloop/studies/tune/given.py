"""What a tuning is given: the numbers that vary, their ranges, and the constraints."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.scenario.scenario import Scenario
from closedloop.studies.gradient.keys import Keys, indexed
from closedloop.studies.shares import number_at, share_of

_ENTRY = re.compile(r"(.+?)\[(\d+)\]")
_LIMIT = re.compile(r"\s*([\w@.]+)\s*(<=|>=)\s*(\S+)\s*")

# Shares of a range up to which a number is its end: no search comes nearer to an optimum than that.
AT_END = 1e-8


@dataclass(frozen=True)
class Varied:
    """One number that varies."""

    key: str  # dotted key
    entry: tuple[int, ...]  # which entry of a list; () of a single number
    # low, high: its range
    low: float
    high: float
    log: bool  # whether the range is even in its logarithm
    present: float  # what the scenario has

    @property
    def name(self) -> str:
        """Return the key with its entry."""
        return indexed(self.key, self.entry)

    def at(self, share: float) -> float:
        """Return the number at a share of the range, 0 to 1."""
        if not AT_END < share < 1.0 - AT_END:  # an end, or the rounding of a search that ends there
            return self.high if share > 0.5 else self.low
        return number_at(self.low, self.high, self.log, share)

    @property
    def share(self) -> float:
        """Return where in its range the scenario's number is, or the nearer end."""
        x = min(max(self.present, self.low), self.high)
        return share_of(self.low, self.high, self.log, x)


@dataclass(frozen=True)
class Limit:
    """A constraint on a value of the run."""

    name: str  # the value
    most: bool  # whether the limit is the most that it may be, else the least
    limit: float

    def violation(self, value: Array) -> Array:
        """Return by how much values violate it, as a share of the limit; negative where they meet it."""
        beyond = value - self.limit if self.most else self.limit - value
        return beyond / (abs(self.limit) or 1.0)

    def __str__(self) -> str:
        return f"{self.name} {'<=' if self.most else '>='} {self.limit:g}"


def varied(scenario: Scenario, vary: Mapping[str, Sequence[float]], log: Sequence[str] = ()) -> list[Varied]:
    """Return the numbers that vary.

    Parameters
    ----------
    vary : mapping of str to (low, high)
        Keys, of a number, a list, or an entry of a list such as ``law.kp[1]``.
    log : sequence of str
        Those whose ranges are even in their logarithms.

    Raises
    ------
    ScenarioError
        If a key is unknown or no real number, or a range has no two ends.
    """
    found: dict[str, Varied] = {}
    if not vary:
        raise ScenarioError(
            "tune: nothing varies; name at least one key and its range, such as {'law.kp': (100, 2000)}"
        )
    for name, ends in vary.items():
        match = _ENTRY.fullmatch(name)
        key, only = (match[1], (int(match[2]),)) if match else (name, None)
        present = Keys(scenario, [key]).values[key]
        try:
            low, high = map(float, ends)
        except (TypeError, ValueError):
            raise ScenarioError(
                f"tune: {name} = {ends!r}: must be the two ends of a range, such as (100, 2000)"
            ) from None
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ScenarioError(f"tune: {name} = ({low:g}, {high:g}): the range must be finite, the lower end first")
        if name in log and low <= 0.0:
            raise ScenarioError(f"tune: {name} = ({low:g}, {high:g}): a logarithmic range must be above 0")
        entries = list(np.ndindex(present.shape))
        if only is not None and only not in entries:
            raise ScenarioError(f"tune: {name}: no such entry; {key} has {present.size} of them, from 0")
        for entry in [only] if only is not None else entries:
            one = Varied(key, tuple(map(int, entry)), low, high, name in log, float(present[entry]))
            if one.name in found:
                raise ScenarioError(f"tune: {one.name}: varies twice")
            found[one.name] = one
    return list(found.values())


def limit_of(text: str) -> Limit:
    """Read a constraint from ``NAME<=NUMBER`` or ``NAME>=NUMBER``."""
    match = _LIMIT.fullmatch(text)
    try:
        number = float(match[3]) if match else math.nan
    except ValueError:
        number = math.nan
    if match is None or not math.isfinite(number):
        raise ScenarioError(f"subject to {text!r}: must be a value and its limit, such as 'peak_contact_force<=12'")
    return Limit(match[1], match[2] == "<=", number)


def with_numbers(scenario: Scenario, some: Sequence[Varied], numbers: Sequence[float]) -> dict[str, Any]:
    """Return overrides: the value of each key with these numbers in it."""
    keys = Keys(scenario, list(dict.fromkeys(each.key for each in some)))
    values = {key: value.copy() for key, value in keys.values.items()}
    for each, number in zip(some, numbers, strict=True):
        values[each.key][each.entry] = number
    return {key: value.tolist() for key, value in values.items()}
