"""What an environment shows: a picture drawn without a display, or the arm in the browser."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.scene.scene import (
    ARROWS,
    PATH,
    WANTED,
    grid_triangles,
    joint_frames,
    round_down,
    scene_of,
)
from closedloop.figures.scene.solids import Shape, robot_shapes, solids_mesh
from closedloop.gym.core import Core
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.record.run import Run
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.simulate import as_run
from robot_models.cached import cached_property
from robot_models.coordinates import with_quaternions

# Inches, and dots for each: 640 by 480 pixels.
SIZE, DOTS = (6.4, 4.8), 100
# The wanted force is drawn as long as this share of the arm's reach.
LONGEST = 0.3
# Half the side of the surface that is drawn, m, and squares along it.
HALF, SQUARES = 0.15, 8
TRAIL = 2000


class _Arm:
    """The arm of an environment: its shapes, and the frames that they are in."""

    def __init__(self, problem: Problem) -> None:
        self.model = problem.robot.model
        self._tip = problem.robot.tip
        self.scale = round_down(LONGEST * problem.robot.reach / max(abs(problem.scenario.law.force), 1.0))

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The shapes of the links."""
        return robot_shapes(self.model, self._tip)

    def places(self, q: Array) -> tuple[Array, Array]:
        """Return the axes (k, 3, 3) and origins (k, 3) of the base and each joint."""
        return joint_frames(self.model, with_quaternions(q, self.model.joint_types))


def patch(problem: Problem, around: Array) -> tuple[Array, Array, Array]:
    """Return x, y and z (k, k) of points of the surface around a point, as far as there is one."""
    surface = problem.surface
    frame, side = problem.frame, np.linspace(-HALF, HALF, SQUARES + 1)
    points = around + side[:, None, None] * frame[1] + side[None, :, None] * frame[2]
    for point in points.reshape(-1, 3):
        for _ in range(3):  # onto the surface, along its normal there
            now = surface.touching(point, np.zeros(3))
            if not np.isfinite(now.gap) or abs(now.gap) > 2.0 * HALF:
                point[:] = np.nan
                break
            point -= now.gap * now.frame[0]
    return points[..., 0], points[..., 1], points[..., 2]


