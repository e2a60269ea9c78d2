"""Figures of touchdowns: the measured force under the simulated ones, and the map of how the loop at rest swings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.figures.style import COLOURS, STROKES, new_figure, styled
from validation.measured.pressing.judging import measured_figures
from validation.measured.pressing.machine import Touchdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPANS = (0.06, 2.0)  # s
GAINS, STIFFNESSES = np.geomspace(0.125, 2.0, 5), np.geomspace(0.005, 50.0, 5)  # of the map: 1, and of the fitted one


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


@styled()
def swing_map(
    values: Mapping[str, float], tests: Sequence[Touchdown],
    pole: Callable[[Mapping[str, float], Touchdown], Any],
) -> Figure:  # fmt: skip
    """Return the damping ratio of the pole that swings over gain scaling and stiffness, with the tests at theirs.

    The first test gives place and force. A test's damping ratio is its decay over its angular frequency; it stands at
    the stiffness that was fitted to its place. `pole` returns the pole of a machine and a test.
    """
    first = tests[0]
    key = f"stiffness_{first.place}"
    found = [
        [pole({**values, key: float(values[key] * k)}, replace(first, gain=float(g))) for k in STIFFNESSES]
        for g in GAINS
    ]
    damping = np.array([[np.nan if one is None else one.damping for one in row] for row in found])
    levels = np.linspace(0.0, 0.2, 11)
    figure = new_figure(3.6)
    axis = figure.subplots()
    drawn = axis.contourf(values[key] * STIFFNESSES, GAINS, damping, levels=levels, extend="both", cmap="viridis")
    figure.colorbar(drawn, label="damping ratio of the loop at rest")
    named: set[str] = set()
    for test in tests:
        swing = measured_figures(test)
        ratio = swing.decay / (2.0 * np.pi * swing.frequency)
        at = values[f"stiffness_{test.place}"], test.gain
        axis.scatter(*at, c=[ratio], cmap=drawn.cmap, vmin=levels[0], vmax=levels[-1], edgecolors="white")
        if test.place not in named:
            axis.annotate(test.place, at, xytext=(4, 5), textcoords="offset points", fontsize=7, color="white")
        named.add(test.place)
    axis.set(xscale="log", yscale="log", xlabel="stiffness of the surface at 1 mm, N/m", ylabel="gain scaling")
    axis.set_title(f"as at {first.place}, {first.force:g} N; circles: measured", loc="left", fontsize=9)
    return figure
