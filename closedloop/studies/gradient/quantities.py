"""What derivatives are taken of, quantities of a run, and with respect to what, numbers of its scenario."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from closedloop.base.arrays import Array, number_of
from closedloop.base.errors import ScenarioError
from closedloop.loop.events.table import EVENT_COLUMNS
from closedloop.record.columns.derived import DERIVED, columns_by_contact
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.record.run import Run
from closedloop.scenario.load import Variants
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


EVENTS, AT, END = "event_", "@", "end"
# Values of the summary that say how a run was computed: they are no function of the scenario.
NOT_OF_THE_SCENARIO = ("wall_seconds",)
# Times that are counted in rows: they are constant, but for jumps.
COUNTED = ("time_in_contact", "position_limit_left_at", "velocity_limit_exceeded_at", "effort_limit_exceeded_at")

# Summaries of runs that are still in use: several quantities are read of each.
_summaries: WeakKeyDictionary[Run, dict[str, Any]] = WeakKeyDictionary()


def _summary(run: Run) -> dict[str, Any]:
    """Return the summary of a run, made once."""
    found = _summaries.get(run)
    if found is None:
        found = _summaries[run] = run.summary()
    return found


@dataclass(frozen=True)
class Output:
    """One quantity of a run."""

    name: str  # as it was asked for
    read: Callable[[Run], Any]  # takes a run, and returns the quantity as a number or an array
    units: str
    column: str = ""  # the column to which it belongs; "" for a value of the summary

    def of(self, run: Run) -> Array:
        """Return the quantity of a run."""
        return np.asarray(self.read(run), dtype=float)


def output(name: str, run: Run, *, whole: bool = False) -> Output:
    """Return the quantity that a name asks for.

    `name`: a value of the summary, ``rms_force_error``; a column at the row nearest to an instant,
        ``contact_force@3.5``, ``q@end``; or a column of the table of events, ``event_time``.
    `whole`: whether columns are taken whole, and nothing else.
    """
    column, at, instant = name.partition(AT)
    if (
        column in EVENT_COLUMNS
        or column in run.specs
        or column in DERIVED
        or column in columns_by_contact(run.scenario.contact or ())
    ):
        if at or whole or column.startswith(EVENTS):
            return _column(name, column, instant if at else None, run, whole)
        raise ScenarioError(f"of: {name}: is a column; say at which instant, such as {name}@{END} or {name}@3.5")
    summary = _summary(run)
    if name in JOINT_MEASURES and not whole:
        value: Any = [joint[name] for joint in summary["joints"].values()]
    elif name in summary and not whole:
        value = summary[name]
    else:
        known = "a value of the summary, COLUMN@T or event_time"
        if whole:
            known = "a column, such as contact_force; values of the summary are those of cl.gradient"
        raise ScenarioError(f"of: {name}: no such quantity of this run; it must be {known}")
    if value is None or (isinstance(value, list) and any(each is None for each in value)):
        raise ScenarioError(
            f"of: {name}: is not defined in this run; force_settled_at needs a force that settles within it"
        )
    flat = value if isinstance(value, list) else [value]
    if name in NOT_OF_THE_SCENARIO or not all(isinstance(each, float) for each in flat):
        raise ScenarioError(f"of: {name} = {value!r}: has no derivative: it is no real number that the scenario gives")
    if name in COUNTED:
        raise ScenarioError(f"of: {name}: has no derivative: it is counted in rows; events are in event_time")
    measure = MEASURES.get(name) or JOINT_MEASURES.get(name)

    def read(made: Run) -> Any:
        found = _summary(made)
        if isinstance(value, list):
            return [_there(each[name]) for each in found["joints"].values()]
        return _there(found[name])

    return Output(name, read, measure.units if measure else "")


def _there(value: Any) -> Any:
    return math.nan if value is None else value


def _column(name: str, column: str, instant: str | None, run: Run, whole: bool) -> Output:
    """Return a column whole, of all events, or at the row nearest to an instant."""
    try:
        values: Any = np.asarray(getattr(run, column))
    except AttributeError:
        raise ScenarioError(f"of: {name}: this run has no such column") from None
    if values.dtype.kind != "f":
        raise ScenarioError(f"of: {name}: has no derivative: its values are no real numbers")
    units = run.units(column)
    if column.startswith(EVENTS):
        if whole:
            raise ScenarioError(f"of: {name}: is of the events, not of the rows; cl.gradient has its derivatives")
        if instant is not None:
            raise ScenarioError(f"of: {name}: events have instants of their own; ask for {column}")
        if not len(values):
            raise ScenarioError(f"of: {name}: this run has no events")
        return Output(name, lambda made: getattr(made, column), units, column)
    if instant is None:
        return Output(name, lambda made: getattr(made, column), units, column)
    row = -1
    if instant != END:
        t, end = number_of(instant), float(run.time[-1])
        if t is None or not 0.0 <= t <= end * (1.0 + 1e-12):
            raise ScenarioError(f"of: {name}: must be an instant of the run, {column}@0 to {column}@{end:g}, or @{END}")
        row = int(np.argmin(np.abs(run.time - t)))
    return Output(name, lambda made: getattr(made, column)[row], units, column)


def values_of(outputs: Sequence[Output], run: Run) -> Array:
    """Return all outputs of a run, one after the other."""
    return np.concatenate([each.of(run).ravel() for each in outputs])


def slices_of(outputs: Sequence[Output], run: Run) -> list[slice]:
    """Return where each output is among all of them."""
    ends = np.cumsum([0, *(each.of(run).size for each in outputs)]).tolist()
    return [slice(begin, end) for begin, end in pairwise(ends)]
