"""The scene of the lab in viser: the arm, the surface, the paths, the events, and arrows for the forces."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.lab.scene import ARROWS, PATH, WANTED, Scene, quaternions, thin_out

Array = NDArray[np.float64]

EVENTS = {
    "impact": (230, 159, 0), "touchdown": (0, 114, 178), "liftoff": (86, 180, 233), "stick": (213, 94, 0),
    "slip": (0, 158, 115), "reversal": (204, 121, 167), "edge": (0, 0, 0),
}  # fmt: skip
SURFACE = (196, 205, 214)
# An arrow shorter than this share of the arm's reach is not drawn.
SHORTEST = 2e-3


class Space:
    """What viser draws of a scene.

    Parameters
    ----------
    api : viser.SceneApi
    """

    def __init__(self, api: Any) -> None:
        self._api, self._lock = api, threading.RLock()
        self._scene: Scene | None = None
        self._shapes: tuple[Any, ...] = ()
        self._joints: list[Any] = []
        self._last_link: list[Any] = []
        self._opacity: float | None = None
        self._nodes: dict[str, Any] = {}
        self.metres_per_newton: float | None = None
        self.hidden: set[str] = set()
        api.configure_environment_map(None)
        api.configure_default_lights(False)
        # No brighter: the arrows' colours would be others than those of the legend.
        api.add_light_ambient("/light", intensity=0.9)
        api.add_light_directional("/sun", intensity=1.1, position=(1.0, -1.0, 2.0))
        api.add_light_directional("/sky", intensity=0.5, position=(-1.5, 1.0, 1.0))

    @property
    def scene(self) -> Scene | None:
        """The scene shown."""
        return self._scene

    def show_scene(self, scene: Scene, row: int) -> None:
        """Draw another scene at a row of its run."""
        with self._lock:
            if scene.shapes is not self._shapes:
                self._draw_robot(scene)
            self._scene = scene
            if self.metres_per_newton is None:
                self.metres_per_newton = scene.metres_per_newton
            self._draw_surface(scene)
            self._draw_path("actual path", thin_out(scene.run.position), PATH, 2.5)
            self._draw_path("desired path", thin_out(scene.run.reference_tip), WANTED, 1.5)
            self._draw_events(scene)
            self.move(row)

    def move(self, row: int) -> None:
        """Show another row of the run."""
        with self._lock:
            scene = self._scene
            if scene is None:
                return
            axes, origins = scene.joint_places(row)
            for node, turn, place in zip(self._joints, quaternions(axes), origins, strict=True):
                node.wxyz, node.position = turn, place
            turn, shift = scene.surface_place(row)
            self._nodes["surface"].wxyz, self._nodes["surface"].position = quaternions(turn[None])[0], shift
            for arrow in scene.arrows(row):
                self._draw_arrow(arrow.name, arrow.tail, arrow.force, scene.size)

    def pinned(self, paths: list[tuple[str, tuple[float, float, float], Array]]) -> None:
        """Draw the tip paths (N, 3) of pinned runs, each with a name and a colour; take away the others."""
        with self._lock:
            for name in [n for n in self._nodes if n.startswith("pinned ")]:
                self._nodes.pop(name).remove()
            for name, colour, points in paths:
                self._draw_path(f"pinned {name}", thin_out(points), colour, 2.0)

    def hide(self, name: str, hidden: bool) -> None:
        """Hide an arrow or a path, or show it again."""
        with self._lock:
            (self.hidden.add if hidden else self.hidden.discard)(name)
            if name in self._nodes and hidden:
                self._nodes[name].visible = False
            elif name in self._nodes and name not in ARROWS:
                self._nodes[name].visible = True

    def _draw_robot(self, scene: Scene) -> None:
        for node in self._joints:
            node.remove()
        self._shapes = scene.shapes
        count = scene.run.model.n + 1
        self._last_link = []
        self._joints = [self._api.add_frame(f"/arm/{k}", show_axes=False) for k in range(count)]
        for at, shape in enumerate(scene.shapes):
            last = shape.joint == scene.last_joint
            mesh = self._api.add_mesh_simple(
                f"/arm/{shape.joint}/shape{at}", shape.vertices, shape.faces,
                color=tuple(round(255 * c) for c in shape.colour), side="double", flat_shading=len(shape.faces) > 20,
                cast_shadow=False, receive_shadow=False, opacity=self._opacity if last else None,
            )  # fmt: skip
            if last:
                self._last_link.append(mesh)

    def see_through(self, through: bool) -> None:
        """Draw the last link so that the force inside of it is seen, or not."""
        with self._lock:
            self._opacity = 0.35 if through else None
            for mesh in self._last_link:
                mesh.opacity = self._opacity

    def _draw_surface(self, scene: Scene) -> None:
        vertices, faces = scene.surface
        node = self._nodes.get("surface")
        if node is not None and len(node.vertices) == len(vertices):
            node.vertices = vertices.astype(np.float32)
            return
        if node is not None:
            node.remove()
        self._nodes["surface"] = self._api.add_mesh_simple(
            "/surface", vertices.astype(np.float32), faces, color=SURFACE, opacity=0.75, side="double",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _draw_path(self, name: str, points: Array, colour: tuple[float, float, float], width: float) -> None:
        if len(points) < 2:
            points = np.vstack([points, points])
        segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        node = self._nodes.get(name)
        if node is not None:
            node.points = segments
            return
        self._nodes[name] = self._api.add_line_segments(
            f"/{name}", segments, tuple(round(255 * c) for c in colour), thickness=width, thickness_units="screen",
            visible=name not in self.hidden,
        )  # fmt: skip

    def _draw_events(self, scene: Scene) -> None:
        node = self._nodes.pop("events", None)
        if node is not None:
            node.remove()
        if not scene.marks:
            return
        points = np.array([mark.position for mark in scene.marks], dtype=np.float32)
        colours = np.array([EVENTS[mark.kind] for mark in scene.marks], dtype=np.uint8)
        self._nodes["events"] = self._api.add_point_cloud(
            "/events", points, colours, point_size=0.012 * scene.size, point_shape="circle", precision="float32",
            visible="events" not in self.hidden,
        )  # fmt: skip

    def _draw_arrow(self, name: str, tail: Array, force: Array, size: float) -> None:
        assert self.metres_per_newton is not None
        tip = tail + self.metres_per_newton * force
        length = float(np.linalg.norm(tip - tail))
        seen = bool(np.isfinite(length)) and length > SHORTEST * size and name not in self.hidden
        node = self._nodes.get(name)
        if node is None:
            node = self._nodes[name] = self._api.add_arrows(
                f"/{name}", np.zeros((1, 2, 3), dtype=np.float32), tuple(round(255 * c) for c in ARROWS[name]),
                shaft_radius=0.006 * size, head_radius=0.014 * size, head_length=0.035 * size, visible=False,
            )  # fmt: skip
        if seen:
            node.points = np.array([[tail, tip]], dtype=np.float32)
        if node.visible != seen:
            node.visible = seen
