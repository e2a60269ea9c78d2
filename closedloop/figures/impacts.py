"""The impacts of a run: closure rates, impulses, energy losses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.style import COLOURS, legend_beside_title, no_upper_labels, panels
from closedloop.loop.events.table import IMPACT, TOUCHDOWN
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Values that span more than this ratio are drawn on a logarithmic axis; what is below this share of the largest, or
# of the impulse of the largest force in a step, is rounding.
WIDE, ROUNDING = 20.0, 1e-12


class _Series(NamedTuple):
    """Values, one an impact; their name, and how they are drawn."""

    values: Array
    label: str
    marker: str
    colour: str


def hits(run: Run) -> NDArray[np.bool_]:
    """Return which events are meetings with the surface (M,).

    A touchdown without an impulse does not count, nor one whose impulse is the rounding of the forces times a step.
    """
    forces = run.link_forces if run.scenario.contact else run.contact_force
    least = ROUNDING * run.scenario.time.step * float(np.max(np.abs(forces), initial=0.0))
    return np.isin(run.event_kind, (IMPACT, TOUCHDOWN)) & (run.event_compression > least)


def has_impacts(run: Run) -> bool:
    """Tell whether the tip ever met the surface with an impulse."""
    return bool(np.any(hits(run)))


def impacts(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the closure rate before and after each impact, its impulses, and its energy loss, against time.

    For `ax` see `closedloop.figures`.
    """
    if not has_impacts(run):
        raise ValueError("the run has no impact to draw")
    hit = hits(run)
    time, cut, lost = run.event_time[hit], run.event_rate_cut[hit], run.event_energy_lost[hit]
    figure, (above, middle, below) = panels(3, 6.2, ax)
    rates = [
        _Series(-run.event_rate_before[hit], "before", "o", COLOURS[0]),
        _Series(run.event_rate_after[hit], "after", "^", COLOURS[1]),
        _Series(cut, "cut to rest", "x", "0.25"),
    ]
    rest = run.scenario.impact.rest_speed
    _draw(above, time, rates, beside=rest if np.any(cut > 0.0) else None)
    if np.any(cut > 0.0):
        above.axhline(rest, color="0.3", linestyle=":", linewidth=1)
        above.annotate(
            f"impact.rest_speed = {rest:g} m/s", (0.0, rest), xycoords=("axes fraction", "data"), xytext=(4, 3),
            textcoords="offset points", fontsize="small", color="0.25",
        )  # fmt: skip
    above.set(title=f"Closure rate at impacts ({run.model.name})", ylabel="|ė| [m/s]")
    impulses = [
        _Series(run.event_compression[hit], "compression", "o", COLOURS[0]),
        _Series(run.event_decompression[hit], "decompression", "^", COLOURS[1]),
        _Series(np.linalg.norm(run.event_tangential[hit], axis=1), "tangential", "x", COLOURS[2]),
    ]
    _draw(middle, time, impulses)
    middle.set(title="Impulse" if np.any(run.event_contact[hit] > 0) else "Impulse on the tip", ylabel="impulse [N s]")
    _draw(below, time, [_Series(lost, "", "o", COLOURS[0])])
    below.set(title=f"Kinetic energy lost, {np.sum(lost):.3g} J in total", ylabel="energy [J]")
    margin = max(0.04 * float(np.ptp(time)), 2.0 * run.scenario.time.step)
    for axes in (above, middle, below):
        axes.set(xlim=(float(time[0]) - margin, float(time[-1]) + margin), xlabel="time [s]")
    no_upper_labels(figure, (above, middle, below))
    return figure


def _draw(axes: Axes, time: Array, series: list[_Series], beside: float | None = None) -> None:
    """Draw what is positive of each series: zero has no place on a logarithmic axis; `beside` is to be seen too."""
    from matplotlib.ticker import NullFormatter

    least = ROUNDING * max(float(np.max(each.values)) for each in series)
    shown = [each for each in series if np.any(each.values > least)]
    for values, label, marker, colour in shown:
        axes.plot(
            time, np.where(values > least, values, np.nan), linestyle="none" if marker == "x" else ":", linewidth=0.7,
            marker=marker, markersize=5, markerfacecolor="none" if marker == "^" else colour, color=colour, label=label,
        )  # fmt: skip
    everything = np.concatenate([each.values[each.values > least] for each in shown] or [np.ones(1)])
    low, high = float(np.min(everything)), float(np.max(everything))
    if beside is not None:
        low, high = min(low, beside), max(high, beside)
    if high > WIDE * low:
        axes.set(yscale="log", ylim=(10 ** math.floor(math.log10(0.8 * low)), 10 ** math.ceil(math.log10(1.25 * high))))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(0.0, 1.2 * high)
    if any(each.label for each in shown):
        legend_beside_title(axes)
