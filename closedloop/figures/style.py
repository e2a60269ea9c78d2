"""The style of all figures, the elements of all panels over time, and the instants that they mark.

Modes are bands behind the curves and events are marks on the time axis. Bands differ in lightness and hatching and
marks in shape, so that neither needs colour.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from closedloop.base.families import Absent
from closedloop.control.reference.path import StepForceSection, path_normal, tip_path
from closedloop.loop.events import table
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.artist import Artist
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
    "font.size": 10, "axes.titlesize": 11, "axes.titlelocation": "left", "axes.grid": True, "grid.alpha": 0.3,
    "axes.spines.top": False, "axes.spines.right": False, "axes.formatter.useoffset": False,
    "legend.frameon": True, "legend.framealpha": 0.9, "legend.edgecolor": "none", "lines.linewidth": 1.2,
    "hatch.linewidth": 0.5, "svg.fonttype": "none", "pdf.fonttype": 42, "ps.fonttype": 42,
    "svg.hashsalt": "closedloop", "savefig.dpi": 150,
}  # fmt: skip


# Inches: the width of a page, and how wide figures are drawn and with which font, points, where one is asked for.
WIDE = 7.2
_asked: ContextVar[tuple[float, float | None]] = ContextVar("width and font of figures", default=(WIDE, None))


@contextmanager
def styled(
    changes: Mapping[str, Any] | None = None, *, width: float | None = None, font: float | None = None
) -> Iterator[None]:
    """Draw in `STYLE`; a context, and a decorator as well.

    Parameters
    ----------
    changes : mapping of str, optional
        Some of matplotlib's settings, in place of those of `STYLE`.
    width : float, optional
        Width of the figures, inches; if left out, that of the context around this one, or `WIDE`.
    font : float, optional
        Size of the text, points: titles are a tenth larger, legends and notes a sixth smaller.
    """
    import matplotlib as mpl

    width, font = (new if new is not None else old for new, old in zip((width, font), _asked.get(), strict=True))
    sizes = {} if font is None else {"font.size": font, "axes.titlesize": 1.1 * font}
    before = _asked.set((cast(float, width), font))
    try:
        with mpl.rc_context(cast(Any, {**STYLE, **sizes, **(changes or {})})):
            yield
    finally:
        _asked.reset(before)


def page_width() -> float:
    """Return how wide figures are drawn, inches."""
    return _asked.get()[0]


def new_figure(height: float = 3.4) -> Figure:
    """Return an empty figure as wide as `styled` says, `height` inches high at the width of a page.

    A narrower figure is lower by the square root of that: text keeps its size.
    """
    from closedloop.figures.page import Page

    width = page_width()
    return Page(STYLE, figsize=(width, height * math.sqrt(width / WIDE)))


def panels(
    count: int, height: float, ax: Axes | Sequence[Axes] | None = None, ratios: Sequence[float] | None = None,
    share: bool = True,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """Return a figure, and its panels, one above the other, by default over one time; or given axes as panels.

    Where one Axes is given, it is the first panel; the others are drawn, and nobody sees them.

    Raises ValueError if as many axes are given as are no number of panels.
    """
    if ax is None:
        figure = new_figure(height)
        return figure, list(figure.subplots(count, 1, sharex=share, height_ratios=ratios, squeeze=False)[:, 0])
    given = list(ax) if isinstance(ax, Iterable) else [ax]
    if len(given) not in (1, count):
        raise ValueError(f"ax: has {len(given)} axes; give one, for the first panel, or {count}, one for each")
    unseen = new_figure().subplots(max(1, count - len(given)), 1, squeeze=False)[:, 0]
    return cast("Figure", given[0].get_figure(root=True)), [*given, *unseen][:count]


def no_upper_labels(figure: Figure, axes: Sequence[Axes]) -> None:
    """Leave out the time below all panels of a page but the last."""
    for each in axes[:-1]:
        if is_page(figure):
            each.set_xlabel("")


def is_page(figure: Figure) -> bool:
    """Tell whether this package made a figure, and not its user."""
    from closedloop.figures.page import Page

    return isinstance(figure, Page)


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


# The text of the one mark that is not of the motion.
FORCE_STEPS = "force steps"
# Parts of the time shown in which one of the marks of a kind is drawn.
CELLS = 250


class Mark(NamedTuple):
    """An instant, s, and what happens there."""

    time: float
    text: str


class Interval(NamedTuple):
    """A time, from `begin` to `end`, s, in which the tip does one thing: a value of the column `mode`."""

    mode: int
    begin: float
    end: float


def motion(scenario: Scenario) -> tuple[float, float] | None:
    """Return the instants, s, at which the reference starts and stops to move.

    None if it never moves, or is a user's path in a run file, not named in this process.
    """
    if isinstance(scenario.reference, Absent):
        return None
    segments = tip_path(scenario.reference, np.zeros(3), path_normal(scenario.reference, scenario.surface)).segments
    return (segments[0].start, segments[-1].stop) if segments else None


def marks(run: Run) -> list[Mark]:
    """Return the instants at which the scenario's law or reference changes, in order; none under a user's law."""
    if run.law != "scenario":
        return []
    scenario = run.scenario
    found = []
    moves = motion(scenario)
    if moves is not None:
        found += [Mark(moves[0], "motion starts"), Mark(moves[1], "motion stops")]
    if scenario.law.kind == "paper":
        begins = getattr(scenario.law, "pd_start", None)
        if moves is not None and begins in (None, moves[0]):
            found[0] = Mark(moves[0], "PD and motion start")
        elif begins is not None:
            found.append(Mark(begins, "PD starts"))
    if isinstance(scenario.force_profile, StepForceSection):
        found.append(Mark(scenario.force_profile.at, FORCE_STEPS))
    return sorted(found)


def intervals(run: Run) -> list[Interval]:
    """Return the intervals of each contact mode; their bounds are the events' instants, between two rows."""
    changes = np.flatnonzero(np.diff(run.mode)) + 1
    bounds = [float(run.time[0]), *(_instant(run, int(k)) for k in changes), float(run.time[-1])]
    return [Interval(*each) for each in zip(run.mode[[0, *changes]].tolist(), bounds, bounds[1:], strict=False)]


