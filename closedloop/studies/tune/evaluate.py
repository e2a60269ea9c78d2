"""The values and constraints of a tuning's points at once, and what a tuning is given.

What has been run is kept in a file, a line a point, so that a tuning that was interrupted goes on: the search is the
same for the same input, and takes from the file what is there. A line that is damaged is run again.

A run whose numbers mean nothing, since it shakes or its step does not resolve the loop, is none: what a step makes of a
ringing loop may look best.
"""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, number_at, number_of, share_of
from closedloop.base.errors import ClosedLoopError, OutputError, ScenarioError
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.record.report.verdict import SHAKEN
from closedloop.record.save import difference, identity_of
from closedloop.scenario.arm import robot_of
from closedloop.scenario.load import Variants
from closedloop.scenario.modes import unresolved_feedback
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import one_number, simulate_batch
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.simulation.prepare import load_model
from closedloop.studies.analysis.assembly import linearise
from closedloop.studies.gradient.differences import Keys, indexed

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

    `vary`: keys, of a number, a list, or an entry of a list such as ``law.kp[1]``.
    `log`: those whose ranges are even in their logarithms.
    Raises ScenarioError if a key is unknown or no real number, or a range has no two ends.
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


def _number(text: str) -> float:
    found = number_of(text)
    return math.nan if found is None else found


def limit_of(text: str) -> Limit:
    """Read a constraint from ``NAME<=NUMBER`` or ``NAME>=NUMBER``."""
    match = _LIMIT.fullmatch(text)
    number = _number(match[3]) if match else math.nan
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


AT = "@"
# Margins of the force loop at an instant, and how each is read.
MARGINS: dict[str, Callable[[Any], float]] = {
    "gain_margin": lambda margins: margins.decibels,
    "phase_margin": lambda margins: margins.phase,
    "delay_margin": lambda margins: margins.delay,
    "modulus_margin": lambda margins: margins.modulus,
}
# A margin without end, as that of a loop that no gain makes unstable, counts as this.
NO_END = 1e6
# Problems of a verdict with which the numbers of a run mean nothing.
MEANINGLESS = SHAKEN | {"gains", "resolution"}


