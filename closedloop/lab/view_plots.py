"""The plots of the lab: one uPlot for each panel of curves, with a cursor, marks of the events, and pinned runs."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.lab.curves import TITLES, Panel, Trace, panels, reduced, with_instants
from closedloop.record.run import Run

Array = NDArray[np.float64]

HEIGHT = 132  # px of a plot
CURSOR, MARK = "#888888", "#B8A500"
TICK = 0.15  # of the plot's height: the mark of an event
MOST_DIGITS = 16  # of the values beside a plot, commas and sign with them
# Events that are marked in a plot at most: more could not be told apart.
MOST_MARKS = 60
# What is pinned is drawn in these panels, its first trace.
WITH_PINS = ("force", "links", "closure", "tip", "friction")


class Plots:
    """The plots, in the container of the page that is open while this is made.

    Parameters
    ----------
    gui : viser.GuiApi
    """

    def __init__(self, gui: Any) -> None:
        self._lock = threading.RLock()
        self._handles: dict[str, Any] = {}
        self._panels: list[Panel] = []
        self._pins: list[tuple[str, str, list[Panel]]] = []
        self._instants: list[float] = []
        self._drawn: dict[str, tuple[Any, ...]] = {}
        self._cursor = 0.0
        nothing = np.zeros(2)
        for name, title in TITLES.items():
            self._handles[name] = gui.add_uplot(
                data=(np.array([0.0, 1.0]), nothing - 1.0, nothing - 1.0),
                series=({"label": "t"}, _cursor_series(), _mark_series()),
                height=HEIGHT, padding=(10, 14, 0, 0), scales={"x": {"time": False}, "share": {"range": (0.0, 1.0)}},
                cursor={"sync": {"key": "closedloop"}}, legend={"show": True},
                axes=_axes(title),
            )  # fmt: skip

    def show_run(self, run: Run, cursor: float) -> None:
        """Draw another run, with the cursor at an instant, s."""
        full = panels(run)
        begin, end = float(run.time[0]), float(run.time[-1])
        instants = [float(t) for t in run.event_time[:MOST_MARKS]]
        with self._lock:
            self._panels = [reduced(panel, begin, end) for panel in full]
            self._instants, self._cursor = instants, cursor
            self._draw()

    def show_pins(self, pins: Sequence[tuple[str, str, Run]]) -> None:
        """Draw pinned runs too: the name, the colour as #rrggbb, and the run of each."""
        with self._lock:
            self._pins = [
                (name, colour, [reduced(p, float(run.time[0]), float(run.time[-1])) for p in panels(run)])
                for name, colour, run in pins
            ]
            self._draw()

    def move_cursor(self, time: float) -> None:
        """Move the cursor to an instant, s."""
        with self._lock:
            self._cursor = time
            self._draw()

    def _draw(self) -> None:
        there = {panel.name for panel in self._panels}
        for name, handle in self._handles.items():
            if there and handle.visible != (name in there):
                handle.visible = name in there
        for panel in self._panels:
            shown = self._with_pins(panel)
            data, series = plot_data(shown, self._instants, self._cursor)
            handle, axes = self._handles[panel.name], _axes(panel.title, _longest(shown))
            look = axes, tuple((t.label, t.colour) for t in shown.traces)
            if self._drawn.get(panel.name) != look:
                handle.axes, handle.series = axes, series
                self._drawn[panel.name] = look
            handle.data = data

    def _with_pins(self, panel: Panel) -> Panel:
        if panel.name not in WITH_PINS or not self._pins:
            return panel
        more = []
        for name, colour, pinned in self._pins:
            other = next((p for p in pinned if p.name == panel.name), None)
            if other is None:  # a pinned run may have none, one without contacts of links for example
                continue
            factor = _UNITS.get(panel.unit, 1.0) / _UNITS.get(other.unit, 1.0)
            values = np.interp(panel.time, other.time, factor * other.main.values)
            more.append(Trace(name, colour, values))
        return Panel(panel.name, panel.unit, panel.time, (*more, *panel.traces))


# How many of a unit are a metre.
_UNITS = {"pm": 1e12, "nm": 1e9, "µm": 1e6, "mm": 1e3, "m": 1.0}


def _axes(title: str, digits: int = 0) -> tuple[dict[str, Any], ...]:
    """Return the axes of a plot whose values have so many characters at most; a diverging run has many."""
    size = 58 + 7 * max(0, digits - 6)
    return {"size": 32}, {"size": size, "label": title, "labelSize": 18, "labelFont": "11px sans-serif"}


def _longest(panel: Panel) -> int:
    """Return how many characters the values of a panel have, as uPlot writes large ones; more have no room at all."""
    ends = [float(end) for t in panel.traces for end in (np.nan_to_num(t.values).min(), np.nan_to_num(t.values).max())]
    return min(max((len(f"{end:,.0f}") for end in ends), default=0), MOST_DIGITS)


def plot_data(
    panel: Panel, instants: Sequence[float], cursor: float
) -> tuple[tuple[Array, ...], tuple[dict[str, Any], ...]]:
    """Return the columns of a uPlot, the times first, and its series: the traces, the cursor and the events.

    uPlot knows no line across and no number that is missing. So the cursor and the events are curves of their own
    scale, which shows 0 to 1: at -1, out of sight, but at their instants, each of which is there three times.
    """
    shown, _ = with_instants(panel, [t for t in (*instants, cursor) for _ in range(3)])
    line, events = np.full(shown.time.size, -1.0), np.full(shown.time.size, -1.0)
    for curve, height, at in ((line, 1.0, [cursor]), (events, TICK, instants)):
        curve[np.searchsorted(shown.time, [t for t in at if shown.time[0] <= t <= shown.time[-1]]) + 1] = height
    columns = (shown.time, *(np.nan_to_num(t.values) for t in shown.traces), line, events)
    series = ({"label": "t [s]"}, *map(_series, shown.traces), _cursor_series(), _mark_series())
    return columns, series


def _series(trace: Trace) -> dict[str, Any]:
    look = {"label": trace.label, "stroke": trace.colour, "width": 1.2, "points": {"show": False}}
    return look | ({"dash": (5, 4)} if trace.limit else {})


def _cursor_series() -> dict[str, Any]:
    return {"label": "now", "stroke": CURSOR, "width": 1.0, "points": {"show": False}, "scale": "share"}


def _mark_series() -> dict[str, Any]:
    return {"label": "event", "stroke": MARK, "width": 2.0, "points": {"show": False}, "scale": "share"}