def _instant(run: Run, row: int) -> float:
    """Return when the mode of this row began: the last event since the row before that changes modes, if there is."""
    events = run.event_time[(run.event_kind != table.IMPACT) & (run.event_kind != table.REVERSAL)]
    latest = int(np.searchsorted(events, run.time[row], side="right")) - 1
    if latest >= 0 and events[latest] > run.time[row - 1]:
        return float(events[latest])
    return float(run.time[row])


def thinned(times: NDArray[np.float64], begin: float, end: float) -> NDArray[np.float64]:
    """Return the times from `begin` to `end`, one for each of `CELLS` parts of that span: more could not be seen."""
    inside = times[(times >= begin) & (times <= end)]
    cell = np.floor(CELLS * (inside - begin) / max(end - begin, np.finfo(float).tiny))
    return inside[np.unique(cell, return_index=True)[1]]


BANDS: dict[int, tuple[str, dict[str, Any]]] = {
    FREE: ("free", {"facecolor": "#DCE9F3", "edgecolor": "none"}),
    PRESSED: ("pressed", {"facecolor": "white", "edgecolor": "0.6"}),
    STUCK: ("stuck", {"facecolor": "#F5E9D0", "edgecolor": "#DDC795", "hatch": "////"}),
}
# The first to be drawn is the lowest: one touchdown is not hidden by a hundred impacts.
SHAPES: dict[int, dict[str, Any]] = {
    table.IMPACT: {"marker": "|", "markersize": 7, "markeredgewidth": 0.9},
    table.REVERSAL: {"marker": "d", "markersize": 4},
    table.SLIP_AGAIN: {"marker": ">", "markersize": 5},
    table.STICK: {"marker": "s", "markersize": 4},
    table.TOUCHDOWN: {"marker": "v", "markersize": 6},
    table.LIFTOFF: {"marker": "^", "markersize": 6},
    table.EDGE: {"marker": "X", "markersize": 6},
    table.STOP: {"marker": "P", "markersize": 5},
    table.RELEASE: {"marker": "<", "markersize": 5},
    table.TIME_STEP: {"marker": "*", "markersize": 6},
    table.TANGENTIAL_IMPACT: {"marker": "p", "markersize": 5},
    table.TIME_STEPPING: {"marker": "h", "markersize": 5},
}
INK = "0.15"
TIME = "time [s]"
# Up to so many times its rounding a value is drawn beside it.
NEAR_ROUNDING = 30.0
# How much of a panel a label of a mark takes: of its width so many inches, of its height a share, or points if that
# is more; lengths are those of text of 10 points.
LABEL_INCHES, LABEL_HEIGHT, LABEL_POINTS = 1.12, 0.11, 14.0


