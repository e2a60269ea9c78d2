"""Figures of tosses: errors over time, the tosses that were simulated best and worst, and a film of both."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import COLOUR, Ghost, Shape
from closedloop.figures.style import COLOURS, STROKES, new_figure, styled
from closedloop.lab.animate import write_film
from closedloop.lab.app import Lab
from closedloop.lab.curves import COLOURS as OF_CURVES
from closedloop.lab.curves import Panel, Trace
from closedloop.lab.history import share
from closedloop.record.run import Run
from validation.measured.cubes.comparing import Tried, fitted
from validation.measured.cubes.engine import RATE, SIDE, STEPS, ClosedLoopCube, Toss, errors, first_row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BAND = (25.0, 75.0)
SHOWN = 10


@styled()
def errors_over_time(tosses: Sequence[Toss], results: Mapping[str, Tried]) -> Figure:
    """Return the figure of the mean errors at each instant, with the middle half of the first engine's tosses."""
    figure = new_figure(3.4)
    axes = figure.subplots(1, 2)
    rows = min(len(toss.states) for toss in tosses)
    time = np.arange(rows) / RATE
    for k, (axis, unit) in enumerate(zip(axes, ("position error, % of the side", "rotation error, °"), strict=True)):
        for at, (name, one) in enumerate(results.items()):
            done = [(toss, path) for toss, path in zip(tosses, one.paths, strict=True) if len(path) >= rows]
            found = np.array([errors(toss, path)[k][:rows] for toss, path in done])
            if at == 0:
                axis.fill_between(
                    time, *np.percentile(found, BAND, axis=0), color=COLOURS[0], alpha=0.15, lw=0,
                    label=f"middle half of the tosses, {name}",
                )  # fmt: skip
            axis.plot(time, found.mean(axis=0), STROKES[at], color=COLOURS[at], label=f"mean, {name}")
        axis.set(xlabel="time, s", ylabel=unit, xlim=(0.0, time[-1]), ylim=(0.0, None))
    axes[0].legend(fontsize=8)
    return figure


@styled()
def best_and_worst(tosses: Sequence[Toss], one: Tried) -> Figure:
    """Return the figure of the ten best and the ten worst tosses: height of the centre, measured and simulated."""
    done = np.flatnonzero(~np.isnan(one.means[:, 0]))
    order = done[np.argsort(one.means[done, 0])]
    figure = new_figure(6.0)
    chosen = [*order[:SHOWN], *order[-SHOWN:]]
    for axis, i in zip(figure.subplots(4, 5, sharex=True, sharey=True).flat, chosen, strict=False):
        toss, path = tosses[i], one.paths[i]
        time = np.arange(len(path)) / RATE
        axis.plot(time, 100.0 * toss.states[:, 6], color="0.6", lw=2.5, label="measured")
        axis.plot(time, 100.0 * path[:, 2], color=COLOURS[0], label="simulated")
        axis.set_title(f"{toss.number}: {one.means[i, 0]:.1f} %, {one.means[i, 1]:.0f}°", fontsize=8)
    figure.supxlabel("time, s", fontsize=10)
    figure.supylabel("height of the centre, cm; ten best tosses above, ten worst below", fontsize=10)
    figure.axes[0].legend(fontsize=7)
    return figure


# Seconds of the toss in a second of the film.
SPEED = 0.2


def toss_of(tosses: Sequence[Toss], number: int) -> Toss:
    """Return the toss of a number. Raises `ScenarioError` if there is none."""
    for toss in tosses:
        if toss.number == number:
            return toss
    numbers = [toss.number for toss in tosses]
    raise ScenarioError(f"there is no toss {number}: there are {len(numbers)}, from {min(numbers)} to {max(numbers)}")


def simulated(toss: Toss) -> Run:
    """Return the run of a toss from its first row, with the fitted values that come with the package."""
    engine, start = ClosedLoopCube(), first_row(toss)
    keys = {
        "name": f"toss {toss.number}",
        "start.q": np.concatenate([start[4:7], start[:4]]).tolist(),
        "start.v": np.concatenate([start[10:13], start[7:10]]).tolist(),
        "time.duration": (len(toss.states) - 1) / RATE,
    }
    with tempfile.TemporaryDirectory() as folder:
        return cl.simulate(engine.scenario(fitted(engine), Path(folder), keys), progress=False)


def measured(toss: Toss, side: float = SIDE) -> Ghost:
    """Return the measured cube as a ghost."""
    box = trimesh.creation.box((side, side, side))
    shape = Shape(0, np.asarray(box.vertices, dtype=np.float32), np.asarray(box.faces, dtype=np.int32), COLOUR)
    time = np.arange(len(toss.states)) / RATE
    return Ghost("measured", (shape,), time, toss.states[:, :4], toss.states[:, 4:7])


def as_fitted(toss: Toss) -> Ghost:
    """Return the measured cube with the side that was fitted, that of the simulated one."""
    return measured(toss, fitted(ClosedLoopCube())[-1])


def opened(toss: Toss) -> Lab:
    """Open the lab with a toss, and the measured cube beside that of each run."""
    return cl.lab(simulated(toss), show=False, ghosts=[as_fitted(toss)])


def film(toss: Toss, path: Path) -> Path:
    """Write a film of a toss, simulated and measured, beside its errors: a .gif or a .mp4, or the lab's page, a .html.

    Raises `ScenarioError` if the path has another ending; `OutputError` if the file cannot be written.
    """
    run, ghosts = simulated(toss), [as_fitted(toss)]
    if path.suffix.lower() == ".html":
        return share(run, path, ghosts=ghosts)
    position, rotation = errors(toss, run.q[::STEPS])
    time = np.arange(len(position)) / RATE
    traces = (Trace("position, % of the side", OF_CURVES[0], position), Trace("rotation, °", OF_CURVES[1], rotation))
    return write_film(scene_of(run, ghosts), Panel("error", "%, °", time, traces), path, speed=SPEED)
