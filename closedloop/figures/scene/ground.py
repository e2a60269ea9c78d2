"""The surface that the tip touches, in space: a patch around the paths, or the whole of one that has an edge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.figures.motion import frame_of
from closedloop.figures.scene.solids import solids_mesh
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.mechanics.surface.surface import Surface
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from robot_models.cached import cached_property
from robot_models.loop_joint import WORLD

# The patch of the surface reaches this far beyond the path, m, or a share of the path's size.
MARGIN, SHARE = 0.06, 0.3
# And a floor that links touch this share of the size of what is on it.
FLOOR = 0.5
# A surface that the tip never comes so near, m, is out of the way: the arms hold each other or a thing.
FAR = 1.0
# Vertices along a side of a curved surface.
CELLS = 32


@dataclass(frozen=True)
class Ground:
    """The surface of a run in space."""

    run: Run

    @cached_property
    def frame(self) -> Array:
        """The contact frame at the surface's origin (3, 3): rows n, t1, t2, base axes."""
        return frame_of(self.run)

    @cached_property
    def placed(self) -> PlacedSurface | None:
        """The surface in its place; None if it is a user's class in a run file, not named in this process."""
        scenario, start = self.run.scenario, self.run.position[0]
        if not (isinstance(scenario.surface, Surface) and isinstance(scenario.surface_motion, SurfaceMotion)):
            return None
        radius, depth = scenario.tool.radius, 0.0
        found = PlacedSurface.of(scenario.surface, scenario.surface_motion, start, depth, radius)
        for _ in range(20 if found.below_start else 0):  # a tip that starts in a soft surface, which may slope there
            off = found.touching(start).gap - float(self.run.closure_error[0])
            if abs(off) < 1e-12:
                break
            depth += off
            found = PlacedSurface.of(scenario.surface, scenario.surface_motion, start, depth, radius)
        return replace(found, radius=0.0)

    @cached_property
    def mesh(self) -> tuple[Array, NDArray[np.uint32]]:
        """The surface around both paths at t = 0: vertices (k, 3), m, base frame, and triangles (l, 3)."""
        flat = self.placed is None or isinstance(self.placed.section, PlaneSurface)
        if self.placed is not None and self.placed.ends:
            return _whole(self.placed, 2 if flat else CELLS)
        along = np.vstack([thin_out(path) for path in (self.run.position, self.run.reference_tip)]) @ self.frame[1:].T
        low, high = along.min(axis=0), along.max(axis=0)
        offset = float(self.frame[0] @ self.run.position[0] - self.run.closure_error[0])
        offset -= self.run.scenario.tool.radius
        for share in (1.0, 0.5, 0.2, 0.0):  # a ball may be smaller than what is around the path
            margin = share * max(MARGIN, SHARE * float(np.max(high - low)))
            a, b = (np.linspace(x - margin, y + margin, 2 if flat else CELLS) for x, y in zip(low, high, strict=True))
            grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
            vertices = grid @ self.frame[1:] + offset * self.frame[0]
            if flat or self.placed is None:
                break
            none = np.zeros_like(vertices)
            try:
                vertices = self.placed.follow(0.0, np.zeros(len(vertices)), (vertices, none, none))[0]
                break
            except ScenarioError:
                continue
        return vertices, grid_triangles(a.size, b.size)

    @property
    def there(self) -> bool:
        """Whether it is part of what is seen: the tip touches it, or comes near it."""
        if not self.run.scenario.has_surface:
            return False
        return bool(np.any(self.run.mode != FREE)) or float(np.min(self.run.closure_error)) < FAR

    def place(self, row: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and the shift (3,), m, by which the surface is displaced in a row."""
        if self.placed is None:
            return np.eye(3), np.zeros(3)
        return self.placed.displacement(float(self.run.time[row]))


def world_mesh(scenario: Scenario, points: Array, touched: list[Array]) -> tuple[Array, NDArray[np.uint32]]:
    """Return what of the world links touch: a plane about points (k, 3), m, and bodies about the points touched, m."""
    vertices, faces = floor_mesh(scenario, points)
    if not touched:
        return vertices, faces
    walls, more = solids_mesh(scenario, np.array(touched))
    return np.vstack([vertices, walls]), np.vstack([faces, more + np.uint32(len(vertices))])


def floor_mesh(scenario: Scenario, points: Array) -> tuple[Array, NDArray[np.uint32]]:
    """Return the plane of the world that links touch, below and around points (k, 3), m, as two triangles.

    Empty where no contact is with such a plane.
    """
    for section in scenario.contact or ():
        if section.against == WORLD and (section.surface is None or section.surface.kind == "plane"):
            frame, through = contact_frame(unit(section.normal, "normal")), np.array(section.through)
            along = (points - through) @ frame[1:].T
            low, high = along.min(axis=0), along.max(axis=0)
            margin = max(MARGIN, FLOOR * float(np.max(high - low)))
            corners = [(x, y) for x in (low[0] - margin, high[0] + margin) for y in (low[1] - margin, high[1] + margin)]
            return through + np.array(corners) @ frame[1:], grid_triangles(2, 2)
    return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint32)


def _whole(placed: PlacedSurface, cells: int) -> tuple[Array, NDArray[np.uint32]]:
    """Return a surface that has an edge, as far as it goes: a rectangle, or a disc, of so many cells a side."""
    a, b = placed.section.bounds()
    if b > 0.0:
        x, y = np.linspace(-a, a, cells), np.linspace(-b, b, cells)
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        sides = cells, cells
    else:
        far, round_it = np.meshgrid(np.linspace(0.0, a, cells), np.linspace(0.0, 2.0 * np.pi, CELLS), indexing="ij")
        grid = np.stack([far * np.cos(round_it), far * np.sin(round_it)], axis=-1).reshape(-1, 2)
        sides = cells, CELLS
    vertices = placed.origin + grid @ placed.frame[1:]
    none = np.zeros_like(vertices)
    return placed.follow(0.0, np.zeros(len(vertices)), (vertices, none, none))[0], grid_triangles(*sides)


def grid_triangles(rows: int, columns: int) -> NDArray[np.uint32]:
    """Return the triangles (2 (rows − 1)(columns − 1), 3) of a grid of vertices, row after row."""
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corner = first[:, None]
    halves = np.hstack([corner, corner + columns, corner + 1, corner + 1, corner + columns, corner + columns + 1])
    return halves.reshape(-1, 3).astype(np.uint32)


def thin_out(points: Array, most: int = 400) -> Array:
    """Return so many of the points (N, 3) at most, evenly spaced in their order, without those that are no numbers."""
    rows = np.linspace(0, len(points) - 1, min(most, len(points))).round().astype(int)
    few: Array = points[np.unique(rows)]
    return few[np.all(np.isfinite(few), axis=1)]
