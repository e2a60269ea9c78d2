"""Fig. 5: the contact force."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.figures.dress import contact_changes, dress, explain_contact, legend_beside_title
from closedloop.figures.instants import FORCE_STEPS, marks
from closedloop.figures.style import COLOURS, new_figure
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A force that varies by less than this share of itself, or of 1 N, is drawn flat and never enlarged.
FLAT = 1e-3
# Nor is a change below this share of all that the force does in the run.
MINOR = 0.02
# How much of the run is enlarged on either side of an instant, s, and in how many panels at most.
SHORT, LONG = 0.02, 0.12
MOST_PANELS = 3


def contact_force(run: Run) -> Figure:
    """Draw the contact force against time, with the commanded force and the transients enlarged (Fig. 5).

    Enlarged are the instants at which the law or the reference changes and contact or sticking begins or ends, if the
    force changes there; of more than three those at which it changes most. Impulses are no part of the force; see
    `impacts`.
    """
    moments = transients(run)
    figure = new_figure(height=5.0 if moments else 3.4)
    grid = figure.add_gridspec(2 if moments else 1, max(1, len(moments)), height_ratios=[1.3, 1][: 2 if moments else 1])
    whole = figure.add_subplot(grid[0, :])
    _draw_force(whole, run, slice(None))
    if contact_changes(run) or np.ptp(run.reference_force):
        dress(whole, run, "Contact force along the normal", "f [N]")
        legend_beside_title(whole)
    else:
        dress(whole, run, "Contact force of the surface on the tip, along its normal", "f [N]")
        whole.legend(loc="lower center", ncols=2)
    for k, (text, rows) in enumerate(moments):
        axes = figure.add_subplot(grid[1, k])
        _draw_force(axes, run, rows, marker=".", markersize=2.5)
        dress(axes, run, text, "f [N]" if k == 0 or len(moments) < MOST_PANELS else "", label_marks=False, rows=rows)
        if len(moments) == MOST_PANELS or (len(moments) > 1 and run.time[-1] >= 10.0):
            axes.locator_params(axis="x", nbins=4)  # room for the numbers
    explain_contact(figure, run)
    return figure


def transients(run: Run) -> list[tuple[str, slice]]:
    """Return what is to be enlarged, in order of time: what happens there, and the rows around it."""
    short, long = max(SHORT, 5 * run.scenario.time.step), max(LONG, 30 * run.scenario.time.step)
    # Where the motion changes, what counts is by how much the force leaves the commanded one.
    away = run.contact_force - run.reference_force
    wanted = [
        (t, text, short, long, run.contact_force if text == FORCE_STEPS else away)
        for t, text in marks(run)
        if run.time[0] < t < run.time[-1]
    ]
    for event in run.events:
        if event.kind in ("touchdown", "stick", "slip"):
            wanted.append((event.time, f"{event.kind} at {event.time:.4g} s", short, long, run.contact_force))
        elif event.kind == "liftoff":
            wanted.append((event.time, f"liftoff at {event.time:.4g} s", long, short, run.contact_force))
    least = MINOR * float(np.ptp(run.contact_force))
    found: list[tuple[float, float, str, slice]] = []
    for t, text, before, after, what in wanted:
        rows = slice(*np.searchsorted(run.time, (t - before, t + after)).tolist())
        change = float(np.ptp(what[rows])) if what[rows].size else 0.0
        if change > max(_flat(run.contact_force[rows]), least):
            found.append((-change, t, text, rows))
    chosen: list[tuple[float, str, slice]] = []
    for _, t, text, rows in sorted(found, key=lambda each: each[:2]):
        if len(chosen) < MOST_PANELS and all(abs(t - other) > long for other, _, _ in chosen):
            chosen.append((t, text, rows))
    return [(text, rows) for _, text, rows in sorted(chosen, key=lambda each: each[0])]


def _flat(force: NDArray[np.float64]) -> float:
    """Return the variation, N, up to which this force counts as constant."""
    return FLAT * max(abs(float(np.mean(force))), 1.0) if force.size else 0.0


def _draw_force(axes: Axes, run: Run, rows: slice, **style: Any) -> None:
    force = run.contact_force[rows]
    axes.plot(run.time[rows], force, color=COLOURS[0], label="contact force f", **style)
    if run.law == "scenario":
        wanted = run.reference_force
        dotted: dict[str, Any] = {"color": "0.3", "linestyle": ":", "linewidth": 1}
        if np.all(wanted == wanted[0]):
            axes.axhline(float(wanted[0]), label=f"commanded {wanted[0]:g} N", **dotted)
        else:
            axes.plot(run.time[rows], wanted[rows], label="commanded force", **dotted)
    # A force constant to rounding is a flat line, not a picture of its sixteenth digit.
    if np.ptp(force) < _flat(force):
        middle = float(np.mean(force))
        axes.set_ylim(middle - 1, middle + 1)
