"""Derivatives of whole runs by differences: of quantities of a run, with respect to numbers of its scenario.

Three steps h, h/2, h/4 on either side. Central differences have errors in h², h⁴ ..., one-sided ones in h, h², h³ ...;
Richardson's extrapolation removes all but the last. The estimate is by how much the last extrapolation changed the
result. It is that of the result before, so it is on the safe side.

A run is a smooth function of its scenario as long as the same events happen in the same order: they are located to
rounding. What is counted in rows is one as long as each event stays between the same two rows. So the steps are
shortened until both are so, and each quantity has the derivative of the table whose estimate of the error is smallest.
A direction in which other events happen on one side, however short the step, has one-sided derivatives alone.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, number_of
from closedloop.base.errors import ClosedLoopError, ScenarioError
from closedloop.loop.events.table import EVENT_COLUMNS
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.columns.derived import DERIVED, columns_by_contact
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.record.run import Run
from closedloop.scenario.load import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import table_type, tables_of
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import as_run, check_engine, run_loop
from robot_models import RobotModel

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
    flat = np.array(value, dtype=object).ravel().tolist()
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
    if any(
        column in some for some in (EVENT_COLUMNS, run.specs, DERIVED, columns_by_contact(run.scenario.contact or ()))
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


# What `difference` says of runs that differ in nothing but that an event is between other rows.
PAST_A_ROW = "an event moves past a row"


class Happening(NamedTuple):
    """An event, without its instant."""

    kind: str
    contact: int
    row: int  # the last row at or before it


@dataclass(frozen=True)
class Sample:
    """What is kept of a run."""

    values: Array  # (M,): all quantities, one after the other; empty if it could not be run to its end
    happened: tuple[Happening, ...]  # its events, in order
    instants: tuple[float, ...]  # their instants, s
    why: str = ""  # why it could not be run to its end; "" if it could
    # (M,): of the run itself: the largest entry of the quantity that each is of
    scale: Array = field(default_factory=lambda: np.empty(0))


def simulated(scenario: Scenario, model: RobotModel | None, cache: Cache | None = None) -> Run:
    """Run a scenario on the compiled engine, or on Pinocchio's if its integrator chooses its steps."""
    engine = PINOCCHIO if scenario.time.integrator in ADAPTIVE else COMPILED
    check_engine(scenario, engine, None)
    problem = prepare(scenario, model, cache)
    rows, events, failure, seconds = run_loop(problem, engine=engine)
    run = as_run(
        problem, rows, events, seconds, engine, law=("scenario", ""), with_states=True,
        stopped=str(failure) if failure else None,
    )  # fmt: skip
    if failure is not None:
        failure.run = run
        raise failure
    return run


def sample(run: Run, read: Callable[[Run], Array]) -> Sample:
    """Return what is kept of a run."""
    step = run.scenario.time.step
    events = run.events
    happened = tuple(Happening(event.kind, event.contact, int(event.time / step * (1.0 + 1e-15))) for event in events)
    return Sample(read(run), happened, tuple(event.time for event in events))


def samples(
    scenarios: Sequence[Callable[[], Scenario]], read: Callable[[Run], Array], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None = None,
) -> list[Sample]:  # fmt: skip
    """Run scenarios side by side; one that cannot be, or stops, says why."""
    if not scenarios:
        return []
    found: list[Sample | None] = [None] * len(scenarios)
    done, shared = Done(), Cache()

    def one(cache: Cache, i: int) -> None:
        try:
            found[i] = sample(simulated(scenarios[i](), model, cache), read)
        except ClosedLoopError as error:
            found[i] = Sample(np.empty(0), (), (), str(error).splitlines()[0])
        done.add()

    side_by_side(
        one, len(scenarios), threads_for(COMPILED, workers), lambda: Cache(shared=shared),
        lambda: report(done.count, len(scenarios)), done,
    )  # fmt: skip
    return [each for each in found if each is not None]


def difference(base: Sample, other: Sample) -> str:
    """Return what happens in one run and not in the other, in words; "" if nothing does, `PAST_A_ROW` see there."""
    if other.why:
        return other.why
    for i, (mine, its) in enumerate(zip(base.happened, other.happened, strict=False)):
        if mine[:2] != its[:2]:
            return (
                f"event {i}, {mine.kind} at {base.instants[i]:.6g} s, becomes {its.kind} at {other.instants[i]:.6g} s"
            )
    here, there = len(base.happened), len(other.happened)
    if here > there:
        return f"event {there}, {base.happened[there].kind} at {base.instants[there]:.6g} s, no longer happens"
    if there > here:
        return f"{other.happened[here].kind} at {other.instants[here]:.6g} s happens besides"
    if base.values.shape != other.values.shape:
        return "there are other values"
    rows = ([each.row for each in run.happened] for run in (base, other))
    return "" if next(rows) == next(rows) else PAST_A_ROW


