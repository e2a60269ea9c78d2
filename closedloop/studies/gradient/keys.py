"""The numbers of a scenario that derivatives are taken with respect to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import table_type, tables_of

# First step of the differences, as a share of the key's size; of a key that is 0, its size is taken for `SIZE_OF_ZERO`.
SHARE, SIZE_OF_ZERO = 1e-2, 0.1
# A run has a whole number of steps, and its rows are at multiples of the step.
OF_ROWS = ("time.step", "time.duration", "law.sample_period")


def indexed(name: str, at: tuple[int, ...]) -> str:
    """Return the name of one number, with its place if it is one of a list: law.kp[1]."""
    return name + "".join(f"[{i}]" for i in at)


@dataclass(frozen=True)
class Direction:
    """One number of the scenario."""

    key: str  # dotted key
    entry: tuple[int, ...]  # which entry of a list; () of a single number
    step: float  # the first step of differences along it

    def __str__(self) -> str:
        return indexed(self.key, self.entry)


class Keys:
    """The keys, their present values, and scenarios with other values."""

    def __init__(self, scenario: Scenario, names: Sequence[str]) -> None:
        if isinstance(names, str) or not names:
            raise ScenarioError("keys: must be a list of keys of the scenario, such as ['law.force', 'law.kp']")
        if len(set(names)) < len(names):
            raise ScenarioError(f"keys = {list(names)}: a key is named twice")
        self.scenario, self.names = scenario, tuple(names)
        data = scenario.model_dump(mode="python", exclude_none=True)
        self.values: dict[str, Array] = {name: _numbers(name, _value_at(scenario, data, name)) for name in self.names}
        self._variants = Variants(scenario, self.names)

    @property
    def directions(self) -> list[Direction]:
        """Return every single number, list after list."""
        found = []
        for name, value in self.values.items():
            size = float(np.max(np.abs(value))) or SIZE_OF_ZERO
            found += [Direction(name, tuple(map(int, entry)), SHARE * size) for entry in np.ndindex(value.shape)]
        return found

    def scenario_at(self, changes: dict[Direction, float]) -> Scenario:
        """Return the scenario with numbers added to some of its own."""
        values = {name: value.copy() for name, value in self.values.items()}
        for direction, change in changes.items():
            values[direction.key][direction.entry] += change
        return self._variants.scenario([value.tolist() for value in values.values()])


def _value_at(scenario: Scenario, data: dict[str, Any], name: str) -> Any:
    """Return what the scenario has at a dotted key; at one of several tables, as contact.*.friction, what all have."""
    section = name.partition(".")[0]
    if table_type(section) is None:
        return _within(scenario, data, name, name)
    tables, rest = tables_of(dict(data), name)
    values = [_within(scenario, table, rest, name) for table in tables]
    if any(value != values[0] for value in values):
        raise ScenarioError(f"keys: {name}: these have different values; take the derivative for each by its name")
    return values[0]


def _within(scenario: Scenario, value: Any, rest: str, name: str) -> Any:
    """Return what is at the rest of the key `name` in a section or a table."""
    for part in rest.split("."):
        if isinstance(value, dict) and part in value:
            value = value[part]
        elif isinstance(value, (list, tuple)) and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        else:
            # A key that there is, without a value, is refused by what it is; one that there is not, as ever.
            Variants(scenario, (name,)).scenario((1.0,))
            raise ScenarioError(f"keys: {name}: has no value in this scenario; give it one, then take the derivative")
    return value


def _numbers(name: str, value: Any) -> Array:
    """Return a value as an array of real numbers."""
    if name in OF_ROWS:
        raise ScenarioError(f"keys: {name}: has no derivative: it changes the number of rows of a run, or of samples")
    if isinstance(value, str):
        raise ScenarioError(f"keys: {name} = {value!r}: has no derivative: it is a word; give the number instead")
    flat = list(_leaves(value))
    if not flat or any(isinstance(each, (bool, int, str, dict)) or each is None for each in flat):
        what = "a whole number" if any(isinstance(each, int) for each in flat) else "no number"
        raise ScenarioError(f"keys: {name} = {value!r}: has no derivative: it is {what}, not a real one")
    try:
        array = np.array(value, dtype=float)
    except ValueError:
        raise ScenarioError(f"keys: {name}: has no derivative: its lists have different lengths") from None
    if not all(map(math.isfinite, array.ravel())):
        raise ScenarioError(f"keys: {name} = {value!r}: has no derivative: it is not finite")
    return array


def _leaves(value: Any) -> Any:
    """Return the single values of nested lists, one by one."""
    if isinstance(value, (list, tuple)):
        for each in value:
            yield from _leaves(each)
    else:
        yield value
