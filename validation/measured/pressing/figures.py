"""Figures of touchdowns: the measured force under the simulated ones, the first instants and the swing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arrays import Array
from closedloop.figures.style import COLOURS, STROKES, new_figure, styled
from validation.measured.pressing.touchdowns import Touchdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPANS = (0.06, 2.0)  # s


@styled()
def touchdown(test: Touchdown, found: Mapping[str, tuple[Array, Array]], used: bool) -> Figure:
    """Return the figure of a test: `found` has time, s, and force, N, by the name of the engine."""
    figure = new_figure(3.2)
    axes = figure.subplots(1, len(SPANS))
    for axis, span in zip(axes, SPANS, strict=True):
        shown = (test.time > -0.05 * span) & (test.time < span)
        axis.plot(test.time[shown], test.measured[shown], color="0.6", lw=0.8, label="measured")
        for at, (name, (time, force)) in enumerate(found.items()):
            inside = time < span
            axis.plot(time[inside], force[inside], STROKES[at], color=COLOURS[at], lw=1.2, label=name)
        axis.axhline(test.force, color="0.3", lw=0.6)
        axis.set(xlabel="time from first contact, s", ylabel="force, N")
    axes[1].set_ylim(-5.0, float(np.clip(4.0 * test.force, 60.0, 300.0)))
    axes[0].set_title(f"{test.name}, {'used' if used else 'not used'} in the fit", loc="left", fontsize=9)
    axes[1].legend(fontsize=8)
    return figure
