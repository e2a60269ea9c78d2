"""Several laws, or tunings, or scenarios side by side, each run under the same variations.

The variations are the same for all, value by value and seed by seed, so that two laws meet the same friction, the same
surface and the same noise, and differences of a row are differences of the laws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError, needs
from closedloop.scenario.load import load_scenario
from closedloop.scenario.messages import with_unit
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import one_number, simulate_batch
from closedloop.simulation.engines.loops import COMPILED

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# So many values of a key that varies are named, the first and the last ones.
NAMED = 6
# Values of the summary that are compared, if none are named.
OF = ("rms_force_error", "peak_contact_force", "rms_path_error", "force_chatter", "max_joint_torque")


@dataclass(frozen=True, eq=False)
class Comparison:
    """The result of a comparison.

    `runs`: a row for each run: `scenario`, the keys that vary, status, both verdicts, and the values compared.
    `of`: the values compared.
    `units`: their units.
    """

    runs: pd.DataFrame
    of: tuple[str, ...]
    units: dict[str, str]

    @property
    def variations(self) -> str:
        """What varies and over which values, in words; "" if nothing does."""
        columns = list(self.runs.columns)
        keys = columns[columns.index("scenario") + 1 : columns.index("status")]
        return "; ".join(f"{key} = {_listed(list(dict.fromkeys(map(_in_words, self.runs[key]))))}" for key in keys)

    def table(self) -> pd.DataFrame:
        """Return a row for each scenario: how many runs it has, how many are good, the median and the worst values.

        Good is a run that is done with both verdicts good. The worst is the largest; a run without a value has none.
        The columns have the units of their values, such as ``"rms_force_error, worst [N]"``.
        """
        rows = {}
        for name, runs in self.runs.groupby("scenario", sort=False):
            good = (runs["status"] == "done") & (runs["verdict"] == "good") & (runs["control_verdict"] == "good")
            row: dict[str, Any] = {"runs": len(runs), "good": int(good.sum())}
            for each in self.of:
                values, unit = runs[each], self.units.get(each, "")
                row[with_unit(f"{each}, median", unit)] = values.median()
                row[with_unit(f"{each}, worst", unit)] = values.max()
            rows[name] = row
        import pandas as pd

        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("scenario")

    def figure(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Return a figure: for each value a point a run, the scenarios beside one another, and a bar at the median.

        With `ax` it is drawn on axes of the caller's, see `closedloop.figures`.
        """
        from closedloop.figures.style import MANY, panels, styled

        names = list(dict.fromkeys(self.runs["scenario"]))
        with styled():
            figure, on = panels(len(self.of), 1.0 + 1.3 * len(self.of), ax)
            for axes, each in zip(on, self.of, strict=True):
                for place, name in enumerate(names):
                    values = self.runs.loc[self.runs["scenario"] == name, each].to_numpy()
                    spread = place + np.linspace(-0.25, 0.25, values.size) if values.size > 1 else [place]
                    axes.plot(spread, values, "o", color=MANY[place % len(MANY)], markersize=3)
                    if np.any(np.isfinite(values)):
                        axes.plot([place - 0.3, place + 0.3], [np.nanmedian(values)] * 2, "k-", linewidth=1.6)
                unit = self.units.get(each, "")
                axes.set_ylabel(f"{each}\n[{unit}]" if unit else each, fontsize="small")
            words = [name.replace("_", "_\n").replace(":", ":\n") if len(names) > 3 else name for name in names]
            on[-1].set_xticks(range(len(names)), words)
            varied = wrap(self.variations, 70)
            on[0].set_title("\n".join(["each point a run; bars: medians", *varied]), fontsize="small")
        return figure


@arguments_checked()
def compare(
    scenarios: Mapping[str, Scenario] | Sequence[Scenario | str], over: Mapping[str, Sequence[Any]] | None = None, *,
    of: Sequence[str] = OF, engine: str = COMPILED, workers: int | None = None,
) -> Comparison:  # fmt: skip
    """Run several scenarios under the same variations and return their values side by side.

    Parameters
    ----------
    scenarios : mapping, or sequence
        Scenarios by the names that they are to have, or scenarios and names for `load_scenario`.
    over : mapping of str to sequence, optional
        Keys and their values, combined in all ways, such as ``{"friction.coefficient": [0.2, 0.4, 0.6], "sensor.seed":
        [0, 1, 2]}``; if left out, each scenario runs once, unchanged.
    of : sequence of str
        Values of `Run.summary`. If a value has a number for each joint, the largest magnitude is compared.
    engine, workers
        See `simulate_batch`.

    Raises
    ------
    ScenarioError
        If there are none, two have one name, a key is unknown to one of them, or there is no such value.
    """
    needs("pandas", "pyarrow")
    import pandas as pd

    named = _named(scenarios)
    tables = []
    units: dict[str, str] = {}
    for name, scenario in named.items():
        changes = dict(over) if over else {"time.duration": [scenario.time.duration]}
        try:
            table = simulate_batch(scenario, changes, grid=True, engine=engine, workers=workers)
        except ScenarioError as error:
            raise ScenarioError(f"compare: {error}") from None
        if lacking := [each for each in of if each not in table.column_names]:
            raise ScenarioError(
                f"compare: of = {', '.join(lacking)}: no value of a run's summary, such as rms_force_error"
            )
        units |= {each: ((table.schema.field(each).metadata or {}).get(b"units") or b"").decode() for each in of}
        frame = table.select([*(over or ()), "status", "verdict", "control_verdict", "reason", *of]).to_pandas()
        for each in of:
            frame[each] = [one_number(value) for value in table[each].to_pylist()]
        frame.insert(0, "scenario", name)
        tables.append(frame)
    return Comparison(pd.concat(tables, ignore_index=True), tuple(of), units)


def _in_words(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _listed(words: list[str]) -> str:
    """Return values one after the other; of many the first and the last ones, and how many there are."""
    if len(words) <= NAMED:
        return ", ".join(words)
    return f"{words[0]}, {words[1]} ... {words[-1]} ({len(words)} values)"


def _named(scenarios: Mapping[str, Scenario] | Sequence[Scenario | str]) -> dict[str, Scenario]:
    if isinstance(scenarios, Mapping):
        found = dict(scenarios)
    else:
        loaded = [load_scenario(each) if isinstance(each, str) else each for each in scenarios]
        found = {each.name: each for each in loaded}
        if len(found) < len(loaded):
            raise ScenarioError(
                "compare: two of the scenarios have one name; give a mapping, such as {'paper': ..., 'hybrid': ...}"
            )
    if not found:
        raise ScenarioError("compare: there are no scenarios to compare")
    return found
