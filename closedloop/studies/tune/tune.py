"""A tuning, and its outcome; the values and constraints of its points at once.

`cl.tune`: numbers of a scenario, gains above all, that minimise a value of its runs.

What has been run is kept in a file, a line a point, so that a tuning that was interrupted goes on: the search is the
same for the same input, and takes from the file what is there. A line that is damaged is run again.

A run whose numbers mean nothing, since it shakes or its step does not resolve the loop, is none: what a step makes of a
ringing loop may look best.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, number_at, number_of, plain, share_of
from closedloop.base.errors import ClosedLoopError, OutputError, ScenarioError
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.record.report.verdict import SHAKEN
from closedloop.record.save import difference, identity_of
from closedloop.scenario.arm import robot_of
from closedloop.scenario.load import Variants
from closedloop.scenario.messages import key_unit
from closedloop.scenario.modes import unresolved_feedback
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import one_number, simulate_batch
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.simulation.prepare import load_model
from closedloop.studies.analysis.assembly import linearise
from closedloop.studies.gradient.differences import Keys, indexed
from closedloop.studies.tune.search import BINDS, MEAN, WORST, Found, Search

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        raise ScenarioError("tune: nothing varies; name a key and its range, such as {'law.kp': (100, 2000)}")
    for name, ends in vary.items():
        match = _ENTRY.fullmatch(name)
        key, only = (match[1], (int(match[2]),)) if match else (name, None)
        present = Keys(scenario, [key]).values[key]
        try:
            low, high = map(float, ends)
        except (TypeError, ValueError):
            must = "must be the two ends of a range, such as (100, 2000)"
            raise ScenarioError(f"tune: {name} = {ends!r}: {must}") from None
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
    number = number_of(match[3]) if match else None
    if match is None or number is None or not math.isfinite(number):
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
# Margins of the force loop at an instant, and what they are called there.
MARGINS = {"gain_margin": "decibels", "phase_margin": "phase", "delay_margin": "delay", "modulus_margin": "modulus"}
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
            at = number_of(instant)
            if margin in MARGINS and (at is None or not math.isfinite(at)):
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
                found = getattr(loop.margins(), MARGINS[margin])
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


@dataclass(frozen=True, eq=False)
class Tuning:
    """The outcome of a tuning.

    `scenario`: with the numbers found.
    `before`: as it was.
    `vary`: what varied, with ranges.
    `numbers`: the number found for each.
    `minimised`: values and their weights.
    `robust`: "worst" or "mean".
    `value`, `value_before`: the minimised value, now and before the tuning; NaN if the run stops early.
    `values`, `values_before`: each value under each variation.
    `found`: the outcome of the search, with its multipliers.
    `sensitivity`: by how much the value changes if a number is moved down and up by a tenth of its range; NaN beyond
        its end.
    `runs`: number of runs.
    """

    scenario: Scenario
    before: Scenario
    vary: list[Varied]
    numbers: list[float]
    minimised: dict[str, float]
    limits: list[Limit]
    variations: list[dict[str, Any]]
    robust: str
    value: float
    value_before: float
    values: dict[str, Array]
    values_before: dict[str, Array]
    found: Found
    sensitivity: dict[str, tuple[float, float]]
    runs: int

    @property
    def feasible(self) -> bool:
        """Whether all constraints are met under all variations."""
        return self.found.feasible

    @property
    def optimal(self) -> bool:
        """Whether no small change of the numbers improves the value."""
        return self.found.optimal

    def binds(self) -> list[str]:
        """Return the constraints and bounds that bind, in words, and the gain if each were moved."""
        lines = []
        name = " + ".join(self.minimised)
        for k, limit in enumerate(self.limits):
            worst = float(np.max(self.found.violations[:, k]))
            if worst > -BINDS:
                gain = float(self.found.multipliers[:, k].sum()) / (abs(limit.limit) or 1.0)
                effect = f"if its bound is relaxed by 1, {name} falls by {gain:.3g}"
                lines.append(f"{limit} is active: {effect if gain else f'{name} does not depend on it'}")
        for i, each in enumerate(self.vary):
            for end in (each.low, each.high):
                if self.numbers[i] == end:
                    lines.append(f"{each.name} is at the end of its range, {end:g}")
        return lines

    def unmet(self) -> list[str]:
        """Return the constraints that are not met, in words."""
        lines = []
        for k, limit in enumerate(self.limits):
            by = self.values[limit.name]
            worst = float(np.max(by) if limit.most else np.min(by))
            if float(np.max(self.found.violations[:, k])) > BINDS:
                lines.append(f"{limit} cannot be met: the nearest that was found is {worst:.6g}")
        return lines

    def lines(self) -> list[str]:
        """Return the report."""
        name = " + ".join(each if w == 1.0 else f"{w:g} {each}" for each, w in self.minimised.items())
        of = f", {self.robust} of {len(self.variations)} variations" if len(self.variations) > 1 else ""
        if not self.feasible:
            first = "no point meets the constraints; " + "; ".join(self.unmet())
        else:
            was = f"{self.value_before:.6g}" if math.isfinite(self.value_before) else "no run"
            first = f"{name}{of}: {was} before, {self.value:.6g} now"
        rows = [first, ""]
        if self.feasible and not self.optimal:
            rows[1:1] = [f"not an optimum: it would still fall by {100 * self.found.slope:.2g} % over a range; run on"]
        width = max(len(each.name) for each in self.vary)
        rows.append(f"{'':{width}}  {'before':>12}  {'now':>12}  {'range':^24}  10 % of the range down, up")
        for each, number in zip(self.vary, self.numbers, strict=True):
            span = f"{each.low:g} to {each.high:g}"
            unit = key_unit(each.key)
            moved = ", ".join(f"{x:+.2g}" if math.isfinite(x) else "-" for x in self.sensitivity[each.name])
            rows.append(
                f"{each.name:{width}}  {each.present:12.6g}  {number:12.6g}  {span:^24}  {moved}  {unit}".rstrip()
            )
        rows.append("")
        for value, by in self.values.items():
            measure = MEASURES.get(value) or JOINT_MEASURES.get(value)
            unit = f" {measure.units}" if measure else ""
            rows.append(f"{value}: {_span(self.values_before[value])} before, {_span(by)} now{unit}")
        if self.feasible and (binding := self.binds()):
            rows += ["", *binding]
        same = sum(abs(end - self.value) <= 1e-3 * abs(self.value) for end in self.found.ends)
        starts = f"; {same} of {len(self.found.ends)} starts ended at this value" if self.feasible else ""
        rows += ["", f"{self.runs} runs{starts}"]
        return rows

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers."""
        return plain({
            "feasible": self.feasible, "optimal": self.optimal, "minimised": self.minimised, "robust": self.robust,
            "value": self.value, "value_before": self.value_before,
            "numbers": {each.name: number for each, number in zip(self.vary, self.numbers, strict=True)},
            "before": {each.name: each.present for each in self.vary},
            "values": self.values, "values_before": self.values_before,
            "limits": [str(limit) for limit in self.limits], "binds": self.binds(), "unmet": self.unmet(),
            "variations": self.variations, "slope": self.found.slope, "sensitivity": self.sensitivity,
            "starts": self.found.ends, "runs": self.runs,
        })  # fmt: skip

    def figure(self, ax: Axes | None = None) -> Figure:
        """Return a figure of the contact force before and now, of the scenario without variations.

        With `ax` it is drawn on axes of the caller's, see `closedloop.figures`.
        """
        from closedloop.figures.style import COLOURS, legend_beside_title, panels, styled
        from closedloop.studies.gradient.differences import simulated

        with styled():
            figure, (axes,) = panels(1, 3.0, ax)
            for scenario, label, colour in ((self.before, "before", COLOURS[1]), (self.scenario, "now", COLOURS[0])):
                run = simulated(scenario, None)
                axes.plot(run.time, run.contact_force, color=colour, label=label)
            axes.plot(run.time, run.reference_force, "k:", linewidth=1.0, label="wanted")
            axes.set(xlabel="time [s]", ylabel="contact force [N]")
            legend_beside_title(axes)
        return figure


