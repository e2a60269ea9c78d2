"""Any columns of a run over time, a panel each: for a figure whose caption says what it shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.errors import ScenarioError
from closedloop.figures.style import (
    MANY,
    STROKES,
    dress,
    explain_contact,
    legend_beside_title,
    length_unit,
    no_upper_labels,
    panels,
)
from closedloop.record.columns.derived import DERIVED, DerivedColumn
from closedloop.record.columns.record import SYMBOLS, Column
from closedloop.record.frame import part_labels
from closedloop.record.run import Run
from closedloop.scenario.messages import typeset
from closedloop.scenario.tables import labels_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def columns(run: Run, names: Sequence[str], ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw columns over time, a panel each; parts of a column, such as joints, are lines of its panel.

    Parameters
    ----------
    names : sequence of str
        Columns of the run, or their symbols, such as "f" and "e".
    ax
        See `closedloop.figures`.

    Raises
    ------
    ScenarioError
        If the run has no such column over time.
    """
    known: dict[str, Column | DerivedColumn] = {**run.specs, **DERIVED}
    over_time = [name for name, spec in known.items() if spec.dims[0] == "time" and name != "time"]
    for name in names:
        if SYMBOLS.get(name, name) not in over_time:
            symbols = [short for short, column in SYMBOLS.items() if column in over_time]
            raise ScenarioError(
                f"columns: {name!r}: the run has no such column over time; there are "
                f"{', '.join(symbols)}, {', '.join(over_time)}"
            )
    if not names:
        raise ScenarioError("columns: name at least one, such as f")
    figure, on = panels(len(names), 1.2 + 1.6 * len(names), ax)
    parts = part_labels(run.model.joint_names, run.model.coordinate_names, labels_of(run.scenario.contact or ()))
    for axes, name in zip(on, names, strict=True):
        column = SYMBOLS.get(name, name)
        values, units = np.asarray(run[column]).reshape(len(run), -1), run.units(column)
        if units == "m":
            factor, units = length_unit(float(np.nanmax(np.abs(values), initial=0.0)) or 1.0)
            values = factor * values
        dims = known[column].dims
        labels = parts.get(dims[1], tuple(map(str, range(1, values.shape[1] + 1)))) if len(dims) > 1 else (None,)
        for k, label in enumerate(labels):
            stroke = STROKES[k // len(MANY) % len(STROKES)]
            axes.plot(run.time, values[:, k], stroke, color=MANY[k % len(MANY)], label=label)
        axes.margins(y=0.1)
        unit = typeset(units) if units not in ("", "1") else ""
        text = name if name in SYMBOLS else name.replace("_", " ")
        dress(
            axes, run, "", f"{text} [{unit}]" if unit else text, label_marks=False, show_events=axes is on[-1],
        )  # fmt: skip
        if len(labels) > 1:
            legend_beside_title(axes)
    no_upper_labels(figure, on)
    explain_contact(figure, run)
    return figure