# Steps of one table, each half of the one before.
LEVELS = 3
# Two one-sided derivatives that differ by more than this share of the larger are of a kink, if it is also more than
# `SURE` times what their errors explain.
KINK, SURE = 1e-3, 20.0
# What a difference cannot see of a run's values, as a share of them: rounding, and with events that their instants are
# located to some 1e-12 s.
ROUNDING, LOCATED = 16.0 * np.finfo(float).eps, 1e3 * np.finfo(float).eps


class Estimate(NamedTuple):
    """Derivatives of M quantities along one direction."""

    # value, error (M,): the derivative, and the estimate of its error; NaN where there is none
    value: Array
    error: Array
    # below, above (M,): one-sided ones; NaN on a side that there is not
    below: Array
    above: Array
    kink: NDArray[np.bool_]  # (M,): whether they differ


def two_sided(h: float, at: Array, minus: Array, plus: Array, scatter: Array | None = None) -> Estimate:
    """Return the derivatives from values at 0, (M,), and at −h, −h/2, −h/4 and h, h/2, h/4, (3, M).

    The values scatter by `scatter`, (M,), and by `ROUNDING` of themselves if it is left out.
    """
    steps = h * 0.5 ** np.arange(LEVELS)[:, None]
    value, error = _extrapolated((plus - minus) / (2.0 * steps), 2)
    scatter = ROUNDING * np.abs(at) if scatter is None else scatter
    below, off_below = one_sided(-h, at, minus, scatter)
    above, off_above = one_sided(h, at, plus, scatter)
    apart = np.abs(above - below)
    kink = (apart > SURE * (off_below + off_above)) & (apart > KINK * np.maximum(np.abs(above), np.abs(below)))
    return Estimate(value, error + floor(h, scatter), below, above, kink)


def one_sided(h: float, at: Array, beside: Array, scatter: Array) -> tuple[Array, Array]:
    """Return the derivatives on the side of h, which may be negative, and the estimates of their errors, (M,)."""
    steps = h * 0.5 ** np.arange(LEVELS)[:, None]
    value, error = _extrapolated((beside - at) / steps, 1)
    return value, error + 2.0 * floor(h, scatter)


def floor(h: float, scatter: Array) -> Array:
    """Return what the scatter of the values alone makes of the smallest difference."""
    return scatter / (abs(h) * 0.5 ** (LEVELS - 1))


def _extrapolated(differences: Array, order: int) -> tuple[Array, Array]:
    """Return the limit of (3, M) differences whose errors have the powers order, 2 order ... of the step."""
    table = differences
    for k in range(1, LEVELS):
        before = table[-1]
        factor = 2.0 ** (order * k)
        table = (factor * table[1:] - table[:-1]) / (factor - 1.0)
    return table[0], np.abs(table[0] - before)


DIFFERENCES = "central differences, Richardson"
# Tables of one direction, and by how much each has shorter steps than the one before. Of a run with events the first is
# left out: at its steps events move past rows.
TABLES, SHORTER = 4, 16.0
# An estimate is good enough at this share of the derivative, or of the quantity's largest entry over the key's size.
ENOUGH = 1e-8
# Integrators that choose their steps choose others beside, so a run scatters: by so large a share of the largest entry
# of a quantity, of which the first is rounding, and the second a multiple of the tolerance. (1e-12 was seen at a
# tolerance of 1e-13.)
SCATTER, OF_TOLERANCE = 5e3 * float(np.finfo(float).eps), 3.0
# Where an event is at a row, however short the steps, a quantity that is counted in rows jumps: it has no derivative if
# the estimate of the error is more than this share.
AT_A_ROW = 1e-3
# A one-sided derivative whose estimate of the error is more than this share has no bound.
SETTLES = 0.02


@dataclass
class Along:
    """What is known of one direction."""

    best: Estimate | None = None  # two-sided derivatives, the best of all tables, quantity by quantity
    at_a_row: Estimate | None = None  # the same of tables in which an event moves past a row
    # below, above (M,): one-sided derivatives and the estimates of their errors, where there are no two-sided ones
    below: tuple[Array, Array] | None = None
    above: tuple[Array, Array] | None = None
    why: str = ""  # why there are no two-sided ones
    count: int = 0  # number of quantities, M
    method: str = DIFFERENCES  # how they were found
    settled: bool = field(default=False, repr=False)  # whether they are known well enough
    methods: NDArray[np.str_] | None = None  # (M,): how each quantity was found, if not all in one way

    def part(self, some: slice) -> Estimate:
        """Return what is known of some of the quantities."""
        found, nothing = self.best, np.full(self.count, math.nan)
        if found is None:
            below, above = (side[0] if side else nothing for side in (self.below, self.above))
            found = Estimate(nothing, nothing, below, above, np.zeros(self.count, dtype=bool))
        value, error = (np.where(found.kink, math.nan, each) for each in found[:2])
        return Estimate(value[some], error[some], found.below[some], found.above[some], found.kink[some])

    def method_of(self, some: slice) -> str:
        """Return how the derivatives of some of the quantities, those of one output, were found."""
        return self.method if self.methods is None or not self.methods[some].size else str(self.methods[some][0])