def _span(values: Array) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.6g}" if low == high or math.isnan(low) else f"{low:.6g} to {high:.6g}"


MOST_STARTS = 1000
# By which share of its range each number is moved to say how sensitive the optimum is.
MOVED = 0.1


@arguments_checked(vary="keys with two ends each, such as {'law.kd': (1, 10)}")
def tune(
    scenario: Scenario, vary: Mapping[str, Sequence[float]], minimise: str | Mapping[str, float] = "rms_force_error",
    subject_to: Sequence[str] = (), *, over: Mapping[str, Sequence[Any]] | None = None, robust: str = WORST,
    log: Sequence[str] = (), starts: int = 4, seed: int = 0, iterations: int = 60, kept: str | Path | None = None,
    progress: bool | Callable[[int], None] = False, workers: int | None = None,
    minimize: str | Mapping[str, float] | None = None,
) -> Tuning:  # fmt: skip
    """Find the numbers of a scenario that minimise a value of its runs.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`. The first search starts from its numbers.
    vary : mapping of str to (low, high)
        Keys and ranges, ``{"law.kp": (100, 2000), "law.kd[1]": (5, 100)}``; each entry of a list varies alone.
    minimise, minimize : str, or mapping of str to float
        A value of `Run.summary`, or values and weights, whose weighted sum is minimised. If a value has a number for
        each joint, the largest magnitude is taken.
    subject_to : sequence of str
        Constraints, ``["peak_contact_force<=12", "modulus_margin@3>=0.5"]``: values of the summary, or margins of the
        force loop at an instant (`linearise`): gain_margin (dB), phase_margin (°), delay_margin (s), modulus_margin.
    over : mapping of str to sequence, optional
        Variations, ``{"friction.coefficient": [0.2, 0.4, 0.6]}``, every value with every other. Constraints
        hold for all.
    robust : "worst" or "mean"
        Which value over the variations is minimised: the largest or the mean.
    log : sequence of str
        Keys whose ranges are searched evenly in their logarithms.
    starts : int
        Number of searches: one starts from the scenario's numbers, the others from the best of points drawn from the
        ranges.
    seed : int
        Seed of these points.
    iterations : int
        Largest number of iterations of each search.
    kept : path, optional
        File in which all runs are kept; an interrupted tuning continues from it.
    progress : bool or callable
        True shows the number of runs on standard error; a callable gets it.
    workers : int, optional
        Threads; the result is the same for any number.

    Returns
    -------
    Tuning
        If no point meets the constraints, `feasible` is False, and the point is the nearest that was found.

    Raises
    ------
    ScenarioError
        If a key, a value or a constraint is at fault, or nothing can be run in the ranges.
    OutputError
        If the file is of another tuning, such as that of another robot, or cannot be written.
    """
    if robust not in (WORST, MEAN):
        raise ScenarioError(f"tune: robust = {robust!r}: must be {WORST!r} or {MEAN!r}")
    if not 1 <= starts <= MOST_STARTS:
        raise ScenarioError(f"tune: starts = {starts}: must be a whole number from 1 to {MOST_STARTS}")
    if seed < 0:
        raise ScenarioError(f"tune: seed = {seed}: must be a whole number, 0 or more")
    minimise = minimise if minimize is None else minimize
    weights = {minimise: 1.0} if isinstance(minimise, str) else dict(minimise)
    if not weights:
        raise ScenarioError("tune: minimise: names no value, such as rms_force_error")
    some, limits = varied(scenario, vary, log), [limit_of(text) for text in subject_to]
    with ExitStack() as open_until_done:
        report = progress if callable(progress) else lambda done: None
        if progress is True:
            from closedloop.base.progress import counter

            report = open_until_done.enter_context(counter(f"tuning {scenario.name}"))
        runs = Runs(
            scenario, some, weights, limits, over or {}, Path(kept) if kept is not None else None, report, workers
        )  # fmt: skip
        search = Search(runs, len(some), robust, iterations)
        start = np.array([each.share for each in some])
        found = search.run(start, starts, seed)
        if not math.isfinite(found.value):
            Variants(scenario, tuple(runs.changes(start))).scenario(tuple(runs.changes(start).values()))
            met = f" ({', '.join(name for name, _ in runs.refused.most_common(2))})" if runs.refused else ""
            raise ScenarioError(f"tune: no run in these ranges could be made to its end and be good{met}; narrow them")
        return _tuning(scenario, runs, search, found, robust)


