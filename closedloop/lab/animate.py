"""A run as a film: bodies, surface, paths and forces in space, beside curves over time.

It is drawn by matplotlib without a screen. A .gif needs nothing else; a .mp4 needs the program ffmpeg, that of the
computer or that which the package imageio-ffmpeg carries. What stands still is drawn once. For each frame it is copied,
and what moves is drawn over it.
"""

import io
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import OutputError, ScenarioError, missing_line
from closedloop.base.files import write_whole
from closedloop.figures.scene.scene import ARROWS, PATH, WANTED, Scene, scene_of
from closedloop.figures.scene.solids import COLOUR, OPACITY, Shape
from closedloop.figures.style import widen
from closedloop.lab.curves import Panel, main_panel, reduced
from closedloop.record.run import Run

# Inches, and dots for each: 1000 by 500 pixels; without curves 640 by 480.
SIZE, ALONE, DOTS = (10.0, 5.0), (6.4, 4.8), 100
# The axis of the curves shows at least this share of the largest value.
FINEST = 0.02
# Curves with a name at most.
MOST_NAMED = 8
# Where a line through several parts is not drawn.
GAP = np.full(3, np.nan)
# The light of a face, as the page has it, see `web/draw_space.js`: of all, of a direction, and from the sides.
AMBIENT, BRIGHT, FROM_SIDE = 0.45, 0.4, 0.15
LIGHT = np.array([0.4, -0.5, 0.8]) / np.linalg.norm([0.4, -0.5, 0.8])
# Points to a pixel along each axis, of which it has the mean: edges are smooth.
FINE = 2