class Picture:
    """Pictures (H, W, 3) of the arms, drawn by matplotlib without a display."""

    def __init__(self, core: Core) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._core, self._most = core, 0.0
        self._arm: _Arm | None = None
        self._figure: Any = Figure(figsize=SIZE, dpi=DOTS)
        self._canvas: Any = FigureCanvasAgg(self._figure)
        self._axes: Any = self._figure.add_axes((0.0, 0.0, 0.72, 1.0), projection="3d")
        self._bar: Any = self._figure.add_axes((0.85, 0.3, 0.14, 0.62))

    def show(self, i: int) -> NDArray[np.uint8]:
        """Return the picture of environment `i`."""
        from matplotlib import rc_context

        with rc_context({"font.size": 9}):
            self._draw(i)
            self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _draw(self, i: int) -> None:
        core, axes, now = self._core, self._axes, self._core.now
        problem = core.ensemble.problem(i)
        arm = self._arm
        if arm is None or arm.model is not problem.robot.model:
            arm = self._arm = _Arm(problem)
        axes.clear()
        _, origins = arm.places(now.q[i])
        tip = now.tip[i]
        line = np.vstack([origins[1:], tip])
        axes.plot(*line.T, color="0.35", linewidth=5.0, marker="o", markersize=7.0, markerfacecolor="0.75")
        if problem.scenario.has_surface:
            x, y, z = patch(problem, core.ensemble.problem(i).robot.position(problem.q))
            axes.plot_surface(x, y, z, color="0.8", alpha=0.45, edgecolor="0.6", linewidth=0.4)
        elif self._draw_walls(problem, arm, now.q[i]):
            line = line[-1:]  # what is seen is the tip between them
        axes.plot(*path_of(problem).T, color=WANTED, linewidth=1.0)
        axes.scatter(*now.wanted_tip[i][:, None], color=PATH, s=12)
        for force, kind in ((now.f[i] * now.normal[i], "contact force"), (now.friction_force[i], "friction")):
            axes.quiver(*tip, *(arm.scale * force), color=ARROWS[kind], linewidth=2.0, arrow_length_ratio=0.15)
        middle, half = 0.5 * (line.min(axis=0) + line.max(axis=0)), 0.5 * np.ptp(line, axis=0).max() + 0.05
        axes.set(
            xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half),
            zlim=(middle[2] - half, middle[2] + half), xlabel="x in m", ylabel="y in m", zlabel="z in m",
        )  # fmt: skip
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(20.0, -60.0)
        axes.text2D(0.03, 0.95, f"t = {now.time[i]:.2f} s", transform=axes.transAxes)
        (names, forces), bar = shown_forces(core, i), self._bar
        wanted, places = float(now.f_des[i]), np.arange(len(names))
        self._most = max(self._most, 2.0 * abs(wanted), 1.0, *forces.tolist())
        bar.clear()
        bar.bar(places, forces, color=ARROWS["contact force"], width=0.8)
        bar.axhline(wanted, color=ARROWS["commanded force"], linewidth=2.0)
        bar.set(xlim=(-0.6, len(names) - 0.4), ylim=(0.0, self._most), title="force in N")
        bar.set_xticks(places if len(names) > 1 else [], names if len(names) > 1 else [], rotation=90, fontsize=7)

    def _draw_walls(self, problem: Problem, arm: _Arm, q: Array) -> bool:
        """Draw the bodies that links touch, and the last link; return whether there are such bodies."""
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

        vertices, faces = _surface(problem)
        if not len(faces):
            return False
        turns, origins = arm.places(q)
        parts = [(vertices[faces], (0.7, 0.7, 0.7), 0.35)]
        for shape in arm.shapes:
            if shape.joint == len(origins) - 1:
                placed = origins[-1] + shape.vertices @ turns[-1].T
                parts.append((placed[np.asarray(shape.faces)], shape.colour, 0.9))
        for triangles, colour, alpha in parts:
            self._axes.add_collection3d(Poly3DCollection(triangles, facecolor=colour, alpha=alpha))
        return True

    def close(self) -> None:
        """Let the figure go."""
        self._figure.clear()


class Browser:
    """The arm in the browser: the lab's page, on this computer alone, brought up to date at each step."""

    def __init__(self, core: Core) -> None:
        from closedloop.lab.shown import Shown

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
        from closedloop.lab.drawn import curves, frames, robot_message, run_message, space_message
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


def _surface(problem: Problem) -> tuple[Array, NDArray[np.uint32]]:
    """Return the surface about the tip's start as vertices (k, 3) and triangles (l, 3), none if there is none.

    Without a surface these are the bodies with flat faces that links touch.
    """
    start = problem.robot.position(problem.q)
    if not problem.scenario.has_surface:
        return solids_mesh(problem.scenario, start[None])
    points = np.stack(patch(problem, start), axis=-1).reshape(-1, 3)
    faces = grid_triangles(SQUARES + 1, SQUARES + 1)
    return np.nan_to_num(points), faces[np.isfinite(points[faces]).all(axis=(1, 2))]


def shown_forces(core: Core, i: int) -> tuple[list[str], Array]:
    """Return the names and forces (k,), N, that environment `i` shows: on the tip; without a surface on links."""
    scenario, now = core.ensemble.problem(i).scenario, core.now
    if scenario.has_surface or not scenario.contact:
        return ["f"], np.array([now.f[i]])
    return [contact.name or f"contact {k + 1}" for k, contact in enumerate(scenario.contact)], now.link_forces[i].copy()


def view_of(render_mode: str, core: Core) -> Any:
    """Return what shows the environments: `show(i)` and `close()`."""
    return Picture(core) if render_mode == "rgb_array" else Browser(core)
