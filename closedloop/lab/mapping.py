"""A map of the lab: a value of the run against two keys, a batch of runs that fills in while it is computed.

The runs are those of `closedloop.simulate_batch`, a few rows of the map at a time, coarse first: every eighth row and
column, then every fourth, and so on, so that the shape shows early.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.batch.simulate_batch import simulate_batch
from closedloop.lab.controls import Control
from closedloop.lab.history import Changes, with_change
from closedloop.report.measures import MEASURES
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

Array = NDArray[np.float64]

CELLS = 40  # on either side
BATCH = 80  # runs that are computed before the map is drawn again


@dataclass(frozen=True)
class Axis:
    """An axis of a map: a key's control, and the values (CELLS,) of its number in each cell.

    Where the key is a list with a number for each joint, the number is that of the control's own entry.
    """

    control: Control
    values: Array

    @classmethod
    def of(cls, control: Control, cells: int = CELLS) -> Axis:
        """Return the axis over the span of a slider: evenly spaced in what it shows."""
        shown = np.linspace(control.low, control.high, cells)
        return cls(control, 10.0**shown if control.form == "log" else shown)

    @property
    def shown(self) -> Array:
        """What the slider shows in each cell."""
        return np.log10(self.values) if self.control.form == "log" else self.values

    @property
    def label(self) -> str:
        """The key, with its unit."""
        control = self.control
        entry = "" if control.index is None else f" {control.label.rpartition(' ')[2]}"
        return f"{control.key}{entry}" + (f" [{control.unit}]" if control.unit else "")

    def value(self, cell: int) -> Any:
        """Return the key's value in a cell."""
        number = float(f"{self.values[cell]:.9g}")
        held, index = self.control.value, self.control.index
        return number if index is None else [*held[:index], number, *held[index + 1 :]]


@dataclass
class Map:
    """A map of a scenario.

    Attributes
    ----------
    scenario : Scenario
        What all runs have in common.
    x, y : Axis
        Of two keys that differ, or of two entries of one list.
    quantity : str
        A name of `closedloop.report.measures.MEASURES`.
    grid : (CELLS, CELLS) array
        The quantity, row by row along y; NaN where it is not known yet, or does not exist.
    reasons : dict
        (row, column) of a cell whose run was refused or stopped, and why.
    """

    scenario: Scenario
    x: Axis
    y: Axis
    quantity: str
    model: RobotModel | None = None
    grid: Array = field(init=False)
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.grid = np.full((self.y.values.size, self.x.values.size), np.nan)

    def changes(self, row: int, column: int, before: Changes | None = None) -> Changes:
        """Return the changes of the scenario that make the run of a cell, on top of others."""
        made = dict(before or {})
        for key, value in self._values(row, column).items():
            made = with_change(made, key, value)
        return made

    def _values(self, row: int, column: int) -> dict[str, Any]:
        values = {self.x.control.key: self.x.value(column), self.y.control.key: self.y.value(row)}
        if self.x.control.key == self.y.control.key and self.x.control.index is not None:  # two entries of one list
            values[self.x.control.key][self.x.control.index] = self.x.value(column)[self.x.control.index]
        return values

    def fill(self, stop: Callable[[], bool] = lambda: False, batch: int = BATCH) -> Iterator[int]:
        """Compute the map, and yield how many cells are done, again and again, until all are or `stop` says so."""
        order, done = coarse_first(*self.grid.shape), 0
        for begin in range(0, len(order), batch):
            if stop():
                return
            cells = order[begin : begin + batch]
            points = [self._values(*cell) for cell in cells]
            columns = {key: [point[key] for point in points] for key in points[0]}
            table = simulate_batch(self.scenario, columns, model=self.model)
            values, statuses = table[self.quantity].to_pylist(), table["status"].to_pylist()
            for cell, value, status, why in zip(cells, values, statuses, table["reason"].to_pylist(), strict=True):
                self.grid[cell] = np.nan if value is None or status != "done" else value
                if status != "done":
                    self.reasons[cell] = str(why)
            done += len(cells)
            yield done


def coarse_first(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return all cells of a grid, those of a coarse grid before those between them."""
    found: dict[tuple[int, int], None] = {}
    for step in (8, 4, 2, 1):
        found |= {(i, j): None for i in range(0, rows, step) for j in range(0, columns, step)}
    return list(found)


def filled(grid: Array) -> Array:
    """Return a grid whose unknown cells show the nearest known cell above and to the left, as long as it fills in."""
    shown = grid.copy()
    for step in (8, 4, 2):
        for i, j in np.argwhere(np.isnan(shown)):
            shown[i, j] = grid[i - i % step, j - j % step] if np.isnan(shown[i, j]) else shown[i, j]
    return shown


class Picture(NamedTuple):
    """A map as an image (height, width, 3), and where its cells are: left, right, top, bottom, as shares of it."""

    pixels: NDArray[np.uint8]
    area: tuple[float, float, float, float]


def picture(of: Map, complete: bool, chosen: tuple[int, int] | None = None) -> Picture:
    """Return the map as an image, with a ring around the chosen cell (row, column)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 3.6), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    grid = of.grid if complete else filled(of.grid)
    finite = grid[np.isfinite(grid)]
    norm: Normalize = Normalize()
    if finite.size and finite.min() > 0.0 and finite.max() > 100.0 * finite.min():
        norm = LogNorm()
    axes.set_facecolor("0.8")
    # Over what the sliders show, which is evenly spaced; the labels below are the values.
    x, y = of.x.shown, of.y.shown
    image = axes.pcolormesh(x, y, np.ma.masked_invalid(grid), norm=norm, cmap="cividis", shading="nearest")
    for axis, side in ((of.x, axes.xaxis), (of.y, axes.yaxis)):
        if axis.control.form == "log":
            side.set_major_formatter(lambda value, _: f"{10.0**value:.3g}")
        side.set_label_text(axis.label)
    if chosen is not None:
        at = x[chosen[1]], y[chosen[0]]
        axes.plot(*at, "o", markerfacecolor="none", markeredgecolor="#D55E00", markersize=9, markeredgewidth=2)
    bar = figure.colorbar(image, ax=axes, format=None if isinstance(norm, LogNorm) else "{x:.5g}")
    bar.set_label(MEASURES[of.quantity].units)
    axes.set_title(of.quantity, fontsize=9, loc="left")
    canvas.draw()  # type: ignore[no-untyped-call]
    box = axes.get_position()
    area = float(box.x0), float(box.x1), float(1.0 - box.y1), float(1.0 - box.y0)
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return Picture(pixels[:, :, :3].copy(), area)
