"""A run as a film: the arm as rods, the surface, the paths and the forces, beside the contact force against time.

It is drawn by matplotlib without a screen. A .gif needs nothing else; a .mp4 needs the program ffmpeg, that of the
computer or that which the package imageio-ffmpeg carries.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import OutputError, ScenarioError
from closedloop.base.files import write_whole
from closedloop.figures.scene.scene import ARROWS, PATH, WANTED, Scene, scene_of
from closedloop.lab.curves import main_panel, reduced
from closedloop.record.run import Run
from robot_models import RobotModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 25
FORMATS = (".gif", ".mp4")
MOST_FRAMES = 5000
# The force's axis shows at least this share of the force.
FINEST = 0.02
# Where a line through several parts is not drawn.
GAP = np.full(3, np.nan)
NEEDS_FFMPEG = 'a .mp4 needs ffmpeg, which is not installed: pip install "closedloop[mp4]", or write a .gif'
# Inches, and dots for each: 1000 by 500 pixels.
SIZE, DOTS = (10.0, 5.0), 100


def animate(run: Run, path: str | Path, *, speed: float = 1.0, frames_per_second: int = FRAMES_PER_SECOND) -> Path:
    """Write a film of a run and return its path.

    Parameters
    ----------
    run : Run
    path : path
        A .gif or a .mp4.
    speed : float
        Seconds of the run in a second of the film.
    frames_per_second : int

    Raises
    ------
    ScenarioError
        If the path has another ending, the run has no rows, or a number is none that a film can have.
    OutputError
        If the file cannot be written, or a .mp4 is asked for and there is no ffmpeg.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ScenarioError(f"{path}: a film is {' or '.join(FORMATS)}")
    if len(run) < 2:
        raise ScenarioError(f"{run.scenario.name}: the run has {len(run)} rows: there is nothing to show")
    if not (0.0 < speed < 1e6 and 1 <= frames_per_second <= 100):
        raise ScenarioError(
            f"speed = {speed:g}, frames_per_second = {frames_per_second}: must be above 0, and from 1 to 100"
        )
    rows = _rows(run, speed, frames_per_second)
    if rows.size > MOST_FRAMES:
        raise ScenarioError(f"speed = {speed:g}: the film would have {rows.size} frames, over {MOST_FRAMES}")
    ffmpeg = None
    if path.suffix.lower() == ".mp4":
        ffmpeg = ffmpeg_program()
        if ffmpeg is None:
            raise OutputError(f"{path}: {NEEDS_FFMPEG}")
    return write_whole(path, _film(run, rows, frames_per_second, ffmpeg))


