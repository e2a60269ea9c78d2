"""The picture of a film: bodies, surface, paths and forces in space, beside curves over time.

What stands still is drawn once. For each frame it is copied, and what moves is drawn over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.scene.scene import ARROWS, PATH, WANTED, Scene
from closedloop.figures.scene.solids import COLOUR, OPACITY, Shape
from closedloop.figures.style import widen
from closedloop.lab.curves import Panel

# Inches, and dots for each: 1000 by 500 pixels; without curves 560 by 460.
SIZE, ALONE, DOTS = (10.0, 5.0), (5.6, 4.6), 100
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
    """The figure of a film, whose parts move; without a panel of curves that of space alone, without title or clock."""

    def __init__(self, scene: Scene, panel: Panel | None) -> None:
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
        self._arrows = {kind: self._line("-", ARROWS[kind], 2) for kind in scene.kinds}
        self._done = self._line("-", PATH, 2)
        wanted = run.reference_tip[:: max(1, len(run) // 400)]
        if np.ptp(wanted, axis=0).max() > 0.0:
            self._space.plot(*wanted.T, "--", color=WANTED, linewidth=1)
        vertices, faces = scene.surface
        if len(faces):
            self._space.plot_trisurf(*vertices.T, triangles=faces, color="0.8", alpha=0.4, linewidth=0.0)
        if scene.marks:
            self._space.scatter(*np.array([mark.position for mark in scene.marks]).T, color="#CC79A7", s=12)
        self._frame_view()
        self._draw_legend()
        self._moving, self._cursor = [self._done, *self._arrows.values()], None
        if panel:
            self._cursor = self._draw_curves(figure.add_subplot(grid[1]), panel)
            figure.suptitle(self._title())
            self._clock = figure.text(0.985, 0.965, "", ha="right", family="monospace")
            self._moving += [self._cursor, self._clock]
        for part in self._moving:
            part.set_animated(True)  # left out of what is drawn once
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)

    def pixels(self, row: int) -> NDArray[np.uint8]:
        """Return the picture of a row of the run: red, green, blue and opacity of its pixels (height, width, 4)."""
        scene, run, there = self.scene, self.scene.run, self.scene.joint_places(row)
        self._canvas.restore_region(self._still)
        self._done.set_data_3d(*run.position[: row + 1 : max(1, row // 300)].T)
        (arrows,) = scene.arrows([row])
        for kind, line in self._arrows.items():  # one line for all of a kind, with a gap after each
            ends = [(a.tail, a.tail + scene.metres_per_newton * a.force, GAP) for a in arrows if a.kind == kind]
            line.set_data_3d(*np.reshape(ends, (-1, 3)).T)
        if self._cursor:
            self._cursor.set_xdata([run.time[row]] * 2)
            self._clock.set_text(f"t = {run.time[row]:.3f} s")
        ghosts = [(solids, ghost.place(float(run.time[row]))) for ghost, solids in self._ghosts]
        seen = [self._solid.seen(self._space, *there)]
        seen += [solids.seen(self._space, turn[None], origin[None]) for solids, (turn, origin) in ghosts]
        renderer = self._canvas.get_renderer()
        for solids in seen:
            renderer.draw_image(renderer.new_gc(), *np.round(self._space.bbox.p0), solids)
        for part in self._moving:
            part.draw(renderer)
        return np.array(self._canvas.buffer_rgba())

    def _line(self, style: str, colour: Any, width: float, **more: Any) -> Any:
        return self._space.plot([], [], [], style, color=colour, linewidth=width, **more)[0]

    def _title(self) -> str:
        run, scale = self.scene.run, f"10 N = {10.0 * self.scene.metres_per_newton:.2g} m"
        name = run.scenario.name
        robot = "" if run.model.name in ("none", name) else f" ({run.model.name})"
        return f"{name}{robot}, {scale}"

    def _draw_legend(self) -> None:
        parts: list[Any] = [Line2D([], [], color=ARROWS[kind], linewidth=2, label=kind) for kind in self.scene.kinds]
        parts += [Patch(color=COLOUR, alpha=OPACITY, label=ghost.name) for ghost in self.scene.ghosts]
        self._space.legend(handles=parts, loc="upper left", fontsize=8)

    def _draw_curves(self, plot: Any, panel: Panel) -> Any:
        """Draw the curves, and return the line that marks the instant."""
        for trace in panel.traces:
            style = "--" if trace.limit else "-"
            named = not trace.limit or len(panel.traces) <= MOST_NAMED
            plot.plot(
                panel.time, trace.values, style, color=trace.colour, linewidth=1.2, label=trace.label if named else None
            )
        widen(plot, FINEST * max(abs(end) for end in plot.get_ylim()))
        plot.set(xlabel="time [s]", ylabel=panel.title)
        handles, names = plot.get_legend_handles_labels()
        plot.legend(handles[:MOST_NAMED], names[:MOST_NAMED], fontsize=8)
        return plot.axvline(0.0, color="0.3", linewidth=1)

    def _frame_view(self) -> None:
        """Give the axes one scale, and the size of all that is drawn in them."""
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
        middle, half = (low + high) / 2.0, 0.55 * float((high - low).max()) + 1e-3
        space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        space.set(**{f"{axis}lim": (m - half, m + half) for axis, m in zip("xyz", middle, strict=True)})
        space.set_box_aspect((1, 1, 1))
        space.view_init(elev=22.0, azim=-35.0)


class Solids:
    """Shapes as triangles, of which the nearest is seen at each point of the picture.

    Parameters
    ----------
    colour : three floats, optional
        Of all, in place of their own.
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

    Parameters
    ----------
    corners : (k, 3, 3) array
        x to the right and y upwards, points of the picture; depth, larger is farther.
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
