"""Figures 4-7 of the paper: tip position, contact force, closure error with and without the stabiliser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from closedloop.errors import OutputError
from closedloop.record import Run
from closedloop.reference.sections import LineSection

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Blue, orange, green of Okabe and Ito's palette: told apart by colour-blind readers and in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73")
STROKES = ("-", "-", "--")
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
    "svg.fonttype": "none",
    "svg.hashsalt": "closedloop",
    "savefig.dpi": 150,
}


def tip_position(run: Run) -> Figure:
    """Draw the tip's displacement from its start along x, y and z against time, and its small parts apart (Fig. 4)."""
    figure = _new_figure(height=4.6)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    moved = run.position - run.position[0]
    for k, axis in enumerate("xyz"):
        above.plot(
            run.time,
            1e3 * moved[:, k],
            STROKES[k],
            color=COLOURS[k],
            label=f"{axis} (from {round(run.position[0, k], 4) + 0.0:.4f} m)",
        )
    above.margins(y=0.15)
    _dress(above, run, "Tip position, base frame", "displacement [mm]")
    above.legend(loc="upper left", bbox_to_anchor=(0.08, 0.9))
    above.set_xlabel("")
    sizes = np.max(np.abs(moved), axis=0)
    small = [k for k in range(3) if sizes[k] < 0.01 * sizes.max()] or list(range(3))
    factor, unit = _length_unit(float(sizes[small].max()))
    for k in small:
        below.plot(run.time, factor * moved[:, k], STROKES[k], color=COLOURS[k], label="xyz"[k])
    _dress(below, run, "The same, off the path", f"displacement [{unit}]", label_marks=False)
    below.legend(loc="upper right")
    return figure


def contact_force(run: Run) -> Figure:
    """Draw the contact force against time, with the commanded force and the transients enlarged (Fig. 5)."""
    moments = [(t, text) for t, text in _marks(run) if run.time[0] < t < run.time[-1]]
    figure = _new_figure(height=5.0 if moments else 3.4)
    grid = figure.add_gridspec(2 if moments else 1, max(1, len(moments)), height_ratios=[1.3, 1][: 2 if moments else 1])
    whole = figure.add_subplot(grid[0, :])
    _draw_force(whole, run, slice(None))
    _dress(whole, run, "Contact force of the surface on the tip, along its normal", "f [N]")
    whole.legend(loc="lower center", ncols=2)
    for k, (t, text) in enumerate(moments):
        axes = figure.add_subplot(grid[1, k])
        near = slice(*np.searchsorted(run.time, (t - 0.02, t + 0.12)).tolist())
        _draw_force(axes, run, near, marker=".", markersize=2.5)
        _dress(axes, run, text, "f [N]", label_marks=False, span=near)
    return figure


def _draw_force(axes: Axes, run: Run, rows: slice, **style: Any) -> None:
    force = run.contact_force[rows]
    axes.plot(run.time[rows], force, color=COLOURS[0], label="contact force f", **style)
    if run.law == "scenario":
        axes.axhline(
            run.scenario.law.force,
            color="0.3",
            linestyle=":",
            linewidth=1,
            label=f"commanded {run.scenario.law.force:g} N",
        )
    # A force constant to rounding is a flat line, not a picture of its sixteenth digit.
    middle, spread = float(np.mean(force)), float(np.ptp(force))
    if spread < 1e-3 * max(abs(middle), 1.0):
        axes.set_ylim(middle - 1, middle + 1)


def closure_error(run: Run) -> Figure:
    """Draw the closure error against time (Fig. 6 with the stabiliser, Fig. 7 without)."""
    figure = _new_figure()
    axes = figure.add_subplot()
    axes.margins(y=0.15)
    factor, unit = _length_unit(float(np.max(np.abs(run.closure_error), initial=0.0)))
    axes.plot(run.time, factor * run.closure_error, color=COLOURS[1])
    how = {
        "baumgarte": "with Baumgarte's stabiliser",
        "projection": "with projection",
        "both": "with Baumgarte's stabiliser and projection",
        "none": "without stabiliser",
    }[run.scenario.stabiliser.kind]
    _dress(axes, run, f"Closure error e = n·r − d, {how}", f"e [{unit}]")
    return figure


def draw_figures(run: Run, folder: str | Path, unstabilised: Run | None = None) -> list[Path]:
    """Write the figures of a run into `folder`, each as PNG and SVG, and return the paths of the PNGs.

    Parameters
    ----------
    run : Run
        The run; one without a stabiliser gives Figs. 4, 5 and 7, one with it Figs. 4-6.
    folder : path
        An existing folder.
    unstabilised : Run, optional
        The same scenario without its stabiliser, for Fig. 7 beside Fig. 6.

    Raises
    ------
    OutputError
        If a figure cannot be written.
    """
    plain = run.scenario.stabiliser.kind == "none"
    wanted: list[tuple[str, Callable[[Run], Figure], Run]] = [
        ("fig4_tip_position", tip_position, run),
        ("fig5_contact_force", contact_force, run),
        ("fig7_closure_error_unstabilised" if plain else "fig6_closure_error", closure_error, run),
    ]
    if unstabilised is not None and not plain:
        wanted.append(("fig7_closure_error_unstabilised", closure_error, unstabilised))
    written = []
    for name, draw, what in wanted:
        if len(what) == 0:
            continue
        written.append(save_figure(draw, what, Path(folder) / name))
    return written


def save_figure(draw: Callable[[Run], Figure], run: Run, path: Path) -> Path:
    """Draw a figure of a run and write it as `path`.png and `path`.svg; return the former."""
    import matplotlib as mpl

    with mpl.rc_context(cast(Any, STYLE)):
        figure = draw(run)
        try:
            for suffix in (".svg", ".png"):
                metadata = {"Date": None} if suffix == ".svg" else {}
                figure.savefig(path.with_suffix(suffix), metadata=metadata)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path.with_suffix(".png")


def _new_figure(height: float = 3.4) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(7.2, height), layout="constrained")


def _marks(run: Run) -> list[tuple[float, str]]:
    """Return the instants at which the law or the reference changes, and what happens there."""
    reference = run.scenario.reference
    if not isinstance(reference, LineSection) or run.law != "scenario":
        return []
    begins = run.scenario.law.pd_start
    stop = (reference.stop, "motion stops")
    if begins is None or begins == reference.start:
        return [(reference.start, "PD and motion start"), stop]
    return sorted([(begins, "PD starts"), (reference.start, "motion starts"), stop])


def _dress(axes: Axes, run: Run, title: str, label: str, label_marks: bool = True, span: slice = slice(None)) -> None:
    axes.set_title(f"{title} ({run.model.name})" if label_marks else title)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label)
    time = run.time[span]
    axes.set_xlim(time[0], max(time[-1], time[0] + run.scenario.time.step))
    for t, text in _marks(run):
        if time[0] < t < time[-1]:
            axes.axvline(t, color="0.35", linestyle="--", linewidth=0.8)
            if label_marks:
                axes.annotate(
                    text, (t, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -11), textcoords="offset points",
                    fontsize=8, color="0.25",
                )  # fmt: skip


def _length_unit(size: float) -> tuple[float, str]:
    for factor, unit in ((1e12, "pm"), (1e9, "nm"), (1e6, "µm"), (1e3, "mm")):
        if size * factor < 1000:
            return factor, unit
    return 1.0, "m"
