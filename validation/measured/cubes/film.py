"""A measured toss beside the simulated one: a film, and the lab."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import COLOUR, Ghost, Shape
from closedloop.lab.animate import write_film
from closedloop.lab.app import Lab
from closedloop.lab.curves import COLOURS, Panel, Trace
from closedloop.lab.history import share
from closedloop.record.run import Run
from validation.measured.cubes.comparing import fitted
from validation.measured.cubes.engine import STEPS, ClosedLoopCube
from validation.measured.cubes.tosses import RATE, SIDE, Toss, errors, first_row

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
    traces = (Trace("position, % of the side", COLOURS[0], position), Trace("rotation, °", COLOURS[1], rotation))
    return write_film(scene_of(run, ghosts), Panel("error", "%, °", time, traces), path, speed=SPEED)
