"""A tuning, and its outcome.

`cl.tune`: numbers of a scenario, gains above all, that minimise a value of its runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, plain
from closedloop.base.errors import ScenarioError
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.scenario.load import Variants
from closedloop.scenario.messages import key_unit
from closedloop.scenario.scenario import Scenario
from closedloop.studies.tune.evaluate import Limit, Runs, Varied, limit_of, varied
from closedloop.studies.tune.search import BINDS, MEAN, WORST, Found, Search

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
                effect = (
                    f"if its bound is relaxed by 1, {name} falls by {gain:.3g}"
                    if gain
                    else f"{name} does not depend on it"
                )
                lines.append(f"{limit} is active: {effect}")
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