def _tuning(scenario: Scenario, runs: Runs, search: Search, found: Found, robust: str) -> Tuning:
    """Return the outcome of a search, with how sensitive it is."""
    moved = []
    for i in range(len(runs.some)):
        for sign in (-MOVED, MOVED):
            point = found.x.copy()
            point[i] += sign
            moved.append(point)
    inside = [point for point in moved if np.all((point >= 0.0) & (point <= 1.0))]
    known = {x.tobytes(): search.merit(seen[0]) for x, seen in zip(inside, search.look(np.array(inside)), strict=True)}
    change = [known.get(point.tobytes(), math.nan) - found.value for point in moved]
    sensitivity = {each.name: (change[2 * i], change[2 * i + 1]) for i, each in enumerate(runs.some)}
    changes = runs.changes(found.x)
    tuned = Variants(scenario, tuple(changes)).scenario(tuple(changes.values()))
    as_it_was = runs.as_it_is()
    now = runs.values(found.x[None])[0]
    weighted = sum(weight * as_it_was[:, runs.names.index(name)] for name, weight in runs.minimise.items())
    before = search.merit(np.asarray(weighted))
    return Tuning(
        tuned, scenario, runs.some, runs.numbers(found.x), runs.minimise, runs.limits, runs.variations, robust,
        found.value, before, {name: now[:, i] for i, name in enumerate(runs.names)},
        {name: as_it_was[:, i] for i, name in enumerate(runs.names)}, found, sensitivity, runs.done,
    )  # fmt: skip
