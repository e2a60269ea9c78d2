"""The scene of the lab in viser: the arm, the surface, the paths, the events, and arrows for the forces."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.figures.scene.ground import thin_out
from closedloop.figures.scene.scene import ARROWS, JOINTS, LOOP, PATH, TOUCH, WANTED, Scene, quaternions

Array = NDArray[np.float64]

EVENTS = {
    "impact": (230, 159, 0), "touchdown": (0, 114, 178), "liftoff": (86, 180, 233), "stick": (213, 94, 0),
    "slip": (0, 158, 115), "reversal": (204, 121, 167), "edge": (0, 0, 0), "stop": (120, 120, 120),
    "release": (120, 120, 120),
    "time_step": (120, 120, 120),
}  # fmt: skip
# Colours of arrows that come out as those of `ARROWS`, which the legend has: the page's tone mapping turns blue into
# teal and orange into brown. Found by trying, and read from the page.
AS_SEEN = {
    "contact force": (0, 90, 215), "friction": (250, 55, 0), "commanded force": (0, 155, 90), LOOP: (250, 130, 0),
    TOUCH: (30, 165, 250),
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
        self._marks: list[Any] = []
        self._hiding: list[Any] = []
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
            turns, places = scene.joined.places(axes, origins)
            for node, turn, place in zip(self._marks, quaternions(turns), places, strict=True):
                node.wxyz, node.position = turn, place
            turn, shift = scene.ground.place(row)
            self._nodes["surface"].wxyz, self._nodes["surface"].position = quaternions(turn[None])[0], shift
            (arrows,) = scene.arrows([row])
            for kind in ARROWS:
                self._draw_arrows(kind, [(a.tail, a.force) for a in arrows if a.kind == kind], scene.size)

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
            if name in self._nodes and (hidden or name not in ARROWS):
                self._nodes[name].visible = not hidden
            if name == JOINTS:
                for mark in self._marks:
                    mark.visible = not hidden

    def _draw_robot(self, scene: Scene) -> None:
        for node in (*self._joints, *self._marks):
            node.remove()
        self._shapes = scene.shapes
        count = len(scene.joint_places(0)[0])
        self._hiding = []
        self._joints = [self._api.add_frame(f"/arm/{k}", show_axes=False) for k in range(count)]
        for at, shape in enumerate(scene.shapes):
            hides = shape.joint in scene.hiding
            mesh = self._api.add_mesh_simple(
                f"/arm/{shape.joint}/shape{at}", shape.vertices, shape.faces,
                color=tuple(round(255 * c) for c in shape.colour), side="double", flat_shading=len(shape.faces) > 20,
                cast_shadow=False, receive_shadow=False, opacity=self._opacity if hides else None,
            )  # fmt: skip
            if hides:
                self._hiding.append(mesh)

        self._marks = [self._api.add_frame(f"/loops/{k}", show_axes=False) for k in range(len(scene.joined.loops))]
        for k, loop in enumerate(scene.joined.loops):
            self._marks[k].visible = JOINTS not in self.hidden
            self._api.add_mesh_simple(
                f"/loops/{k}/mark", loop.shape.vertices, loop.shape.faces, flat_shading=True, cast_shadow=False,
                color=tuple(round(255 * c) for c in loop.shape.colour), receive_shadow=False,
            )  # fmt: skip

    def see_through(self, through: bool) -> None:
        """Draw the links that hide forces on them so that these are seen, or not."""
        with self._lock:
            self._opacity = 0.35 if through else None
            for mesh in self._hiding:
                mesh.opacity = self._opacity

    def _draw_surface(self, scene: Scene) -> None:
        vertices, faces = scene.surface
        node = self._nodes.get("surface")
        if not len(faces):  # an empty mesh is none that viser takes
            vertices, faces = np.zeros((3, 3)), np.zeros((1, 3), dtype=np.uint32)
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
        node = self._nodes.get("events")
        if not scene.marks:
            if node is not None:
                self._nodes.pop("events").remove()
            return
        points = np.array([mark.position for mark in scene.marks], dtype=np.float32)
        colours = np.array([EVENTS[mark.kind] for mark in scene.marks], dtype=np.uint8)
        if node is not None:  # made anew it would have its shader compiled again
            node.points, node.colors = points, colours
            return
        self._nodes["events"] = self._api.add_point_cloud(
            "/events", points, colours, point_size=0.006 * scene.size, point_shape="circle", precision="float32",
            visible="events" not in self.hidden,
        )  # fmt: skip

    def _draw_arrows(self, kind: str, forces: list[tuple[Array, Array]], size: float) -> None:
        """Draw the forces of a kind, each as where it acts and what it is; those too short to be seen are left out."""
        assert self.metres_per_newton is not None
        ends = np.array([(tail, tail + self.metres_per_newton * force) for tail, force in forces]).reshape(-1, 2, 3)
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        drawn = ends[np.isfinite(lengths) & (lengths > SHORTEST * size)].astype(np.float32)
        seen = len(drawn) > 0 and kind not in self.hidden
        node = self._nodes.get(kind)
        if node is None:
            if not forces:
                return
            node = self._nodes[kind] = self._api.add_arrows(
                f"/{kind}", np.zeros((1, 2, 3), dtype=np.float32), AS_SEEN[kind],
                shaft_radius=0.006 * size, head_radius=0.014 * size, head_length=0.035 * size, visible=False,
            )  # fmt: skip
        if seen:
            node.points = drawn
        if node.visible != seen:
            node.visible = seen