def ffmpeg_program() -> str | None:
    """Return the program ffmpeg: that of the computer, else that of the package imageio-ffmpeg; None without either."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # the package without its program
        return None


def _rows(run: Run, speed: float, frames_per_second: int) -> NDArray[np.int64]:
    """Return the row of each frame."""
    count = max(2, round(float(run.time[-1]) / speed * frames_per_second) + 1)
    instants = np.minimum(np.arange(min(count, MOST_FRAMES + 1)) * speed / frames_per_second, run.time[-1])
    rows: NDArray[np.int64] = np.minimum(np.round(instants / run.scenario.time.step), len(run) - 1).astype(np.int64)
    return rows


def _film(run: Run, rows: NDArray[np.int64], frames_per_second: int, ffmpeg: str | None) -> bytes:
    """Return the film: a .mp4 by this program, a .gif without one."""
    import tempfile

    import matplotlib as mpl
    from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # The user's settings would change what the film looks like.
    own: Any = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "animation.ffmpeg_path": ffmpeg or "ffmpeg"}
    with mpl.rc_context(own):
        figure = Figure(figsize=SIZE, dpi=DOTS, layout="constrained")
        FigureCanvasAgg(figure)
        picture = _Picture(figure, scene_of(run))
        picture.show(0)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # as laid out now: again for each frame, it would take most of the time
        film = FuncAnimation(figure, picture.show, frames=rows.tolist(), cache_frame_data=False)
        suffix, kind = (".gif", PillowWriter) if ffmpeg is None else (".mp4", FFMpegWriter)
        writer: Any = kind(fps=frames_per_second)
        with tempfile.TemporaryDirectory(prefix="closedloop-") as folder:
            file = Path(folder) / f"film{suffix}"
            film.save(file, writer=writer, dpi=DOTS)
            return file.read_bytes()


class _Picture:
    """The figure of a film, whose parts move."""

    def __init__(self, figure: Figure, scene: Scene) -> None:
        self.scene, run = scene, scene.run
        grid = figure.add_gridspec(1, 2, width_ratios=[1.1, 1.0])
        space: Any = figure.add_subplot(grid[0], projection="3d")
        plot = figure.add_subplot(grid[1])
        self._space = space
        self._links = _links(scene)
        (self._arm,) = space.plot([], [], [], "-o", color="#4D738F", linewidth=4, markersize=5, solid_capstyle="round")
        self._arrows = {
            kind: space.plot([], [], [], "-", color=ARROWS[kind], linewidth=2, label=kind)[0] for kind in scene.kinds
        }
        (self._done,) = space.plot([], [], [], "-", color=PATH, linewidth=2)
        wanted = run.reference_tip[:: max(1, len(run) // 400)]
        space.plot(*wanted.T, "--", color=WANTED, linewidth=1)
        vertices, faces = scene.surface
        if len(faces):
            space.plot_trisurf(*vertices.T, triangles=faces, color="0.8", alpha=0.4, linewidth=0.0)
        if scene.marks:
            space.scatter(*np.array([mark.position for mark in scene.marks]).T, color="#CC79A7", s=12)
        self._frame_view(space)
        space.legend(loc="upper left", fontsize=8)
        force = reduced(main_panel(run), float(run.time[0]), float(run.time[-1]), 400)
        for trace in force.traces:
            style = "--" if trace.limit else "-"
            plot.plot(force.time, trace.values, style, color=trace.colour, linewidth=1.2, label=trace.label)
        low, high = plot.get_ylim()
        least = FINEST * max(abs(low), abs(high))
        if high - low < least:  # a force that stays as it is: its rounding errors are not what the film is about
            plot.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
        plot.set_xlabel("time [s]")
        plot.set_ylabel(force.title)
        plot.legend(fontsize=8)
        self._cursor = plot.axvline(0.0, color="0.3", linewidth=1)
        self._title = figure.suptitle("")

    def _frame_view(self, space: Any) -> None:
        """Give the axes one scale, and the size of all that is drawn in them."""
        rows = np.unique(np.linspace(0, len(self.scene.run) - 1, 20).astype(int))
        points = np.vstack([*(self._points(int(row)) for row in rows), self.scene.surface[0]])
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        middle, half = (low + high) / 2.0, 0.55 * float((high - low).max()) + 1e-3
        space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        space.set(**{f"{axis}lim": (m - half, m + half) for axis, m in zip("xyz", middle, strict=True)})
        space.set_box_aspect((1, 1, 1))
        space.view_init(elev=22.0, azim=-35.0)

    def _points(self, row: int) -> Array:
        """Return the line (k, 3), m, along the joints to the tip, and those to the sides of loops and to contacts."""
        scene, there = self.scene, self.scene.joint_places(row)
        parts = [there[1][self._links], scene.tip_place(row)[None]]
        for loop in scene.joined.loops:
            for side in loop.sides:
                place = there[1][side.frame] + there[0][side.frame] @ side.point
                parts += [GAP[None], there[1][_supports(scene.model, side.frame)], place[None]]
        for touching in scene.touching:
            place, _ = touching.force(0.0, np.zeros(2), *there)
            parts += [GAP[None], there[1][_supports(scene.model, touching.point_frame)], place[None]]
        return np.vstack(parts)

    def show(self, row: int) -> list[Any]:
        """Show a row of the run."""
        scene, run = self.scene, self.scene.run
        self._arm.set_data_3d(*self._points(row).T)
        self._done.set_data_3d(*run.position[: row + 1 : max(1, row // 300)].T)
        (arrows,) = scene.arrows([row])
        for kind, line in self._arrows.items():  # one line for all of a kind, with a gap after each
            ends = [(a.tail, a.tail + scene.metres_per_newton * a.force, GAP) for a in arrows if a.kind == kind]
            line.set_data_3d(*np.reshape(ends, (-1, 3)).T)
        self._cursor.set_xdata([run.time[row]] * 2)
        scale = f"10 N = {10.0 * scene.metres_per_newton:.2g} m"
        self._title.set_text(f"{run.scenario.name} ({run.model.name})   t = {run.time[row]:.3f} s   {scale}")
        return []


def _links(scene: Scene) -> list[int]:
    """Return the numbers of the joints from the base to the tip, the base's own, 0, first."""
    model: Any = scene.model.pinocchio_model()
    return _supports(scene.model, model.frames[model.getFrameId(scene.tip)].parentJoint)


def _supports(model: RobotModel, joint: int) -> list[int]:
    """Return the numbers of the joints from the base to one, the base's own, 0, first."""
    mechanism: Any = model.pinocchio_model()
    return [int(each) for each in mechanism.supports[joint]]