class Picture:
    """The figure of a film, whose parts move; without a panel of curves that of space alone, without title or clock.

    `view` is the middle (3,) and half the width, m, of what is seen; if left out all of it.
    """

    def __init__(self, scene: Scene, panel: Panel | None, view: tuple[Array, float] | None = None) -> None:
        self.scene, run = scene, scene.run
        self._figure = figure = Figure(figsize=SIZE if panel else ALONE, dpi=DOTS, layout="constrained")
        canvas: Any = FigureCanvasAgg  # its methods have no annotations
        self._canvas = canvas(figure)
        grid = figure.add_gridspec(1, 2, width_ratios=[1.1, 1.0]) if panel else figure.add_gridspec(1, 1)
        self._space: Any = figure.add_subplot(grid[0], projection="3d")
        self._solid = Solids(scene.shapes)
        self._ghosts = [
            (ghost, Solids([replace(s, joint=0) for s in ghost.shapes], COLOUR, OPACITY)) for ghost in scene.ghosts
        ]
        self._arrows = {kind: self._line(ARROWS[kind]) for kind in scene.kinds}
        self._done = self._line(PATH)
        wanted = run.reference_tip[:: max(1, len(run) // 400)]
        if np.ptp(wanted, axis=0).max() > 0.0:
            self._space.plot(*wanted.T, "--", color=WANTED, linewidth=1)
        vertices, faces = scene.surface
        if len(faces):
            self._space.plot_trisurf(*vertices.T, triangles=faces, color="0.8", alpha=0.4, linewidth=0.0)
        if scene.marks:
            self._space.scatter(*np.array([mark.position for mark in scene.marks]).T, color="#CC79A7", s=12)
        self._frame_view(view)
        parts: list[Any] = [Line2D([], [], color=ARROWS[kind], linewidth=2, label=kind) for kind in scene.kinds]
        parts += [Patch(color=COLOUR, alpha=OPACITY, label=ghost.name) for ghost in scene.ghosts]
        self._space.legend(handles=parts, loc="upper left", fontsize=8)
        self._clock, self._cursor = figure.text(0.985, 0.985, "", ha="right", va="top", family="monospace"), None
        self._moving = [self._done, *self._arrows.values(), self._clock]
        if panel:
            self._cursor = self._draw_curves(figure.add_subplot(grid[1]), panel)
            name, robot = run.scenario.name, run.model.name
            whose = "" if robot in ("none", name) else f" ({robot})"
            figure.suptitle(f"{name}{whose}, 10 N = {10.0 * scene.metres_per_newton:.2g} m")
            self._moving.append(self._cursor)
        for part in self._moving:
            part.set_animated(True)  # left out of what is drawn once
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)

    def pixels(self, row: int, said: str = "") -> NDArray[np.uint8]:
        """Return the picture of a row of the run: red, green, blue and opacity of its pixels (height, width, 4).

        `said` stands in its corner; beside curves it is the time.
        """
        scene, run, there = self.scene, self.scene.run, self.scene.joint_places(row)
        self._canvas.restore_region(self._still)
        self._done.set_data_3d(*run.position[: row + 1 : max(1, row // 300)].T)
        (arrows,) = scene.arrows([row])
        for kind, line in self._arrows.items():  # one line for all of a kind, with a gap after each
            ends = [(a.tail, a.tail + scene.metres_per_newton * a.force, GAP) for a in arrows if a.kind == kind]
            line.set_data_3d(*np.reshape(ends, (-1, 3)).T)
        if self._cursor:
            self._cursor.set_xdata([run.time[row]] * 2)
            said = f"t = {run.time[row]:.3f} s"
        self._clock.set_text(said)
        ghosts = [(solids, ghost.place(float(run.time[row]))) for ghost, solids in self._ghosts]
        seen = [self._solid.seen(self._space, *there)]
        seen += [solids.seen(self._space, turn[None], origin[None]) for solids, (turn, origin) in ghosts]
        renderer = self._canvas.get_renderer()
        for solids in seen:
            renderer.draw_image(renderer.new_gc(), *np.round(self._space.bbox.p0), solids)
        for part in self._moving:
            part.draw(renderer)
        return np.array(self._canvas.buffer_rgba())

    def _line(self, colour: Any) -> Any:
        return self._space.plot([], [], [], "-", color=colour, linewidth=2)[0]

    def _draw_curves(self, plot: Any, panel: Panel) -> Any:
        """Draw the curves, and return the line that marks the instant."""
        for trace in panel.traces:
            named = trace.label if not trace.limit or len(panel.traces) <= MOST_NAMED else None
            style = {"linestyle": "--" if trace.limit else "-", "color": trace.colour, "linewidth": 1.2}
            plot.plot(panel.time, trace.values, label=named, **style)
        widen(plot, FINEST * max(abs(end) for end in plot.get_ylim()))
        plot.set(xlabel="time [s]", ylabel=panel.title)
        handles, names = plot.get_legend_handles_labels()
        plot.legend(handles[:MOST_NAMED], names[:MOST_NAMED], fontsize=8)
        return plot.axvline(0.0, color="0.3", linewidth=1)

    def _frame_view(self, view: tuple[Array, float] | None) -> None:
        """Give the axes one scale, and the size of all that is drawn in them, or of a view."""
        scene, space = self.scene, self._space
        rows = np.unique(np.linspace(0, len(scene.run) - 1, 20).astype(int))
        places = [(float(scene.run.time[row]), *scene.joint_places(int(row))) for row in rows]
        points = [scene.surface[0], scene.run.position[rows] if scene.ground.there else np.zeros((0, 3))]
        for t, axes, origins in places:
            points.append(self._solid.points(axes, origins))
            for ghost, solids in self._ghosts:
                turn, origin = ghost.place(t)
                points.append(solids.points(turn[None], origin[None]))
        every = np.vstack(points)
        low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
        middle, half = view or ((low + high) / 2.0, 0.55 * float((high - low).max()) + 1e-3)
        space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        space.set(**{f"{axis}lim": (m - half, m + half) for axis, m in zip("xyz", middle, strict=True)})
        space.set_box_aspect((1, 1, 1))
        space.view_init(elev=22.0, azim=-35.0)


class Solids:
    """Shapes as triangles, of which the nearest is seen at each point of the picture.

    `colour`: of all, in place of their own.
    """

    def __init__(
        self, shapes: Sequence[Shape], colour: tuple[float, float, float] | None = None, opacity: float = 1.0
    ) -> None:
        first = np.cumsum([0, *(len(s.vertices) for s in shapes)])
        self._vertices = np.vstack([np.zeros((0, 3)), *(s.vertices for s in shapes)])
        self._joints = np.repeat(np.array([s.joint for s in shapes], dtype=int), np.diff(first))
        faces = [s.faces + k for s, k in zip(shapes, first[:-1], strict=True)]
        self._faces = np.vstack([np.zeros((0, 3), dtype=int), *faces])
        self._colours = np.repeat(
            [colour or s.colour for s in shapes] or [(0, 0, 0)], [len(f) for f in faces] or 0, axis=0
        )
        self._opacity = opacity

    def points(self, axes: Array, origins: Array) -> Array:
        """Return the vertices (k, 3), m, base frame, where the joints' frames are so."""
        return np.einsum("kij,kj->ki", axes[self._joints], self._vertices) + origins[self._joints]

    def seen(self, space: Any, axes: Array, origins: Array) -> NDArray[np.uint8]:
        """Return what is seen of them in the panel `space`, where the joints' frames are so.

        Red, green, blue and opacity (height, width, 4) of the panel's pixels, the first row below. The light is that of
        the page.
        """
        points, box = self.points(axes, origins), space.bbox
        projected = np.column_stack([points, np.ones(len(points))]) @ np.asarray(space.M).T
        shown = space.transData.transform(projected[:, :2] / projected[:, 3:]) - box.p0
        corners = np.column_stack([FINE * shown, projected[:, 2] / projected[:, 3]])[self._faces]
        sides = points[self._faces]
        normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        bright = AMBIENT + BRIGHT * np.abs(normals @ LIGHT) + FROM_SIDE * np.abs(normals[:, 0])
        height, width = int(np.ceil(box.height)), int(np.ceil(box.width))
        nearest = nearest_triangles(corners, (FINE * height, FINE * width))
        colours = np.zeros((len(sides) + 1, 4), dtype=np.float32)  # the last is that of no triangle
        colours[:-1, :3], colours[:-1, 3] = self._colours * bright[:, None], 1.0
        found, any_ = np.zeros((height, width, 4), dtype=np.uint8), np.argwhere(nearest >= 0)
        if not len(any_):
            return found
        low, high = any_.min(axis=0) // FINE, any_.max(axis=0) // FINE + 1
        part = nearest[FINE * low[0] : FINE * high[0], FINE * low[1] : FINE * high[1]]
        mean = np.sum([colours[part[i::FINE, j::FINE]] for i in range(FINE) for j in range(FINE)], axis=0) / FINE**2
        mean[..., :3] /= np.maximum(mean[..., 3:], 1e-30)  # of the points that are covered
        mean[..., 3] *= self._opacity
        found[low[0] : high[0], low[1] : high[1]] = 255.0 * np.minimum(mean, 1.0) + 0.5
        return found


def nearest_triangles(corners: Array, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number of the nearest triangle that covers each point of a picture (height, width), -1 for none.

    Each row of points that a triangle reaches is cut by its three edges: what is left are the points that it covers.

    `corners` (k, 3, 3): x to the right and y upwards, points of the picture; depth, larger is farther.
    """
    height, width = size
    x, y, z = np.moveaxis(corners, 2, 0)
    across = np.roll(y, -1, axis=1) - y, x - np.roll(x, -1, axis=1)  # an edge's normal, inwards or outwards
    area = across[0][:, 0] * (x[:, 2] - x[:, 0]) + across[1][:, 0] * (y[:, 2] - y[:, 0])
    low = np.maximum(np.ceil(y.min(axis=1) - 0.5), 0.0)
    counts = np.maximum(np.minimum(np.floor(y.max(axis=1) - 0.5) + 1.0, height) - low, 0.0)
    counts = np.where((area != 0.0) & np.isfinite(area), counts, 0.0).astype(int)  # one seen from its edge covers none
    k, row = _steps(counts, low)
    begin, end = np.zeros(len(k)), np.full(len(k), float(width))
    for edge in range(3):
        a, b = (part[:, edge] * np.sign(area) for part in across)
        reach = a * x[:, edge] + b * y[:, edge]  # inside is where a x + b y is not below it
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = (reach[k] - b[k] * (row + 0.5)) / a[k]
        begin = np.where(a[k] > 0.0, np.maximum(begin, np.ceil(cut - 0.5)), begin)
        end = np.where(a[k] < 0.0, np.minimum(end, np.floor(cut - 0.5) + 1.0), end)
    lines, column = _steps(np.maximum(end - begin, 0.0).astype(int), begin)
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = z[:, 1:] - z[:, :1], np.stack([x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1]])
        (x1, x2), (y1, y2), (z1, z2) = gain[1][0].T, gain[1][1].T, gain[0].T
        per_x, per_y = (z1 * y2 - z2 * y1) / (x1 * y2 - x2 * y1), (x1 * z2 - x2 * z1) / (x1 * y2 - x2 * y1)
    at_row = z[k, 0] + per_y[k] * (row + 0.5 - y[k, 0]) + per_x[k] * (0.5 - x[k, 0])
    depth = at_row[lines] + per_x[k][lines] * column
    places = row.astype(int)[lines] * width + column.astype(int)
    least = np.full(height * width, np.inf)
    np.minimum.at(least, places, depth)
    seen = depth == least[places]
    found = np.full(height * width, -1)
    found[places[seen]] = k[lines[seen]]
    return found.reshape(height, width)


def _steps(counts: NDArray[Any], first: Array) -> tuple[NDArray[np.int64], Array]:
    """Return, for as many steps as are counted of each of some things, which it is of, and the first's number on."""
    of = np.repeat(np.arange(len(counts)), counts)
    return of, first[of] + (np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts))


FRAMES_PER_SECOND = 25
FORMATS = (".gif", ".mp4")
MOST_FRAMES = 5000
# Parts of the time of which a curve shows the extremes, and colours of a .gif.
CELLS, COLOURS = 400, 255
UNCHANGED = 255  # the number, in the palette of a .gif, of a pixel that is as in the frame before
# matplotlib's settings: the user's would change what the film looks like.
OWN: Any = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}
NEEDS_FFMPEG = missing_line("a .mp4 needs", "ffmpeg", "mp4") + ", or write a .gif"


def animate(run: Run, path: str | Path, *, speed: float = 1.0, frames_per_second: int = FRAMES_PER_SECOND) -> Path:
    """Write a film of a run and return its path.

    `path`: a .gif or a .mp4.
    `speed`: seconds of the run in a second of the film.
    Raises ScenarioError if the path has another ending, the run has no rows, or a number is none that a film can have.
    Raises OutputError if the file cannot be written, or a .mp4 is asked for and there is no ffmpeg.
    """
    if len(run):
        panel = reduced(main_panel(run), float(run.time[0]), float(run.time[-1]), CELLS)
        return write_film(scene_of(run), panel, Path(path), speed=speed, frames_per_second=frames_per_second)
    raise ScenarioError(f"{run.scenario.name}: the run has 0 rows: there is nothing to show")


def ffmpeg_program() -> str | None:
    """Return the program ffmpeg: that of the computer, else that of the package imageio-ffmpeg; None without either."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # the package without its program
        return None


def write_film(
    scene: Scene, panel: Panel, path: Path, *, speed: float = 1.0, frames_per_second: int = FRAMES_PER_SECOND
) -> Path:
    """Write a film of a scene beside the curves of a panel; see `animate`, which checks what it is given."""
    if path.suffix.lower() not in FORMATS:
        raise ScenarioError(f"{path}: the name of a film must end in {' or '.join(FORMATS)}")
    run = scene.run
    if len(run) < 2:
        raise ScenarioError(f"{run.scenario.name}: the run has {len(run)} rows: there is nothing to show")
    if not (0.0 < speed < 1e6 and 1 <= frames_per_second <= 100):
        raise ScenarioError(
            f"speed = {speed:g}, frames_per_second = {frames_per_second}: must be above 0, and from 1 to 100"
        )
    count = max(2, round(float(run.time[-1]) / speed * frames_per_second) + 1)
    instants = np.minimum(np.arange(min(count, MOST_FRAMES + 1)) * speed / frames_per_second, run.time[-1])
    rows = np.minimum(np.round(instants / run.scenario.time.step), len(run) - 1).astype(np.int64)
    if rows.size > MOST_FRAMES:
        raise ScenarioError(f"speed = {speed:g}: the film would have {rows.size} frames, over {MOST_FRAMES}")
    ffmpeg = ffmpeg_program() if path.suffix.lower() == ".mp4" else ""
    if ffmpeg is None:
        raise OutputError(f"{path}: {NEEDS_FFMPEG}")
    import matplotlib as mpl

    with mpl.rc_context(OWN):
        picture = Picture(scene, panel)
        film = _mp4(picture, rows, frames_per_second, ffmpeg) if ffmpeg else _gif(picture, rows, frames_per_second)
    return write_whole(path, film)


def _gif(picture: Picture, rows: NDArray[np.int64], frames_per_second: int) -> bytes:
    """Return a GIF: all frames share one palette, and no colour is mixed from dots of others.

    A pixel that stays as it was is transparent: long runs of one value are written in few bytes.
    """
    from PIL import Image

    def image(row: int) -> Any:
        pixels = picture.pixels(row)
        return Image.frombuffer("RGBA", pixels.shape[1::-1], pixels, "raw", "RGBA", 0, 1).convert("RGB")

    some = np.vstack([np.asarray(image(int(row))) for row in (rows[0], rows[len(rows) // 2], rows[-1])])
    palette = Image.fromarray(some).quantize(COLOURS)
    listed = (palette.getpalette() or [])[: 3 * COLOURS]
    listed += listed[:3] * (256 - len(listed) // 3)  # the rest are the first colour again
    palette.putpalette(listed)

    def changes() -> Iterator[Any]:
        before: NDArray[np.uint8] | None = None
        for row in rows:
            frame = image(int(row)).quantize(palette=palette, dither=Image.Dither.NONE)
            now = np.asarray(frame)
            now = np.where(now == UNCHANGED, np.uint8(0), now)
            frame = Image.fromarray(now if before is None else np.where(now == before, np.uint8(UNCHANGED), now))
            frame.putpalette(listed)
            before = now
            yield frame

    frames, film = changes(), io.BytesIO()
    more = {"duration": 1000.0 / frames_per_second, "loop": 0, "transparency": UNCHANGED, "disposal": 1}
    next(frames).save(film, "GIF", save_all=True, append_images=frames, optimize=False, **more)
    return film.getvalue()


def _mp4(picture: Picture, rows: NDArray[np.int64], frames_per_second: int, ffmpeg: str) -> bytes:
    """Return a .mp4 by the program ffmpeg, which reads the frames as they are drawn."""
    height, width, _ = picture.pixels(int(rows[0])).shape
    with tempfile.TemporaryDirectory(prefix="closedloop-") as folder:
        file = Path(folder) / "film.mp4"
        command = [
            ffmpeg, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{width}x{height}",
            "-r", str(frames_per_second), "-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p", str(file),
        ]  # fmt: skip
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as program:
            assert program.stdin is not None
            assert program.stderr is not None
            try:
                for row in rows:
                    program.stdin.write(picture.pixels(int(row)).tobytes())
                program.stdin.close()
            except BrokenPipeError:
                pass
            said = program.stderr.read().decode(errors="replace").strip()
        if program.returncode:
            why = said.splitlines()[-1] if said else "it says nothing"
            raise OutputError(f"ffmpeg could not write the film: {why}")
        return file.read_bytes()
