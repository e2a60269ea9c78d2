"""The style of all figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Blue, orange, green of Okabe and Ito's palette: told apart by colour-blind readers and in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73")
STROKES = ("-", "-", "--")
# And the rest of it, with brown and olive in place of black, which is kept for axes and marks.
MANY = (*COLOURS, "#CC79A7", "#E69F00", "#56B4E9", "#7F4F21", "#999933")
# What is drawn without a name, where there are more curves than can be told apart.
OTHERS = "0.75"
# Curves that are drawn in one panel, at most.
MOST_CURVES = 8
STYLE: dict[str, Any] = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "lines.linewidth": 1.2,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "hatch.linewidth": 0.5,
    "svg.fonttype": "none",
    "svg.hashsalt": "closedloop",
    "savefig.dpi": 150,
}


@contextmanager
def styled(changes: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Draw in the style of the figures, with some of matplotlib's settings changed; a decorator as well."""
    import matplotlib as mpl

    with mpl.rc_context(cast(Any, {**STYLE, **(changes or {})})):
        yield


def new_figure(height: float = 3.4) -> Figure:
    """Return an empty figure as wide as a page, and `height` inches high."""
    from matplotlib.figure import Figure

    return Figure(figsize=(7.2, height), layout="constrained")


# A length below this, m, is told in metres with a power of ten: no instrument knows a unit for it.
SMALLEST = 1e-12


def widen(axes: Axes, least: float) -> None:
    """Make the axis upwards of a panel at least so long: the rounding of what stays as it is is not to be seen."""
    low, high = axes.get_ylim()
    if high - low < least:
        axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))


def length_unit(size: float) -> tuple[float, str]:
    """Return the factor and the name of the unit in which a length of `size` metres is read with ease."""
    if 0.0 < size < SMALLEST:
        return 1.0, "m"
    for factor, unit in ((1e9, "nm"), (1e6, "µm"), (1e3, "mm")):
        if size * factor < 1000:
            return factor, unit
    return 1.0, "m"


def length_text(size: float) -> str:
    """Return a length, m, in two digits with its unit."""
    factor, unit = length_unit(size)
    return f"{factor * size:.2g} {unit}" if factor * size < 99.5 else f"{factor * size:.0f} {unit}"
