"""The outcome of a tuning: the scenario that was found, what binds, and how sensitive it is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.plain import plain
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.units import key_unit
from closedloop.studies.tune.given import Limit, Varied
from closedloop.studies.tune.search import BINDS, Found

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Tuning:
    """The outcome of a tuning.

    Attributes
    ----------
    scenario : Scenario
        With the numbers found.
    before : Scenario
        As it was.
    vary : list of Varied
        What varied, with ranges.
    numbers : list of float
        The number found for each.
    minimised : mapping of str to float
        Values and their weights.
    limits : list of Limit
    variations : list of dict
    robust : str
        "worst" or "mean".
    value, value_before : float
        The minimised value, now and before the tuning; NaN if the run stops early.
    values, values_before : dict of str to (V,) array
        Each value under each variation.
    found : Found
        The outcome of the search, with its multipliers.
    sensitivity : dict of str to (float, float)
        By how much the value changes if a number is moved down and up by a tenth of its range; NaN beyond its end.
    runs : int
        Number of runs.
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
                lines.append(f"{limit} binds: {name} falls by {gain:.3g} for each 1 that it is moved")
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

    def figure(self) -> Figure:
        """Return a figure of the contact force before and now, of the scenario without variations."""
        from closedloop.figures.style import COLOURS, new_figure, styled
        from closedloop.studies.gradient.variants import simulated

        with styled():
            figure = new_figure(3.0)
            axes = figure.subplots()
            for scenario, label, colour in ((self.before, "before", COLOURS[1]), (self.scenario, "now", COLOURS[0])):
                run = simulated(scenario, None)
                axes.plot(run.time, run.contact_force, color=colour, label=label)
            axes.plot(run.time, run.reference_force, "k:", linewidth=1.0, label="wanted")
            axes.set(xlabel="time [s]", ylabel="contact force [N]")
            axes.legend()
        return figure


def _span(values: Array) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.6g}" if low == high or math.isnan(low) else f"{low:.6g} to {high:.6g}"