def along(
    keys: Keys, directions: list[Direction], base: Sample, read: Callable[[Run], Array], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None = None,
) -> dict[Direction, Along]:  # fmt: skip
    """Return the derivatives of all quantities along each direction.

    `base`: the run itself.
    `read`: returns all quantities of a run, (M,).
    `report`: gets (runs done, runs in all) of the table at hand.
    """
    found = {direction: Along(count=base.values.size) for direction in directions}
    scatter = (LOCATED if base.happened else ROUNDING) * np.abs(base.values)
    if keys.scenario.time.integrator in ADAPTIVE and directions:
        scatter = max(SCATTER, OF_TOLERANCE * (prepare(keys.scenario, model).tolerance or 0.0)) * base.scale
    for table in range(1 if base.happened else 0, TABLES):
        todo = [direction for direction in directions if not found[direction].settled]
        if not todo:
            break
        steps = {d: d.step * SHORTER**-table for d in todo}
        points = [(d, sign * steps[d] * 0.5**level) for d in todo for sign in (-1.0, 1.0) for level in range(LEVELS)]
        ran = samples([partial(keys.scenario_at, {d: change}) for d, change in points], read, model, report, workers)
        for i, d in enumerate(todo):
            mine = ran[2 * LEVELS * i : 2 * LEVELS * (i + 1)]
            _take(found[d], steps[d], d.step, base, mine[:LEVELS], mine[LEVELS:], scatter)
    for d, known in found.items():
        # One-sided derivatives have no bound, as that of a square root at 0, if their differences grow.
        natural = base.scale / (100.0 * d.step)
        known.below, known.above = (
            side and (np.where(side[1] <= SETTLES * np.maximum(np.abs(side[0]), natural), side[0], np.nan), side[1])
            for side in (known.below, known.above)
        )
        if known.best is None and known.at_a_row is not None:
            estimate = known.at_a_row
            size = np.maximum(np.abs(estimate.value), np.abs(base.values) / (100.0 * d.step))
            jumps = estimate.error > AT_A_ROW * size
            known.best = estimate._replace(kink=estimate.kink | jumps)
    return found


def _take(
    known: Along, h: float, size: float, base: Sample, minus: list[Sample], plus: list[Sample], scatter: Array
) -> None:
    """Take a table of runs, whose values scatter by `scatter`, into what is known of a direction."""
    whys = []  # of each side what happens otherwise in the first such run
    for side in (minus, plus):
        said = [why for each in side if (why := difference(base, each))]
        whys.append(next((why for why in said if why != PAST_A_ROW), PAST_A_ROW if said else ""))
    below, above = (
        np.array([each.values for each in side]) if why in ("", PAST_A_ROW) else None
        for side, why in zip((minus, plus), whys, strict=True)
    )
    if below is not None and above is not None:
        estimate = two_sided(h, base.values, below, above, scatter)
        if PAST_A_ROW in whys:
            known.at_a_row = estimate if known.at_a_row is None else better(known.at_a_row, estimate)
            return
        known.best = estimate if known.best is None else better(known.best, estimate)
        enough = ENOUGH * np.maximum(np.abs(known.best.value), base.scale / (100.0 * size))
        # Where half of the error is rounding, that of shorter steps is larger.
        enough = np.maximum(enough, 2.0 * floor(h, scatter))
        known.settled = bool(np.all((known.best.error <= enough) & ~known.best.kink))
        return
    known.why = " and ".join(
        f"{side} it, {why}" for side, why in zip(("below", "above"), whys, strict=True) if why not in ("", PAST_A_ROW)
    )
    if below is not None:
        known.below = _better_side(known.below, one_sided(-h, base.values, below, scatter))
    if above is not None:
        known.above = _better_side(known.above, one_sided(h, base.values, above, scatter))


def better(one: Estimate, other: Estimate) -> Estimate:
    """Return the better of two estimates, quantity by quantity; the other is of shorter steps.

    A kink that shorter steps do not see is beside the point, not at it.
    """
    take = (other.error < one.error) | (one.kink & ~other.kink)
    return Estimate(*(np.where(take, new, old) for old, new in zip(one, other, strict=True)))


def _better_side(known: tuple[Array, Array] | None, new: tuple[Array, Array]) -> tuple[Array, Array]:
    if known is None:
        return new
    take = new[1] < known[1]
    return np.where(take, new[0], known[0]), np.where(take, new[1], known[1])