def dress(
    axes: Axes, run: Run, title: str, label: str, *, label_marks: bool = True, show_events: bool = True,
    rows: slice = slice(None),
) -> None:  # fmt: skip
    """Give a panel over the time of these rows its title, axes, marks, bands and events.

    `title`: the robot's name is added where marks are labelled.
    `label`: of the vertical axis, with its unit.
    `label_marks`, `show_events`: off for all but one of several panels over the same time.
    """
    axes.set(title=f"{title} ({run.model.name})" if label_marks else title, xlabel=TIME, ylabel=label)
    begin = float(run.time[rows][0])
    end = max(float(run.time[rows][-1]), begin + run.scenario.time.step)
    axes.set_xlim(begin, end)
    _draw_bands(axes, run, begin, end)
    _draw_marks(axes, run, begin, end, label_marks)
    if show_events:
        from matplotlib.lines import Line2D
        from matplotlib.transforms import offset_copy

        above = offset_copy(axes.get_xaxis_transform(), fig=axes.get_figure(root=True), y=4, units="points")
        for kind, shape in SHAPES.items():
            times = thinned(run.event_time[run.event_kind == kind], begin, end)
            if times.size:
                # add_artist, not add_line: marks on the axis say nothing about the range of the data.
                axes.add_artist(
                    Line2D(times, np.zeros_like(times), color=INK, linestyle="none", transform=above, zorder=4, **shape)
                )


def contact_handles(run: Run) -> list[Artist]:
    """Return what explains a run's bands and events in a legend, ``figure.legend(handles=...)``; often nothing."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = []
    if contact_changes(run):
        present = set(np.unique(run.mode).tolist())
        handles += [Patch(label=name, **style) for mode, (name, style) in BANDS.items() if mode in present]
    happened = set(np.unique(run.event_kind).tolist())
    return handles + [
        Line2D([], [], color=INK, linestyle="none", label=table.KINDS[kind].replace("_", " "), **shape)
        for kind, shape in sorted(SHAPES.items())
        if kind in happened
    ]


def explain_contact(figure: Figure, run: Run) -> None:
    """Add to a page the one legend of its bands and events, see `contact_handles`."""
    legend_outside(figure, "lower center", contact_handles(run))


def finished(figure: Figure, axes: Sequence[Axes], run: Run) -> Figure:
    """Return a figure over time with its time below the last panel, and what its bands and events are below that."""
    no_upper_labels(figure, axes)
    explain_contact(figure, run)
    return figure


def legend_beside_title(axes: Axes, handles: Sequence[Artist] | None = None) -> None:
    """Put the legend of a panel beside its title, where no curve can be hidden by it; on a user's axes inside them."""
    found, labels = axes.get_legend_handles_labels() if handles is None else _labelled(handles)
    figure: Any = axes.get_figure(root=True)
    if is_page(figure):
        figure.legend_beside(axes, found, labels)
    elif found:
        axes.legend(found, labels, loc="best", fontsize="small")


def legend_outside(
    figure: Figure, where: str, handles: Sequence[Artist], most: int = 20, title: str = "", axes: Axes | None = None
) -> None:
    """Put a legend above ("upper center") or below ("lower center") all panels of a page.

    On a user's figure it is put into `axes`, if that is given, and left out otherwise.
    """
    found, labels = _labelled(handles)
    page: Any = figure
    if not found:
        return
    if is_page(figure):
        page.legend_outside(where, found, labels, most, title)
    elif axes is not None:
        axes.legend(found, labels, loc="best", fontsize="small", title=title, title_fontsize="small")


def _labelled(handles: Sequence[Artist]) -> tuple[list[Artist], list[str]]:
    return list(handles), [str(each.get_label()) for each in handles]


def position_rounding(run: Run) -> float:
    """Return the size, m, down to which a distance computed from the tip's position is rounding.

    e = n·r − d is a sum of a few products as large as the tip's distance from the base: 4 ε of it.
    """
    return 4.0 * float(np.finfo(float).eps) * float(np.max(np.abs(run.position), initial=0.1))


