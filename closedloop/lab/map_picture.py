"""The picture of a map, drawn again and again while the map fills in.

The figure is made, laid out and drawn once without what changes; what a drawing then costs is the cells, and the
numbers beside the colour bar where these are others than before.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.lab.mapping import Axis, Map
from closedloop.record.report.measures import MEASURES

Array = NDArray[np.float64]

SIZE, DOTS = (4.4, 3.6), 110  # inches, and pixels of each
# A positive quantity that ranges over more than this factor has a logarithmic scale of colours.
DECADES = 100.0


class Picture(NamedTuple):
    """A map as an image (height, width, 3), and where its cells are: left, right, top, bottom, as shares of it."""

    pixels: NDArray[np.uint8]
    area: tuple[float, float, float, float]


class MapPicture:
    """Draws a map. All cells are equally large, whatever their values: where one is follows from its number alone.

    Parameters
    ----------
    of : Map
    """

    def __init__(self, of: Map) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._map = of
        self._figure = Figure(figsize=SIZE, dpi=DOTS)
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_axes((0.17, 0.14, 0.6, 0.76))
        self._axes.set_facecolor("0.8")
        self._axes.set_title(of.quantity, fontsize=9, loc="left")
        self._image = self._axes.imshow(of.grid, origin="lower", aspect="auto", cmap="cividis", interpolation="nearest")
        for axis, side in ((of.x, self._axes.xaxis), (of.y, self._axes.yaxis)):
            places, labels = ticks(axis)
            side.set_ticks(places, labels)
            side.set_label_text(axis.label)
        self._axes.tick_params(labelsize=8)
        self._ring: Any = self._axes.plot(
            [], [], "o", markerfacecolor="none", markeredgecolor="#D55E00", markersize=9, markeredgewidth=2
        )[0]
        self._bar = self._figure.colorbar(self._image, cax=self._figure.add_axes((0.8, 0.14, 0.035, 0.76)))
        self._bar.ax.tick_params(labelsize=8)
        self._bar.set_label(MEASURES[of.quantity].units)
        self._span: tuple[float, float] | None = None
        self._changing = (self._image, self._ring, *self._axes.spines.values(), self._bar.ax)
        for part in self._changing:
            part.set_animated(True)  # left out of what is drawn once
        self._canvas.draw()  # type: ignore[no-untyped-call]
        self._rest: Any = self._canvas.copy_from_bbox(self._figure.bbox)  # type: ignore[no-untyped-call]

    def draw(self, complete: bool, chosen: tuple[int, int] | None = None) -> Picture:
        """Return the map as it is now, with a ring around the chosen cell (row, column)."""
        grid = self._map.grid if complete else filled(self._map.grid)
        self._image.set_data(np.ma.masked_invalid(grid))
        self._ring.set_data(*(([], []) if chosen is None else ([chosen[1]], [chosen[0]])))
        if self._scale(grid[np.isfinite(grid)]):
            self._canvas.restore_region(self._rest)  # type: ignore[no-untyped-call]
            parts = self._changing
        else:
            parts = (self._axes.patch, *self._changing[:-1])
        for part in parts:
            self._axes.draw_artist(part)
        box = self._axes.get_position()
        area = float(box.x0), float(box.x1), float(1.0 - box.y1), float(1.0 - box.y0)
        pixels = np.asarray(self._canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        return Picture(pixels[:, :, :3].copy(), area)

    def _scale(self, finite: Array) -> bool:
        """Let the colours range over these values, and return whether they range over others than before."""
        from matplotlib.colors import LogNorm, Normalize
        from matplotlib.ticker import StrMethodFormatter

        span = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        if span == self._span:
            return False
        self._span = span
        decades = span[0] > 0.0 and span[1] > DECADES * span[0]
        self._image.set_norm(LogNorm(*span) if decades else Normalize(*span))
        if not decades:
            largest, range_ = max(map(abs, span)), span[1] - span[0]
            digits = 3 + (math.ceil(math.log10(largest / range_)) if range_ > 0.0 else 0)  # that tell its ends apart
            self._bar.formatter = StrMethodFormatter(f"{{x:.{min(max(digits, 4), 12)}g}}")
            self._bar.update_ticks()
        return True


def filled(grid: Array) -> Array:
    """Return a grid whose unknown cells show the nearest known cell above and to the left, as long as it fills in."""
    shown = grid.copy()
    for step in (8, 4, 2):
        i, j = np.nonzero(np.isnan(shown))
        shown[i, j] = grid[i - i % step, j - j % step]
    return shown


def ticks(axis: Axis) -> tuple[Array, list[str]]:
    """Return where round values are on an axis, in cells, and the values as text."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    low, high = axis.values[0], axis.values[-1]
    log = axis.control.form == "log"
    subs = (1.0,) if high > DECADES * low else (1.0, 2.0, 5.0)
    locator = LogLocator(subs=subs) if log else MaxNLocator(5)
    values = [float(value) for value in locator.tick_values(low, high) if low <= value <= high]
    scale = np.log10 if log else np.asarray
    places = np.interp(scale(np.array(values)), scale(axis.values), np.arange(axis.values.size))
    return places, [f"{value:.4g}" for value in values]
