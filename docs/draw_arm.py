"""Draw docs/wam_touchdown.png, the picture of the README: the arm on its surface, and the contact force.

python docs/draw_arm.py
"""

import io
from pathlib import Path

import numpy as np
import yourdfpy
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import closedloop as cl
from closedloop.figures.style import COLOURS, STYLE

HERE = Path(__file__).resolve().parent
LIGHT = np.array([0.35, -0.5, 0.8])
METRES_PER_NEWTON = 0.022  # length of the arrow
ROW = 5000  # t = 5 s: it presses and slides


def arm_triangles(run: cl.Run, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the shapes of the robot's file at a row of the run: triangles (N, 3, 3), m, and their colours (N, 3)."""
    urdf = yourdfpy.URDF.load(io.BytesIO(run.model.text.encode()), load_meshes=False)
    urdf.update_cfg(dict(zip(run.model.joint_names, run.q[row], strict=True)))
    triangles, colours = [], []
    for node in urdf.scene.graph.nodes_geometry:
        pose, name = urdf.scene.graph.get(node)
        mesh = urdf.scene.geometry[name]
        triangles.append(mesh.triangles @ pose[:3, :3].T + pose[:3, 3])
        light = 0.62 + 0.38 * np.clip(mesh.face_normals @ pose[:3, :3].T @ (LIGHT / np.linalg.norm(LIGHT)), -0.6, 1.0)
        colours.append(light[:, None] * mesh.visual.face_colors[:, :3] / 255.0)
    return np.concatenate(triangles), np.clip(np.concatenate(colours), 0.0, 1.0)


def draw_arm(axes: Axes3D, run: cl.Run, row: int) -> None:
    """Draw the arm at a row of the run, the surface under it, the path of the tip and the force on it."""
    tip, ground = run.position[row], run.position[row, 2]
    triangles, colours = arm_triangles(run, row)
    (left, right), (near, far) = (-0.28, 0.28), (tip[1] - 0.22, tip[1] + 0.24)
    board = [[(left, near, ground), (right, near, ground), (right, far, ground), (left, far, ground)]]
    axes.add_collection3d(
        Poly3DCollection(board, facecolor="#C9D6DF", edgecolor="0.45", linewidth=0.8, zorder=1, clip_on=False)
    )
    axes.plot(*run.position.T, color=COLOURS[2], linewidth=2.5, zorder=2)
    axes.text(0.16, tip[1] - 0.1, ground, "path of the tip", color=COLOURS[2], zorder=6)
    axes.add_collection3d(
        Poly3DCollection(triangles, facecolor=colours, edgecolor=colours, linewidth=0.4, zorder=3, clip_on=False)
    )
    axes.plot(*tip, marker="o", color=COLOURS[1], markersize=5, zorder=7)
    force = METRES_PER_NEWTON * run.contact_force[row] * run.surface_normal[row]
    axes.quiver(*tip, *force, color=COLOURS[1], linewidth=2.5, arrow_length_ratio=0.25, zorder=7)
    axes.text(*(tip + force + (0.0, 0.07, 0.0)), f"f = {run.contact_force[row]:.0f} N", color=COLOURS[1], zorder=8)
    points = np.concatenate([triangles.reshape(-1, 3), board[0]])
    low, high = points.min(axis=0), points.max(axis=0)
    for axis, a, b in zip("xyz", low, high, strict=True):
        getattr(axes, f"set_{axis}lim")(a, b)
    axes.set_box_aspect(high - low, zoom=1.12)
    axes.view_init(elev=17, azim=-22)
    axes.set_axis_off()


def draw_force(axes: Axes, run: cl.Run) -> None:
    """Draw the contact force against time, and what happens to the contact."""
    axes.plot(run.time, run.contact_force, color=COLOURS[1], linewidth=1.4)
    axes.axhline(run.scenario.law.force, color="0.3", linestyle=":", linewidth=1)
    touch = next(event.time for event in run.events if event.kind == "touchdown")
    slide = run.scenario.reference.times[-2]
    for start, stop, text in ((0.0, touch, "comes\ndown"), (touch, slide, "presses"), (slide, run.time[-1], "slides")):
        axes.axvline(start, color="0.6", linewidth=0.8)
        axes.text((start + stop) / 2, 5.0, text, ha="center", va="center", color="0.3")
    axes.set(xlabel="t [s]", ylabel="f [N]", title="Contact force f", xlim=(0, run.time[-1]))


def main() -> None:
    """Simulate wam_touchdown and write the picture."""
    run = cl.simulate(cl.load_scenario("wam_touchdown"))
    with rc_context(STYLE):
        figure = Figure(figsize=(9.6, 4.2))
        draw_arm(figure.add_axes((-0.07, -0.02, 0.64, 1.04), projection="3d", computed_zorder=False), run, ROW)
        draw_force(figure.add_axes((0.58, 0.14, 0.4, 0.76)), run)
        figure.savefig(HERE / "wam_touchdown.png", dpi=120, metadata={"Software": ""})


if __name__ == "__main__":
    main()