def mark_rounding(axes: Axes, size: float, level: float, factor: float) -> None:
    """Draw the level of rounding, where what is drawn is no larger than some of it.

    `size`: largest absolute value drawn, m.
    `level`, `factor`: rounding, m, and the factor of the unit drawn.
    """
    if size > NEAR_ROUNDING * level:
        return
    for sign in (-1.0, 1.0):
        axes.axhline(sign * factor * level, color="0.4", linestyle="-.", linewidth=0.8)
    axes.annotate(
        "rounding of the position", (1.0, factor * level), xycoords=("axes fraction", "data"), xytext=(-2, 4),
        textcoords="offset points", ha="right", fontsize="small", color="0.35",
    )  # fmt: skip
    most = 1.6 * factor * max(size, level)
    axes.set_ylim(-most, most)


def contact_changes(run: Run) -> bool:
    """Tell whether the tip ever does anything but slide or rest on the surface, or is never there."""
    return bool(np.any(run.mode != PRESSED)) and not tip_is_idle(run)


def tip_is_idle(run: Run) -> bool:
    """Tell whether there is no surface for the tip, or links are in contact instead of it, which never is."""
    scenario = run.scenario
    return not scenario.has_surface or (bool(scenario.contact) and bool(np.all(run.mode == FREE)))


def _draw_bands(axes: Axes, run: Run, begin: float, end: float) -> None:
    from matplotlib.collections import PolyCollection

    if not contact_changes(run):
        return
    for mode in (FREE, STUCK):  # pressed is the paper itself
        spans = [(max(i.begin, begin), min(i.end, end)) for i in intervals(run) if i.mode == mode]
        corners = [[(a, 0.0), (a, 1.0), (b, 1.0), (b, 0.0)] for a, b in spans if b > a]
        if corners:
            bands = PolyCollection(
                corners, transform=axes.get_xaxis_transform(), linewidth=0, zorder=0.1, **BANDS[mode][1]
            )
            axes.add_collection(bands, autolim=False)


def _draw_marks(axes: Axes, run: Run, begin: float, end: float, label: bool) -> None:
    """Draw the marks; a label too near to the one before is set lower, and one near the end to the left of its mark."""
    level, reach, crowded = 0, -np.inf, False
    import matplotlib as mpl

    size = float(mpl.rcParams["font.size"]) / 10.0
    inches = axes.get_window_extent().transformed(axes.get_figure(root=True).dpi_scale_trans.inverted())  # type: ignore[union-attr]
    height = max(LABEL_HEIGHT, size * LABEL_POINTS / (72.0 * inches.height))
    width = min(1.0, size * LABEL_INCHES / inches.width)
    for t, text in marks(run):
        if not begin < t < end:
            continue
        axes.axvline(t, color="0.35", linestyle="--", linewidth=0.8)
        if not label:
            continue
        late = t > end - 0.7 * width * (end - begin)
        left = t - width * (end - begin) if late else t
        level = level + 1 if left < reach else 0
        reach = left + width * (end - begin)
        axes.annotate(
            text, (t, 1.0), xycoords=("data", "axes fraction"), xytext=(-4 if late else 4, -11 * size * (1 + level)),
            textcoords="offset points", ha="right" if late else "left", fontsize="small", color="0.25",
        )  # fmt: skip
        crowded = crowded or _reaches_up(axes, left, reach, 1.0 - height * (1 + level))
    if crowded:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 2 * height * (high - low))


def _reaches_up(axes: Axes, begin: float, end: float, share: float) -> bool:
    """Tell whether a curve comes up to this share of the panel's height between two times, right at these aside."""
    low, high = axes.get_ylim()
    aside = 0.06 * (end - begin)
    for line in axes.lines:
        x, y = np.asarray(line.get_xdata(), dtype=float), np.asarray(line.get_ydata(), dtype=float)
        if x.size == 2 and np.all(x == [0.0, 1.0]):  # a level, from one side of the panel to the other
            x = np.array([begin, end])
        if line.get_transform().contains_branch(axes.transData) and x.size > 1:
            inside = (x > begin + aside) & (x < end - aside)
            if np.any(y[inside] > low + share * (high - low)):
                return True
    return False
