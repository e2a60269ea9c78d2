"""The errors of a run: of the closure (Figs. 6 and 7 of the paper), of the force, and of the tip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures import motion, style
from closedloop.figures.force import FLAT, draw_forces, draw_measured, link_contacts
from closedloop.figures.motion import AT_REST, bodies, directions, frame_of, has_bodies, rests, tip_errors
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_STABILISED = {
    "baumgarte": "with Baumgarte's stabiliser", "projection": "with projection",
    "both": "with Baumgarte's stabiliser and projection", "none": "without stabiliser",
}  # fmt: skip


def closure_error(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the closure error e against time (Fig. 6 with the stabiliser, Fig. 7 without).

    Off the surface e is a gap and no error, a million times larger than the error in contact: a run that has both gets
    a panel for each. For `ax` see `closedloop.figures`.
    """
    touching = run.mode != FREE
    how = _STABILISED[run.scenario.stabiliser.kind]
    soft = run.scenario.compliance.kind != "none"
    what = "Position of the tip relative to the soft surface; e < 0: inside" if soft else f"Closure error, {how}"
    both = bool(np.any(touching) and not np.all(touching))
    figure, drawn = style.panels(2 if both else 1, 4.8 if both else 3.4, ax)
    unit = _draw(drawn[0], run, run.closure_error)
    if np.all(touching):
        title = what if soft or run.scenario.surface.kind != "plane" else f"Closure error e = n·r − d, {how}"
        style.dress(drawn[0], run, title, f"e [{unit}]")
    else:
        style.dress(drawn[0], run, "Gap e", f"e [{unit}]", show_events=not both)
    if both:
        unit = _draw(drawn[1], run, np.where(touching, run.closure_error, np.nan))
        style.dress(drawn[1], run, f"In contact: {what[0].lower()}{what[1:]}", f"e [{unit}]", label_marks=False)
    return style.finished(figure, drawn, run)


def _draw(axes: Axes, run: Run, error: NDArray[np.float64]) -> str:
    """Draw an error, m, which is NaN where there is none, and return the unit in which it is drawn."""
    axes.margins(y=0.15)
    size = float(np.nanmax(np.abs(error), initial=0.0))
    factor, unit = style.length_unit(size) if size > 0.0 else (1.0, "m")
    axes.plot(run.time, factor * error, color=style.COLOURS[1])
    style.mark_rounding(axes, size, style.position_rounding(run), factor)
    return unit


def force_error(run: Run, force: Array) -> Array:
    """Return f − f_des (N,), N, of a force (N,), N; NaN while the tip is free."""
    return np.where(run.mode != FREE, force - run.reference_force, np.nan)


# A path is drawn to scale if it is at least this share of its length wide.
WIDE = 0.1
# Pieces of a path that are coloured, at most: more could not be told apart.
MOST_PIECES = 400
# Across a straight path no less than this share of its length is shown, to either side.
THIN = 1e-4
# The colours span at least this share of the force to either side of its middle.
LIKE = 0.02
# The tip's mobility along the normal is drawn where it falls below this share of its largest value.
SINGULAR = 1e-3
# An excursion of the force that lasts less than this share of the run is cut off from the colours.
BRIEF = 0.01


