"""Figures of tosses: errors over time, and the tosses that were simulated best and worst."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from closedloop.figures.style import COLOURS, STROKES, new_figure, styled
from validation.measured.cubes.comparing import Tried
from validation.measured.cubes.tosses import RATE, Toss, errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BAND = (25.0, 75.0)
SHOWN = 10


@styled()
def errors_over_time(tosses: Sequence[Toss], results: Mapping[str, Tried]) -> Figure:
    """Return the figure of the mean errors at each instant, with the middle half of the first engine's tosses."""
    figure = new_figure(3.4)
    axes = figure.subplots(1, 2)
    rows = min(len(toss.states) for toss in tosses)
    time = np.arange(rows) / RATE
    for k, (axis, unit) in enumerate(zip(axes, ("position error, % of the side", "rotation error, °"), strict=True)):
        for at, (name, one) in enumerate(results.items()):
            done = [(toss, path) for toss, path in zip(tosses, one.paths, strict=True) if len(path) >= rows]
            found = np.array([errors(toss, path)[k][:rows] for toss, path in done])
            if at == 0:
                axis.fill_between(
                    time, *np.percentile(found, BAND, axis=0), color=COLOURS[0], alpha=0.15, lw=0,
                    label=f"middle half of the tosses, {name}",
                )  # fmt: skip
            axis.plot(time, found.mean(axis=0), STROKES[at], color=COLOURS[at], label=f"mean, {name}")
        axis.set(xlabel="time, s", ylabel=unit, xlim=(0.0, time[-1]), ylim=(0.0, None))
    axes[0].legend(fontsize=8)
    return figure


@styled()
def best_and_worst(tosses: Sequence[Toss], one: Tried) -> Figure:
    """Return the figure of the ten best and the ten worst tosses: height of the centre, measured and simulated."""
    done = np.flatnonzero(~np.isnan(one.means[:, 0]))
    order = done[np.argsort(one.means[done, 0])]
    figure = new_figure(6.0)
    chosen = [*order[:SHOWN], *order[-SHOWN:]]
    for axis, i in zip(figure.subplots(4, 5, sharex=True, sharey=True).flat, chosen, strict=False):
        toss, path = tosses[i], one.paths[i]
        time = np.arange(len(path)) / RATE
        axis.plot(time, 100.0 * toss.states[:, 6], color="0.6", lw=2.5, label="measured")
        axis.plot(time, 100.0 * path[:, 2], color=COLOURS[0], label="simulated")
        axis.set_title(f"{toss.number}: {one.means[i, 0]:.1f} %, {one.means[i, 1]:.0f}°", fontsize=8)
    figure.supxlabel("time, s", fontsize=10)
    figure.supylabel("height of the centre, cm; ten best tosses above, ten worst below", fontsize=10)
    figure.axes[0].legend(fontsize=7)
    return figure
