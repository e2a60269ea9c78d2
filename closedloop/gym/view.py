"""What an environment shows: a picture drawn without a display, or the arm in the browser."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.scene.scene import WANTED, scene_of
from closedloop.gym.core import Core
from closedloop.lab.animate import OWN, Picture
from closedloop.lab.drawn import curves, focus, frames, robot_message, run_message, space_message
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.record.run import Run
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.simulate import as_run

# Instants that the page in the browser shows, and points of the desired path, at most.
TRAIL = 2000


class Pictures:
    """Pictures (480, 640, 3) of the arms, drawn as those of films are, without a display."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._drawn: dict[int, tuple[Problem, Picture]] = {}

    def show(self, i: int) -> NDArray[np.uint8]:
        """Return the picture of environment `i`, with its time and forces in the corner."""
        from matplotlib import rc_context

        core, now = self._core, self._core.now
        problem, row = core.ensemble.problem(i), core.ensemble.rows[i][None]
        scene = scene_of(run_of(problem, row.copy(), core.ensemble.wanted[i][None].copy(), now.time[[i]].copy()))
        forces = [f"{name} = {force:.1f} N" for name, force in zip(*shown_forces(core, i), strict=True)]
        with rc_context(OWN):
            if self._drawn.get(i, (None,))[0] is not problem:  # an episode begins; without a surface what is near
                wanted = problem.table[:: problem.nodes, : 2 * problem.robot.n + 10]
                wanted = wanted[:: max(1, len(wanted) // TRAIL)]
                count = len(wanted)
                first = scene_of(run_of(problem, np.repeat(row, count, axis=0), wanted, np.linspace(0.0, 1.0, count)))
                self._drawn[i] = problem, Picture(first, None, None if first.ground.there else focus(first))
            picture = self._drawn[i][1]
            picture.scene = scene
            pixels = picture.pixels(0, "\n".join([f"t = {now.time[i]:.2f} s", *forces]))
        return pixels[..., :3].copy()

    def close(self) -> None:
        """Let the figures go."""
        self._drawn.clear()


class Browser:
    """The arm in the browser: the lab's page, on this computer alone, brought up to date at each step."""

    def __init__(self, core: Core) -> None:
        from closedloop.lab.history import Shown

        self._core = core
        self._run: dict[str, Any] | None = None
        self._problem: Problem | None = None
        self._past: list[tuple[Array, Array, float]] = []
        self._steps = 0
        self._page = Shown("closedloop.gym", run=lambda client: self._run)
        print(f"closedloop.gym: {self._page.url}", flush=True)

    def show(self, i: int) -> None:
        """Bring the page up to date with environment `i`."""
        from closedloop.lab.curves import main_panel
        from closedloop.lab.history import hello

        problem, ensemble, time = self._core.ensemble.problem(i), self._core.ensemble, float(self._core.now.time[i])
        if problem is not self._problem or time < self._past[-1][2]:  # an episode begins
            self._past.clear()
        self._past = [*self._past[-TRAIL:], (ensemble.rows[i].copy(), ensemble.wanted[i].copy(), time)]
        run = run_of(problem, *map(np.array, zip(*self._past, strict=True)))
        scene, last, scenario = scene_of(run), [len(run) - 1], problem.scenario
        if problem is not self._problem:
            self._problem = problem
            about = {"scenario": scenario.to_toml(), "command": ""}
            self._page.tell("hello", hello(scenario, run.model, live=False) | about)
            self._page.tell("robot", robot_message(scene) | {"robot": 1})
            path = {"name": "desired path", "colour": WANTED, "points": path_of(problem)}
            self._page.tell("space", space_message(scene, last) | {"robot": 1, "paths": [path]})
        self._steps += 1
        panels = curves(run, there=[main_panel(run)])
        self._run = run_message(run, panels, n=self._steps, partial=False, follow=True, line="") | {"columns": []}
        self._page.tell("frame", frames(scene, last) | {"robot": 1})
        self._page.tell_run()

    def close(self) -> None:
        """Close the page."""
        self._page.close()


def run_of(problem: Problem, rows: Array, wanted: Array, time: Array) -> Run:
    """Return instants of an episode as a run: recorded rows (N, k), what is desired (N, 2 n + 10), times (N,), s."""
    mine = problem.with_table(np.repeat(wanted, problem.nodes, axis=0))  # of a step's nodes a run has the first
    run = as_run(mine, rows, np.empty((0, EVENT_WIDTH)), 0.0, COMPILED)
    return replace(run, columns={**run.columns, "time": time})


def path_of(problem: Problem) -> Array:
    """Return points (k, 3) of the desired path."""
    path = problem.table[:, 2 * problem.robot.n : 2 * problem.robot.n + 3]
    return path[:: max(1, len(path) // TRAIL)]


def shown_forces(core: Core, i: int) -> tuple[list[str], Array]:
    """Return the names and forces (k,), N, that environment `i` shows: on the tip; without a surface on links."""
    scenario, now = core.ensemble.problem(i).scenario, core.now
    if scenario.has_surface or not scenario.contact:
        return ["f"], np.array([now.f[i]])
    return [contact.name or f"contact {k + 1}" for k, contact in enumerate(scenario.contact)], now.link_forces[i].copy()


# What shows environments by `show(i)`, until `close()`, by the render mode.
VIEWS = {"rgb_array": Pictures, "human": Browser}