def plot(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Return what `Run.plot` shows, in the style of all figures: what force control is about.

    Where nothing leads a tip it is `bodies`, or the forces of their contacts if they rest. For `ax` see
    `closedloop.figures`.

    Raises ValueError if the run has no row.
    """
    if len(run) == 0:
        raise ValueError(f"the run of {run.scenario.name} has no row to draw")
    with style.styled():
        if not shows_bodies(run):
            return force_control(run, ax)
        return link_contacts(run, ax) if run.scenario.contact and rests(run) else bodies(run, ax)


def force_control(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw f − f_des, the tip's errors along the path, across it and along the normal, and the path in the surface.

    Where the arm goes through a pose in which the tip cannot move along the normal, its mobility along it is drawn too.

    The path is seen from above the surface: where it should be, and where the tip was, coloured by the contact force.
    Without a surface there are the forces of the links' contacts instead, and without a law nothing that the tip was to
    do. Of a tip that rests there is no path to draw. For `ax` see `closedloop.figures`.
    """
    seen, wanted = _seen_from_above(run)
    wide = float(np.ptp(wanted[:, 1])) > WIDE * float(np.ptp(wanted[:, 0]))
    of_links = bool(run.scenario.contact) and not run.scenario.has_surface
    over_time = [_draw_force_error] * run.scenario.has_surface + [_draw_link_forces] * of_links
    mobility = run.normal_mobility[run.mode != FREE]
    passes = mobility.size > 0 and bool(np.min(mobility) < SINGULAR * np.max(mobility))
    over_time += [_draw_mobility] * passes + [_draw_tip_errors] * is_led(run)
    path = not over_time or max(float(np.ptp(each)) for each in (*seen.T, *wanted.T)) > AT_REST
    heights = [*[1.0] * len(over_time), *([1.9 if wide else 0.8] if path else [])]
    if ax is None:
        figure = style.new_figure(height=(7.6 if wide else 6.2) + 1.7 * (len(over_time) + path - 3))
        grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
        on: list[Axes] = []
        for row in range(len(heights)):  # the path has another axis than time
            on.append(figure.add_subplot(grid[row], sharex=on[0] if 0 < row < len(over_time) else None))
        for axes in on[: len(over_time) - 1]:
            axes.tick_params(labelbottom=False)
    else:
        figure, on = style.panels(len(heights), 6.2, ax)
    for axes, draw in zip(on, over_time, strict=False):
        draw(axes, run)
    style.no_upper_labels(figure, on[: len(over_time)])
    if path:
        _draw_path(on[-1], run, seen, wanted, wide)
    style.explain_contact(figure, run)
    return figure


def shows_bodies(run: Run) -> bool:
    """Tell whether a run is about its free bodies: the tip touches nothing, and nothing leads it."""
    return has_bodies(run) and style.tip_is_idle(run) and not is_led(run)


def is_led(run: Run) -> bool:
    """Tell whether a law, the scenario's or another, was to lead the tip along a path."""
    return run.scenario.has_law or run.law != "scenario"


def _draw_force_error(axes: Axes, run: Run) -> None:
    error = force_error(run, run.contact_force)
    draw_measured(axes, run, force_error(run, run.measured_force))
    axes.plot(run.time, error, color=style.COLOURS[0], label="true")
    axes.axhline(0.0, color="0.3", linestyle=":", linewidth=1)
    axes.margins(y=0.12)
    touching = error[np.isfinite(error)]
    if touching.size and np.ptp(touching) < FLAT * max(1.0, float(np.max(np.abs(run.contact_force)))):
        middle = float(np.mean(touching))
        axes.set_ylim(min(middle, 0.0) - 0.01, max(middle, 0.0) + 0.01)  # a constant error is drawn flat
    rms = float(np.sqrt(np.mean(touching**2))) if touching.size else 0.0
    told = f"Force error in contact, {rms:.2g} N RMS" if touching.size else "The tip is never in contact"
    style.dress(axes, run, told, "f − f_des [N]", show_events=False)
    if len(axes.get_legend_handles_labels()[0]) > 1:
        style.legend_beside_title(axes)


def _draw_mobility(axes: Axes, run: Run) -> None:
    axes.plot(run.time, np.where(run.mode == FREE, np.nan, 100.0 * run.normal_mobility), color=style.COLOURS[1])
    axes.margins(y=0.12)
    title = "Mobility of the tip along the normal: at 0 it cannot move there"
    style.dress(axes, run, title, "share of all [%]", label_marks=False, show_events=False)


def _draw_link_forces(axes: Axes, run: Run) -> None:
    draw_forces(axes, run)
    handles, figure = axes.get_legend_handles_labels()[0], axes.get_figure(root=True)
    assert figure is not None
    style.legend_outside(figure, "upper center", handles, 4, axes=axes)


def _draw_tip_errors(axes: Axes, run: Run) -> None:
    errors = tip_errors(run)
    largest = max(float(np.max(np.abs(each), initial=0.0)) for each in errors)
    factor, unit = style.length_unit(largest) if largest > 0.0 else (1.0, "m")
    rounding = style.position_rounding(run)
    moves = np.any(np.ptp(directions(run), axis=0)) or np.any(np.ptp(run.reference_tip, axis=0))
    names = ("along the path", "across", "normal") if moves else ("t1", "t2", "normal")
    for k in np.argsort([-float(np.max(np.abs(each))) for each in errors]):  # the largest is at the back
        size = float(np.max(np.abs(errors[k])))
        told = f"{names[k]} ≤ {style.length_text(size)}" if size > max(rounding, motion.ROUNDING) else f"{names[k]} ≈ 0"
        axes.plot(run.time, factor * errors[k], color=style.COLOURS[k], label=told)
    axes.margins(y=0.12)
    style.mark_rounding(axes, largest, rounding, factor)
    style.dress(axes, run, "Tip error", f"r − r_des [{unit}]", label_marks=False)
    style.legend_beside_title(axes)


def _seen_from_above(run: Run) -> tuple[Array, Array]:
    """Return the tip's position and the desired one (N, 2), m, along the desired path's length and across it."""
    frame = frame_of(run)[1:]
    wanted, seen = run.reference_tip @ frame.T, run.position @ frame.T
    both = wanted if np.any(np.ptp(wanted, axis=0) > AT_REST) else seen
    centred = both - both.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    long = axes[:, 1]
    if (both[-1] - both[0]) @ long < 0.0:
        long = -long
    turn = np.array([long, [-long[1], long[0]]])
    start = wanted[0]
    return (seen - start) @ turn.T, (wanted - start) @ turn.T


def _draw_path(axes: Axes, run: Run, seen: Array, wanted: Array, wide: bool) -> None:
    from matplotlib.collections import LineCollection

    length = max(float(np.ptp(seen[:, 0])), 1e-6)
    across, unit = (1e3, "mm") if wide else style.length_unit(max(float(np.max(np.abs(seen[:, 1]))), THIN * length))
    rows = np.unique(np.linspace(0, len(run) - 1, min(len(run), MOST_PIECES)).astype(int))
    x, y = 1e3 * seen[rows, 0], across * seen[rows, 1]
    if is_led(run):
        rests = np.max(np.ptp(wanted, axis=0)) <= AT_REST
        axes.plot(1e3 * wanted[:, 0], across * wanted[:, 1], "o" if rests else "-", color="0.8", linewidth=4.0,
                  solid_capstyle="round", label="desired")  # fmt: skip
    free = run.mode[rows] == FREE
    if np.any(free):
        stroke, told = (":", "free") if run.scenario.has_surface else ("-", "tip")
        axes.plot(np.where(free, x, np.nan), np.where(free, y, np.nan), stroke, color="0.35", label=told)
    pressed = np.flatnonzero(~free[:-1] & ~free[1:])
    if pressed.size:
        points = np.stack((x, y), axis=1)
        force = run.contact_force[rows][pressed]
        low, high = np.quantile(run.contact_force[run.mode != FREE], [BRIEF, 1.0 - BRIEF])
        middle, half = 0.5 * (low + high), max(0.5 * (high - low), LIKE * max(1.0, abs(float(high))))
        pieces = LineCollection(
            list(np.stack((points[pressed], points[pressed + 1]), axis=1)), cmap="viridis", linewidths=1.6,
            array=force, clim=(float(middle - half), float(middle + half)),
        )  # fmt: skip
        axes.add_collection(pieces)
        axes.get_figure(root=True).colorbar(  # type: ignore[union-attr]
            pieces, ax=axes, label="f [N]", extend="both", pad=0.02
        )
    normal = frame_of(run)[0]
    from_there = "from above" if normal[2] == 1.0 else f"from ({', '.join(f'{x:.3g}' for x in normal)})"
    axes.set_title(f"Path, seen {'from above the surface' if run.scenario.has_surface else from_there}")
    axes.set(xlabel="along [mm]", ylabel=f"across [{unit}]")
    if wide:
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.margins(y=0.3)
        style.widen(axes, 2.0 * across * THIN * length)
    style.legend_beside_title(axes)
