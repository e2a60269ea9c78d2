"""The closure error, Figs. 6 and 7 of the paper, and the gap of a tip that is off the surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from closedloop.figures.dress import dress, explain_contact, mark_rounding, position_rounding
from closedloop.figures.style import COLOURS, length_unit, new_figure
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STABILISED = {
    "baumgarte": "with Baumgarte's stabiliser",
    "projection": "with projection",
    "both": "with Baumgarte's stabiliser and projection",
    "none": "without stabiliser",
}


def closure_error(run: Run) -> Figure:
    """Draw the closure error e against time (Fig. 6 with the stabiliser, Fig. 7 without).

    Off the surface e is a gap and no error, a million times larger than the error in contact: a run that has both gets
    a panel for each.
    """
    touching = run.mode != FREE
    how = _STABILISED[run.scenario.stabiliser.kind]
    soft = run.scenario.compliance.kind != "none"
    what = "Position of the tip relative to the soft surface; e < 0: inside" if soft else f"Closure error, {how}"
    both = bool(np.any(touching) and not np.all(touching))
    figure = new_figure(height=4.8 if both else 3.4)
    panels = figure.subplots(2 if both else 1, 1, sharex=True, squeeze=False)[:, 0]
    if np.all(touching):
        unit = _draw(panels[0], run, run.closure_error)
        dress(
            panels[0],
            run,
            what if soft or run.scenario.surface.kind != "plane" else f"Closure error e = n·r − d, {how}",
            f"e [{unit}]",
        )
    else:
        unit = _draw(panels[0], run, run.closure_error)
        dress(panels[0], run, "Gap e", f"e [{unit}]", show_events=not both)
    if both:
        panels[0].set_xlabel("")
        unit = _draw(panels[1], run, np.where(touching, run.closure_error, np.nan))
        dress(panels[1], run, f"In contact: {what[0].lower()}{what[1:]}", f"e [{unit}]", label_marks=False)
    explain_contact(figure, run)
    return figure


def _draw(axes: Axes, run: Run, error: NDArray[np.float64]) -> str:
    """Draw an error, m, which is NaN where there is none, and return the unit in which it is drawn."""
    axes.margins(y=0.15)
    size = float(np.nanmax(np.abs(error), initial=0.0))
    factor, unit = length_unit(size) if size > 0.0 else (1.0, "m")
    axes.plot(run.time, factor * error, color=COLOURS[1])
    mark_rounding(axes, size, position_rounding(run), factor)
    return unit
