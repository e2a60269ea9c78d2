"""Maps of a sweep, and the axes of a map.

One key gives a curve, two a map: cells for a grid, dots for random draws. Runs that failed are marked.
"""

from __future__ import annotations

import difflib
import io
import math
import stat
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import OutputError, ScenarioError
from closedloop.base.files import kind_of, reason_of, write_whole
from closedloop.figures.style import COLOURS, WIDE, length_unit, page_width, styled
from closedloop.figures.style import panels as panels_on
from closedloop.scenario.messages import typeset, with_unit
from closedloop.studies.sweep.store import pieces, unreadable_is_none

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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

    def dress(self, axes: Axes, which: str, cells: bool = False) -> None:
        """Give the axis its scale, ticks and label; ticks stand at values that cells are about."""
        from matplotlib.ticker import FixedLocator

        axis = axes.xaxis if which == "x" else axes.yaxis
        getattr(axes, f"set_{which}label")(self.label)
        if self.log:
            getattr(axes, f"set_{which}scale")("log")
        if self.words:
            long = which == "x" and sum(map(len, self.words)) > 24
            turned: dict[str, Any] = {"rotation": 20, "ha": "right", "rotation_mode": "anchor"} if long else {}
            axis.set_ticks(range(len(self.words)), self.words, **turned)
        elif cells and not self.log:
            axis.set_major_locator(FixedLocator(self.values.tolist(), nbins=7))


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


FIGURES = ("min_contact_force", "peak_contact_force", "rms_force_error", "max_abs_closure_error")
# Inches from which two maps stand beside one another.
TWO_ABREAST = 6.0
# Values of a third key that are drawn as curves of their own.
MOST_CURVES = 6


@overload
def sweep_plot(
    table: str | Path | pa.Table, of: Sequence[str] | None = None, *, x: str | None = None, y: str | None = None,
    out: str | Path | None = None, ax: None = None,
) -> Path: ...  # fmt: skip
@overload
def sweep_plot(
    table: str | Path | pa.Table, of: Sequence[str] | None = None, *, x: str | None = None, y: str | None = None,
    out: None = None, ax: Axes | Sequence[Axes],
) -> Figure: ...  # fmt: skip
@arguments_checked()
def sweep_plot(
    table: str | Path | pa.Table, of: Sequence[str] | None = None, *, x: str | None = None, y: str | None = None,
    out: str | Path | None = None, ax: Axes | Sequence[Axes] | None = None,
) -> Path | Figure:  # fmt: skip
    """Draw values of a sweep and return the path of the picture; with `ax`, draw on axes, and return their figure.

    Parameters
    ----------
    table : path or pyarrow.Table
        The Parquet file of a sweep, or what `simulate_batch` returned.
    of : sequence of str, optional
        Columns to draw, a panel each; four common ones if left out.
    x, y : str, optional
        Keys along the axes; the first two that changed if left out.
    out : path, optional
        The picture, .png, .svg or .pdf; if left out, beside the table's file under its name with .png.
    ax : Axes or sequence of Axes, optional
        One for the first panel, or one for each. No file is written then.

    Raises
    ------
    ScenarioError
        If there is no such table, column or key, or as many axes are given as are no number of panels.
    OutputError
        If the picture cannot be written.
    """
    if ax is not None and out is not None:
        raise ScenarioError("out: cannot be given with ax: save the figure that the axes are of")
    if ax is None and out is None:
        if not isinstance(table, (str, Path)) or not Path(table).name:
            raise ScenarioError("out: name the picture's file, such as out='maps.png'")
        out = Path(table).with_suffix(".png")
    found = _read(Path(table)) if isinstance(table, (str, Path)) else table
    with styled():
        figure, picture = draw_maps(found, of, x, y, ax), io.BytesIO()
        if out is None:
            return figure
        try:
            figure.savefig(picture, format=Path(out).suffix.removeprefix(".") or None)
            Path(out).parent.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise OutputError(f"--out {out}: cannot be written: {reason_of(error)}") from None
    return write_whole(out, picture.getvalue())


