"""The axes of a map: a key of the scenario, or a value, in its unit."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.figures.style import length_unit
from closedloop.scenario.units import typeset, with_unit

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes

# Larger numbers are not drawn: the edges of cells, and what lies between two of them, would overflow.
LARGEST = 1e150


class Scale:
    """A key along an axis: numbers, or words in the order in which they came."""

    def __init__(self, table: pa.Table, key: str) -> None:
        field = table.schema.field(key)
        given = table[key].to_pylist()
        units = (field.metadata or {}).get(b"units", b"").decode()
        self.label = with_unit(key, units)
        self.words: list[str] = []
        if str(field.type) in ("double", "int64"):
            self.at = np.array(given, dtype=np.float64)
            _refuse_large(key, self.at)
        else:
            self.words = list(dict.fromkeys(str(value) for value in given))
            self.at = np.array([self.words.index(str(value)) for value in given], dtype=np.float64)
        self.values = np.unique(self.at)
        low, high, middle = self.values[0], self.values[-1], float(np.median(self.values))
        # Even in its logarithm: the middle is nearer to the geometric mean than to the other.
        even = middle < 0.5 * (np.sqrt(max(low * high, 0.0)) + (low + high) / 2)
        self.log = bool(not self.words and low > 0.0 and high > 8.0 * low and even)

    def edges(self) -> Array:
        """Return the edges of cells about the values."""
        values = np.log(self.values) if self.log else self.values
        if values.size == 1:
            edges = np.array([values[0] - 0.5, values[0] + 0.5])
        else:
            middles = 0.5 * (values[1:] + values[:-1])
            edges = np.concatenate(
                [[1.5 * values[0] - 0.5 * values[1]], middles, [1.5 * values[-1] - 0.5 * values[-2]]]
            )
        return np.exp(edges) if self.log else edges

    def dress(self, axes: Axes, which: str) -> None:
        """Give the axis its scale, ticks and label."""
        axis = axes.xaxis if which == "x" else axes.yaxis
        getattr(axes, f"set_{which}label")(self.label)
        if self.log:
            getattr(axes, f"set_{which}scale")("log")
        if self.words:
            long = which == "x" and sum(map(len, self.words)) > 24
            turned: dict[str, Any] = {"rotation": 20, "ha": "right", "rotation_mode": "anchor"} if long else {}
            axis.set_ticks(range(len(self.words)), self.words, **turned)


def column_values(table: pa.Table, name: str) -> tuple[Array, str, str]:
    """Return a column's values, NaN where there is none, its meaning, and a unit in which it reads well."""
    field = table.schema.field(name)
    values = np.array(table[name].to_numpy(zero_copy_only=False), dtype=np.float64)
    _refuse_large(name, values)
    metadata = field.metadata or {}
    units, meaning = metadata.get(b"units", b"").decode(), metadata.get(b"meaning", name.encode()).decode()
    if units == "m" and np.any(np.isfinite(values)):
        factor, units = length_unit(float(np.nanmax(np.abs(values))))
        values = values * factor
    text = "\n".join(textwrap.wrap(meaning.partition(";")[0], 48))
    return values, text, typeset(units) if units not in ("", "1") else ""


def _refuse_large(name: str, values: Array) -> None:
    largest = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0))
    if largest > LARGEST:
        raise ScenarioError(f"{name}: has values of up to {largest:.3g}, and is drawn up to {LARGEST:g}")


def span(values: Array) -> tuple[float, float]:
    """Return the least and the largest number among the values."""
    found = values[np.isfinite(values)]
    return (float(found.min()), float(found.max())) if found.size else (0.0, 1.0)


def flat(low: float, high: float) -> bool:
    """Whether the variation is rounding: it would fill the panel, with ticks of many digits."""
    return high - low <= 1e-6 * max(abs(low), abs(high))
