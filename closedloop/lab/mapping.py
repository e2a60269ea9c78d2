"""A map of the lab: a value of the run against two keys, a batch of runs that fills in while it is computed.

The runs are those of `closedloop.simulate_batch`, some of the map at a time, coarse first: every eighth row and
column, then every fourth, and so on, so that the shape shows early. The page draws it (`web/map.js`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, one_line
from closedloop.lab.controls import Control
from closedloop.record.report.verdict import GOOD
from closedloop.scenario.messages import with_unit
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import simulate_batch
from robot_models import RobotModel

CELLS = 40  # on either side
BATCH = 160  # runs that are computed in one go; the first few, which show the shape, go by themselves
FIRST = 25


@dataclass(frozen=True)
class Axis:
    """An axis of a map: a key's control, and the values (cells,) of its number in each cell, from low to high.

    Where the key is a list with a number for each joint, the number is that of the control's own entry; `together`: the
    other entries change by the same factor.
    """

    control: Control
    values: Array
    together: bool = False

    @classmethod
    def of(cls, control: Control, cells: int = CELLS, together: bool = False) -> Axis:
        """Return the axis over the span of a slider: so many of its values, or all if they are fewer."""
        whole = np.round(np.linspace(0.0, control.high - control.low, cells) / control.step)
        shown = np.minimum(control.low + control.step * whole, control.high)
        own = (control.read(float(each)) for each in shown)
        values = [x if control.index is None else x[control.index] for x in own]
        return cls(control, np.unique(np.array(values, dtype=float)), together)

    @property
    def shown(self) -> Array:
        """What the slider shows in each cell."""
        return np.log10(self.values) if self.control.form == "log" else self.values

    @property
    def label(self) -> str:
        """The key, with its unit."""
        return with_unit(self.name, self.control.unit)

    @property
    def name(self) -> str:
        """The key, with the entry's name where it is a list."""
        if self.together:
            return f"{self.control.key}, all"
        entry = "" if self.control.index is None else f" {self.control.label.rpartition(' ')[2]}"
        return f"{self.control.key}{entry}"

    def at(self, share: float) -> Any:
        """Return the key's value at a place on the axis, 0 to 1: one that its slider can show."""
        place = min(max(share, 0.0), 1.0) * self.values.size - 0.5
        scale = np.log10 if self.control.form == "log" else np.asarray
        shown = np.interp(place, np.arange(self.values.size), scale(self.values))
        value = self.control.read(float(shown))
        return self.control.together(value) if self.together else value

    def value(self, cell: int) -> Any:
        """Return the key's value in a cell."""
        number, held, index = float(self.values[cell]), self.control.value, self.control.index
        if index is None:
            return number
        value = [*held[:index], number, *held[index + 1 :]]
        return self.control.together(value) if self.together else value


@dataclass
class Map:
    """A map of a scenario."""

    scenario: Scenario  # what all runs have in common
    # x, y: of two keys that differ, or of two entries of one list
    x: Axis
    y: Axis
    quantity: str  # a name of `closedloop.record.report.measures.MEASURES`
    model: RobotModel | None = None
    # (rows, columns): the quantity, row by row along y; NaN where it is not known yet, or does not exist
    grid: Array = field(init=False)
    # (rows, columns): 0 where numbers and control are good, 1 where not, 2 where the run was refused or stopped; NaN:
    # not known yet
    state: Array = field(init=False)
    # (row, column) of a cell whose run was refused or stopped, and why
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.grid = np.full((self.y.values.size, self.x.values.size), np.nan)
        self.state = np.full_like(self.grid, np.nan)

    def values(self, row: int, column: int) -> dict[str, Any]:
        """Return the values of both keys in a cell."""
        values = {self.x.control.key: self.x.value(column), self.y.control.key: self.y.value(row)}
        if self.x.control.key == self.y.control.key and self.x.control.index is not None:  # two entries of one list
            values[self.x.control.key][self.x.control.index] = self.x.value(column)[self.x.control.index]
        return values

    def _take(self, cells: list[tuple[int, int]], table: Any) -> None:
        """Take over the values of some cells' runs."""
        columns_read = (self.quantity, "status", "reason", "verdict", "control_verdict")
        for cell, value, status, why, *verdicts in zip(
            cells, *(table[name].to_pylist() for name in columns_read), strict=True
        ):
            self.grid[cell] = np.nan if value is None or status != "done" else value
            good = all(str(verdict).startswith(GOOD) for verdict in verdicts)
            self.state[cell] = 2.0 if status != "done" else 0.0 if good else 1.0
            if status != "done":
                self.reasons[cell] = str(why)

    def fill(self, stop: Callable[[], bool] = lambda: False, batch: int = BATCH) -> Iterator[int]:
        """Compute the map, and yield how many cells are done, again and again, until all are or `stop` says so."""
        order, done = coarse_first(*self.grid.shape), 0
        while done < len(order):
            if stop():
                return
            cells = order[done : done + (batch if done else min(batch, FIRST))]
            points = [self.values(*cell) for cell in cells]
            columns = {key: [point[key] for point in points] for key in points[0]}
            try:
                self._take(cells, simulate_batch(self.scenario, columns, model=self.model))
            except ScenarioError as error:  # none of these runs could be read
                for cell in cells:
                    self.state[cell], self.reasons[cell] = 2.0, one_line(str(error))
            done += len(cells)
            yield done


def coarse_first(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return all cells of a grid, those of a coarse grid before those between them."""
    found: dict[tuple[int, int], None] = {}
    for step in (8, 4, 2, 1):
        found |= {(i, j): None for i in range(0, rows, step) for j in range(0, columns, step)}
    return list(found)