def draw_maps(
    table: pa.Table, of: Sequence[str] | None = None, x: str | None = None, y: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:  # fmt: skip
    """Return the figure of `sweep_plot`, to be put anywhere, or drawn on given axes."""
    from matplotlib.figure import Figure

    names = table.column_names
    keys = names[1 : names.index("status")]
    for name in (x, y):
        if name is not None and name not in keys:
            raise ScenarioError(f"{name}: is not a key of this sweep; {_meant(name, keys)}")
    numbers = [
        f.name for f in table.schema if str(f.type) in ("double", "int64") and f.name not in keys and f.name != "run"
    ]
    wanted = list(of or [name for name in FIGURES if name in numbers])
    for name in wanted:
        if name not in numbers:
            raise ScenarioError(f"{name}: is not a value of this sweep; {_meant(name, numbers)}")
    if not keys or not numbers or not wanted:
        raise ScenarioError("the table has no key that changes, or no value to draw")
    if table.num_rows == 0:
        raise ScenarioError("the table has no rows")
    if x is not None and x == y:
        raise ScenarioError(f"{x}: is given for both axes")
    for name in keys:
        if table[name].null_count:
            raise ScenarioError(f"{name}: has no value in some rows: this is not the table of a sweep")
    first = x or next((key for key in keys if key != y), keys[0])
    if y is not None and first == y:
        raise ScenarioError(f"{y}: is the only key of this sweep; --y needs another")
    second = y or (next((key for key in keys if key != first), None) if x is None or y is not None else None)

    def draw(figure: Figure, panels: Sequence[Axes]) -> Figure:
        for panel, name in zip(panels, wanted, strict=False):
            if second is None:
                _curves(panel, table, first, name, [key for key in keys if key != first])
            else:
                _map(figure, panel, table, first, second, name)
        return figure

    if ax is not None:
        try:
            figure, given = panels_on(len(wanted), 3.4, ax)
        except ValueError as error:
            raise ScenarioError(str(error)) from None
        return draw(figure, given)
    width = page_width()
    columns = 1 if len(wanted) == 1 or width < TWO_ABREAST else 2
    rows = -(-len(wanted) // columns)
    size = (0.6 + 4.6 * columns, 3.3 * rows + 0.4)
    if width != WIDE:  # as wide as is asked for, and as high as text of the same size needs
        size = width, size[1] * math.sqrt(width / size[0])
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    draw(figure, panels)
    for panel in panels[len(wanted) :]:
        panel.remove()
    statuses, others = table["status"].to_pylist(), [key for key in keys if key not in (first, second)]
    failed = {status: statuses.count(status) for status in ("stopped", "refused")}
    text = f"{len(statuses)} runs" + "".join(f", {many} {status}" for status, many in failed.items() if many)
    if failed["refused"]:
        text += " (hatched or crossed)"
    if others and (second is not None or len(others) > 1):
        text += f"; {', '.join(others)} {'varies' if len(others) == 1 else 'vary'} too"
    figure.suptitle(text, fontsize="medium", x=0.01, ha="left")
    return figure


def _meant(name: str, known: Sequence[str]) -> str:
    """Return which name was meant, if one is near, else all of them."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    near = near or [each for each in known if len(name) > 2 and name in each][:1]
    return f"did you mean '{near[0]}'?" if near else f"they are {', '.join(known)}"


def _read(path: Path) -> pa.Table:
    import pyarrow as pa

    table, names = None, []
    reason = "is no Parquet file, or is damaged"
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):  # a pipe would be waited for
            with unreadable_is_none():
                table = pa.concat_tables(pieces(path))
                names = table.column_names  # of a damaged file they may be no text
        else:
            reason = f"is {kind_of(mode)}"
    except FileNotFoundError:
        reason = "there is no such file"
    except (OSError, ValueError) as error:
        reason = f"cannot be read: {reason_of(error)}"
    if table is None:
        raise ScenarioError(f"{path}: {reason}; name the table of a sweep")
    if not {"run", "status"} <= set(names) or names[0] != "run" or len(set(names)) < len(names):
        raise ScenarioError(f"{path}: is not the table of a sweep")
    return table


def _curves(axes: Axes, table: pa.Table, key: str, name: str, others: Sequence[str]) -> None:
    scale = Scale(table, key)
    values, title, unit = column_values(table, name)
    other = Scale(table, others[0]) if len(others) == 1 else None
    few = other is not None and other.values.size <= MOST_CURVES
    groups = [(scale.at == scale.at, 0)]
    if other is not None and few:
        groups = [(other.at == value, value) for value in other.values]
    joined = few or not others
    styles = ("-", "--", ":")
    for k, (mine, value) in enumerate(groups):
        order = np.argsort(scale.at[mine], kind="stable")
        at, what = scale.at[mine][order], values[mine][order]
        said = None
        if other is not None and few:
            said = f"{others[0]} = {other.words[int(value)] if other.words else format(value, 'g')}"
        axes.plot(
            at, what, marker="o" if at.size <= 60 or not joined else "", markersize=3,
            linestyle=styles[k // 3 % 3] if joined else "none", color=COLOURS[k % 3], label=said,
        )  # fmt: skip
    failed = ~np.isfinite(values)
    if failed.any():
        axes.plot(
            scale.at[failed], np.full(failed.sum(), 0.03), "x", color="0.35", markersize=5, clip_on=False,
            transform=axes.get_xaxis_transform(), label="failed, or none",
        )  # fmt: skip
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small")
    low, high = span(values)
    if low > 0.0 and high > 100.0 * low:
        axes.set_yscale("log")
    elif flat(low, high):
        axes.set_ylim(low - 0.05 * abs(low) - 1e-300, high + 0.05 * abs(high) + 1e-300)
    scale.dress(axes, "x")
    axes.set_title(title, fontsize="small", loc="left")
    axes.set_ylabel(unit)


def _map(figure: Figure, axes: Axes, table: pa.Table, x: str, y: str, name: str) -> None:
    from matplotlib.colors import LogNorm, Normalize

    across, up = Scale(table, x), Scale(table, y)
    values, title, unit = column_values(table, name)
    found = values[np.isfinite(values)]
    low, high = span(values)
    if flat(low, high):
        low, high = low - 0.05 * abs(low), high + 0.05 * abs(high)
    norm = LogNorm(low, high) if low > 0.0 and high > 100.0 * low else Normalize(low, high)
    cells = across.values.size * up.values.size
    if cells <= values.size:
        grid = np.full((up.values.size, across.values.size), np.nan)
        column, row = np.searchsorted(across.values, across.at), np.searchsorted(up.values, up.at)
        if cells == values.size:
            grid[row, column] = values
        else:  # a third key varies: its median
            for i, j in np.ndindex(grid.shape):
                here = values[(row == i) & (column == j)]
                if np.any(np.isfinite(here)):
                    grid[i, j] = np.nanmedian(here)
            title += " (median)"
        axes.set_facecolor("0.85")
        axes.patch.set(hatch="xx", edgecolor="0.6")
        image: Any = axes.pcolormesh(
            across.edges(), up.edges(), grid, norm=norm, cmap="cividis", linewidth=0, rasterized=True
        )
    else:
        failed = ~np.isfinite(values)
        axes.plot(across.at[failed], up.at[failed], "x", color="0.55", markersize=4)
        size = float(np.clip(6000.0 / values.size, 4.0, 36.0))
        image = axes.scatter(
            across.at[~failed], up.at[~failed], c=found, s=size, norm=norm, cmap="cividis", linewidth=0
        )
    axes.grid(visible=False)
    across.dress(axes, "x", cells <= values.size)
    up.dress(axes, "y", cells <= values.size)
    bar = figure.colorbar(image, ax=axes)
    bar.set_label(unit)
    axes.set_title(title, fontsize="small", loc="left")
