"""A run as Jupyter shows it: a small picture beside the numbers of its report."""

from __future__ import annotations

import io
from html import escape
from typing import Any

import numpy as np

from closedloop.figures.style import COLOURS
from closedloop.record.report.control_verdict import unknown_text
from closedloop.record.run import Run

# Of the picture: inches, dots for each, and points of the curve at most.
SIZE, DOTS, MOST_POINTS = (3.4, 1.9), 90, 1000


def html(run: Run) -> str:
    """Return a run as HTML: its verdict, its force as a picture, and how large every error was."""
    from closedloop.record.report import report_rows

    title = f"<b>{escape(repr(run).strip('<>'))}</b>"
    told = [(str(name), str(value), str(unit)) for name, value, unit, _ in report_rows(run)] if len(run) else []
    lines = "".join(
        f"<tr><td style='text-align:left'>{escape(name)}</td><td>{escape(value)}</td>"
        f"<td style='text-align:left'>{escape(unit)}</td></tr>"
        for name, value, unit in told
    )
    verdict = run.summary()["verdict"]
    said = _said("verdict", verdict)
    control = _said("control", run.summary()["control_verdict"])
    picture = f"<div>{_picture(run)}</div>" if len(run) > 1 else ""
    return (
        f"<div>{title}<br>{escape(said)}<br>{escape(control)}</div>"
        f"<div style='display:flex;gap:1.5em;align-items:flex-start'>{picture}<table>{lines}</table></div>"
    )


def _said(of: str, verdict: dict[str, Any]) -> str:
    """Return a verdict in a line."""
    said = "good" if verdict["good"] else "BAD: " + "; ".join(each["text"] for each in verdict["problems"])
    return f"{of}: {said}{unknown_text(verdict.get('not_known', ()))}"


def _picture(run: Run) -> str:
    """Return the contact force over time as SVG: two curves and four numbers, without the cost of a figure's layout."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DOTS)
    axes = figure.add_axes((0.15, 0.24, 0.83, 0.72))
    rows = _telling(run.contact_force)
    axes.plot(run.time[rows], run.reference_force[rows], ":", color="0.4", linewidth=0.9)
    axes.plot(run.time[rows], run.contact_force[rows], color=COLOURS[0], linewidth=1.0)
    low, high = axes.get_ylim()
    if high - low < 0.1:
        axes.set_ylim(low - 0.5, high + 0.5)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel("f [N]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    text = io.StringIO()
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(text, metadata={"Date": None})
    drawn = text.getvalue()
    return drawn[drawn.index("<svg") :]


def _telling(values: Any) -> Any:
    """Return rows enough to draw (N,) values: of each stretch the least and the greatest."""
    count = len(values)
    if count <= MOST_POINTS:
        return np.arange(count)
    stretches = np.array_split(np.arange(count), MOST_POINTS // 2)
    extremes = [(rows[np.argmin(values[rows])], rows[np.argmax(values[rows])]) for rows in stretches]
    return np.unique(np.concatenate([np.ravel(extremes), [0, count - 1]]))