class Runs:
    """Evaluates points of a tuning; see `closedloop.studies.tune.search.Evaluate`.

    `some`: what varies.
    `minimise`: values of the summary and their weights: their weighted sum is minimised.
    `over`: variations, every value of a key with every value of the others.
    `kept`: file of what has been run.
    `report`: gets the number of runs done.
    """

    def __init__(
        self, scenario: Scenario, some: Sequence[Varied], minimise: Mapping[str, float], limits: Sequence[Limit],
        over: Mapping[str, Sequence[Any]], kept: Path | None = None, report: Callable[[int], None] = lambda done: None,
        workers: int | None = None,
    ) -> None:  # fmt: skip
        self.scenario, self.some, self.minimise, self.limits = scenario, list(some), dict(minimise), list(limits)
        self.variations = [dict(zip(over, point, strict=True)) for point in itertools.product(*over.values())]
        self.done, self._report, self._workers = 0, report, workers
        self._kept: Path | None = None
        # problems of runs whose numbers mean nothing, and how often each was met
        self.refused: Counter[str] = Counter()
        self.names = list(dict.fromkeys([*self.minimise, *(limit.name for limit in self.limits)]))
        for name in self.names:
            if name not in MEASURES and name not in JOINT_MEASURES and name.partition(AT)[0] not in MARGINS:
                raise ScenarioError(
                    f"tune: {name}: no value of a run's summary, such as rms_force_error, and no margin at an instant, "
                    "such as modulus_margin@3"
                )
            margin, _, instant = name.partition(AT)
            if margin in MARGINS and not math.isfinite(_number(instant)):
                raise ScenarioError(f"tune: {name}: say at which instant the margin is taken, such as {margin}@3")
        lost = set(over) & {each.key for each in self.some}
        if lost:
            raise ScenarioError(f"tune: {', '.join(sorted(lost))}: cannot vary and be listed as variations at once")
        self._engine = PINOCCHIO if scenario.time.integrator in ADAPTIVE else COMPILED
        self._known: dict[str, list[list[float | None]]] = {}
        if kept is not None:
            self._read(kept)

    def numbers(self, x: Array) -> list[float]:
        """Return the numbers at shares of their ranges."""
        return [each.at(float(share)) for each, share in zip(self.some, x, strict=True)]

    def changes(self, x: Array) -> dict[str, Any]:
        """Return the overrides of a point."""
        return with_numbers(self.scenario, self.some, self.numbers(x))

    def values(self, points: Array) -> Array:
        """Return all values, (P, V, names), NaN where there is no run."""
        keys = [json.dumps([number.hex() for number in self.numbers(x)]) for x in points]
        todo = {key: x for key, x in zip(keys, points, strict=True) if key not in self._known}
        if todo:
            found = self._run([self.changes(x) for x in todo.values()])
            lines = []
            for key, rows in zip(todo, found, strict=True):
                self._known[key] = [[float(v) if math.isfinite(v) else None for v in row] for row in rows]
                lines.append(json.dumps([key, self._known[key]]))
            self._keep(lines)
        return np.array([[[math.nan if v is None else v for v in row] for row in self._known[key]] for key in keys])

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the values that are made least, (P, V), and the violations of the constraints, (P, V, K)."""
        found = self.values(points)
        at = {name: i for i, name in enumerate(self.names)}
        parts = [weight * found[..., at[name]] for name, weight in self.minimise.items()]
        violations = [limit.violation(found[..., at[limit.name]]) for limit in self.limits]
        shape = (*found.shape[:2], 0)
        return np.sum(parts, axis=0), np.stack(violations, axis=-1) if violations else np.zeros(shape)

    def as_it_is(self) -> Array:
        """Return the values of the scenario's own numbers, (V, names), be they in their ranges or not."""
        own = with_numbers(self.scenario, self.some, [each.present for each in self.some])
        return self._run([own], whatever=True)[0]

    def _run(self, changed: list[dict[str, Any]], whatever: bool = False) -> Array:
        """Run the scenario with each of these overrides under all variations, in one batch.

        Without `whatever` a run has no values if they mean nothing.
        """
        rows = [change | variation for change in changed for variation in self.variations]
        changes = {key: [row[key] for row in rows] for key in rows[0]}
        found = np.full((len(rows), len(self.names)), math.nan)
        plain = [i for i, name in enumerate(self.names) if AT not in name]
        if plain:
            table = simulate_batch(self.scenario, changes, engine=self._engine, workers=self._workers)
            ran = np.array([status == "done" for status in table.column("status").to_pylist()])
            if not whatever:
                said = [(verdict or "").split(", ") for verdict in table.column("verdict").to_pylist()]
                faults = [MEANINGLESS.intersection(words) for words in said]
                self.refused.update(name for names in faults for name in names)
                ran &= [not names for names in faults]
            for i in plain:
                column = [one_number(value) for value in table.column(self.names[i]).to_pylist()]
                found[:, i] = np.where(ran, column, math.nan)
        if len(plain) < len(self.names):
            variants = Variants(self.scenario, tuple(changes))
            for row, values in enumerate(rows):
                self._margins(variants, values, found[row], whatever)
        self.done += len(rows)
        self._report(self.done)
        return found.reshape(len(changed), len(self.variations), -1)

    def _margins(self, variants: Variants, values: Mapping[str, Any], row: Array, whatever: bool) -> None:
        """Write the margins of a run; a loop that is unstable has negative ones, one that is not resolved none."""
        loops: dict[str, Any] = {}
        for i, name in enumerate(self.names):
            margin, at, instant = name.partition(AT)
            if not at:
                continue
            try:
                if instant not in loops:
                    loops[instant] = linearise(variants.scenario(tuple(values.values())), float(instant))
                    scenario = loops[instant].scenario
                    if not whatever and unresolved_feedback(scenario, robot_of(scenario, load_model(scenario))):
                        self.refused["resolution"] += 1
                        loops[instant] = None
                loop = loops[instant]
                if loop is None:
                    continue
                found = MARGINS[margin](loop.margins())
                row[i] = min(found, NO_END) if loop.stable else -abs(min(found, NO_END))
            except ClosedLoopError:
                row[i] = math.nan

    def _read(self, kept: Path) -> None:
        """Take what has been run from the file, or begin one."""
        over = {key: [row[key] for row in self.variations] for key in (self.variations or [{}])[0]}
        depends = identity_of(self.scenario, over, self._engine) | {
            "vary": [(each.name, each.low, each.high, each.log) for each in self.some],
            "names": self.names, "over": self.variations,
        }  # fmt: skip
        mine = json.loads(json.dumps(depends, default=str))
        try:
            text = kept.read_text(encoding="utf-8") if kept.exists() else ""
        except (OSError, UnicodeDecodeError) as error:
            raise OutputError(f"{kept}: cannot be used: {error}") from None
        self._kept = kept
        if not text.strip():
            return self._keep([json.dumps({"tuning": mine})])
        first, *lines = text.splitlines()
        try:
            theirs = json.loads(first)["tuning"]
        except (ValueError, LookupError, TypeError):
            raise OutputError(f"{kept}: exists and holds no tuning; name another folder, or remove the file") from None
        if told := difference(theirs, mine):
            raise OutputError(f"{kept}: is of another tuning: {told}; name another folder, or remove the file")
        for line in lines:
            with suppress(ValueError, TypeError, RecursionError):  # damaged
                self._known |= dict([json.loads(line)])
        if not text.endswith("\n"):  # cut off where it was interrupted
            self._keep([""])
        return None

    def _keep(self, lines: list[str]) -> None:
        """Write lines at the end of the file, if there is one."""
        if self._kept is None:
            return
        try:
            with self._kept.open("a", encoding="utf-8") as file:
                file.write("\n".join(lines) + "\n")
        except OSError as error:
            raise OutputError(f"{self._kept}: cannot be written: {error.strerror or error}") from None
