"""What an environment shows: a picture drawn without a display, or the arm in the browser."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.figures.scene.scene import ARROWS, PATH, WANTED, quaternions, round_down
from closedloop.figures.scene.shapes import Shape, robot_shapes
from closedloop.gym.core import Core
from closedloop.simulation.engines.problem import Problem
from robot_models.cached import cached_property
from robot_models.coordinates import in_pinocchios_order, with_quaternions

Array = NDArray[np.float64]

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
        import pinocchio as pin

        self._pin: Any = pin
        self.model = problem.robot.model
        self.mechanism: Any = self.model.pinocchio_model()
        self._data = self.mechanism.createData()
        self._tip = problem.robot.tip
        self.scale = round_down(LONGEST * problem.robot.reach / max(abs(problem.scenario.law.force), 1.0))

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The shapes of the links."""
        return robot_shapes(self.model, self._tip)

    def places(self, q: Array) -> tuple[Array, Array]:
        """Return the axes (k, 3, 3) and origins (k, 3) of the base and each joint."""
        given = in_pinocchios_order(with_quaternions(q, self.model.joint_types), self.model.joint_types)
        self._pin.forwardKinematics(self.mechanism, self._data, np.ascontiguousarray(given))
        places = list(self._data.oMi)
        return np.array([p.rotation for p in places]), np.array([p.translation for p in places])


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

        self._core = core
        self._arm: _Arm | None = None
        self._figure: Any = Figure(figsize=SIZE, dpi=DOTS)
        self._canvas: Any = FigureCanvasAgg(self._figure)
        self._axes: Any = self._figure.add_axes((0.0, 0.0, 0.74, 1.0), projection="3d")
        self._bar: Any = self._figure.add_axes((0.86, 0.12, 0.1, 0.76))

    def show(self, i: int) -> NDArray[np.uint8]:
        """Return the picture of environment `i`."""
        from matplotlib import rc_context

        with rc_context({"font.size": 9}):
            self._draw(i)
            self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _draw(self, i: int) -> None:
        core, axes, now = self._core, self._axes, self._core.now
        problem = core.together.problem(i)
        arm = self._arm
        if arm is None or arm.model is not problem.robot.model:
            arm = self._arm = _Arm(problem)
        axes.clear()
        _, origins = arm.places(now.q[i])
        tip = now.tip[i]
        line = np.vstack([origins[1:], tip])
        axes.plot(*line.T, color="0.35", linewidth=5.0, marker="o", markersize=7.0, markerfacecolor="0.75")
        if problem.scenario.has_surface:
            x, y, z = patch(problem, core.together.problem(i).robot.position(problem.q))
            axes.plot_surface(x, y, z, color="0.8", alpha=0.45, edgecolor="0.6", linewidth=0.4)
        path = problem.table[:, 2 * problem.robot.n : 2 * problem.robot.n + 3]
        axes.plot(*path[:: max(1, len(path) // TRAIL)].T, color=WANTED, linewidth=1.0)
        axes.scatter(*now.wanted_tip[i][:, None], color=PATH, s=12)
        for force, kind in ((now.force[i] * now.normal[i], "contact force"), (now.friction_force[i], "friction")):
            axes.quiver(*tip, *(arm.scale * force), color=ARROWS[kind], linewidth=2.0, arrow_length_ratio=0.15)
        middle, half = 0.5 * (line.min(axis=0) + line.max(axis=0)), 0.5 * np.ptp(line, axis=0).max() + 0.05
        axes.set(
            xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half),
            zlim=(middle[2] - half, middle[2] + half), xlabel="x in m", ylabel="y in m", zlabel="z in m",
        )  # fmt: skip
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(20.0, -60.0)
        axes.text2D(0.03, 0.95, f"t = {now.time[i]:.2f} s", transform=axes.transAxes)
        wanted, bar = float(now.wanted_force[i]), self._bar
        bar.clear()
        bar.bar([0.0], [now.force[i]], color=ARROWS["contact force"], width=0.8)
        bar.axhline(wanted, color=WANTED, linewidth=2.0)
        bar.set(xlim=(-0.6, 0.6), ylim=(0.0, max(2.0 * abs(wanted), 1.0)), xticks=[], title="force in N")

    def close(self) -> None:
        """Let the figure go."""
        self._figure.clear()


class Browser:
    """The arm in the browser, as in the lab: a page on this computer alone, brought up to date at each step."""

    def __init__(self, core: Core) -> None:
        from closedloop.lab.server import new_token, serve

        self._core, token = core, new_token()
        self._server = serve("127.0.0.1", 8080, token)
        print(f"closedloop.gym: http://127.0.0.1:{self._server.get_port()}/?token={token}", flush=True)
        self._arm: _Arm | None = None
        self._frames: list[Any] = []
        self._problem: Problem | None = None

    def show(self, i: int) -> None:
        """Bring the page up to date with environment `i`."""
        problem, now = self._core.together.problem(i), self._core.now
        if problem is not self._problem:
            self._begin(problem)
        assert self._arm is not None
        axes, origins = self._arm.places(now.q[i])
        turned = quaternions(axes)
        tip = now.tip[i]
        ends = [tip + self._arm.scale * force for force in (now.force[i] * now.normal[i], now.friction_force[i])]
        with self._server.atomic():
            for frame, place, quaternion in zip(self._frames, origins, turned, strict=True):
                frame.position, frame.wxyz = place, quaternion
            colours = np.array([ARROWS["contact force"], ARROWS["friction"]])
            self._server.scene.add_line_segments(
                "/forces", np.array([[tip, end] for end in ends]), np.repeat(colours[:, None, :], 2, axis=1),
                line_width=5.0,
            )  # fmt: skip

    def _begin(self, problem: Problem) -> None:
        import trimesh

        self._problem, self._arm = problem, _Arm(problem)
        scene = self._server.scene
        scene.reset()
        self._frames = [scene.add_frame(f"/joint {j}", show_axes=False) for j in range(self._arm.mechanism.njoints)]
        for k, shape in enumerate(self._arm.shapes):
            scene.add_mesh_simple(
                f"/joint {shape.joint}/shape {k}", shape.vertices, shape.faces,
                color=tuple(round(255 * c) for c in shape.colour),
            )  # fmt: skip
        if problem.scenario.has_surface:
            x, y, z = patch(problem, problem.robot.position(problem.q))
            points, side = np.stack([x, y, z], axis=-1).reshape(-1, 3), SQUARES + 1
            corner = (np.arange(SQUARES)[:, None] * side + np.arange(SQUARES)).ravel()
            faces = np.vstack([
                np.column_stack([corner, corner + side, corner + 1]),
                np.column_stack([corner + 1, corner + side, corner + side + 1]),
            ])  # fmt: skip
            faces = faces[np.isfinite(points[faces]).all(axis=(1, 2))]
            mesh = trimesh.Trimesh(np.nan_to_num(points), faces, process=False)
            scene.add_mesh_simple("/surface", mesh.vertices, mesh.faces, color=(200, 200, 200), side="double")

    def close(self) -> None:
        """Close the page."""
        self._server.stop()


def view_of(render_mode: str, core: Core) -> Any:
    """Return what shows the environments: `show(i)` and `close()`."""
    return Picture(core) if render_mode == "rgb_array" else Browser(core)
