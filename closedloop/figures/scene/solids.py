"""Bodies with flat faces that links touch, as far as they lie near the contacts: the walls of a hole, a wedge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.mechanics.contacts.surfaces import surface_of
from closedloop.mechanics.surface.kinds.polyhedron import Polyhedron
from closedloop.scenario.scenario import Scenario
from robot_models.loop_joint import WORLD

Mesh = tuple[Array, NDArray[np.uint32]]

# They are drawn this far beyond the contacts, m.
BEYOND = 0.03


def solids_mesh(scenario: Scenario, points: Array) -> Mesh:
    """Return the polyhedra of the world that links touch, in a box around points (k, 3), m, base frame.

    Vertices (m, 3), m, and triangles (l, 3); empty where no contact is with a polyhedron.
    """
    low, high = points.min(axis=0) - BEYOND, points.max(axis=0) + BEYOND
    box = np.vstack([np.column_stack([np.eye(3), high]), np.column_stack([-np.eye(3), -low])])
    vertices: list[Array] = [np.zeros((0, 3))]
    triangles: list[NDArray[np.int64]] = [np.zeros((0, 3), np.int64)]
    for section in scenario.contact or ():
        placed = surface_of(section) if section.against == WORLD else None
        if placed is None or placed.moves or not isinstance(placed.section, Polyhedron):
            continue
        faces = np.array(placed.section.resolved()["faces"]).reshape(-1, 4)
        faces[1:, 3] += placed.section.oversize
        normals = faces[:, :3] @ placed.frame[[1, 2, 0]]  # a face's axes are the two tangents and the normal
        solid = np.column_stack([normals, faces[:, 3] + normals @ placed.origin])
        for corners in _polygons(np.vstack([solid, box]), 0.5 * (low + high), float(np.linalg.norm(high - low))):
            first, fan = sum(len(each) for each in vertices), np.arange(1, len(corners) - 1, dtype=np.int64)
            triangles.append(first + np.column_stack([np.zeros_like(fan), fan, fan + 1]))
            vertices.append(corners)
    return np.vstack(vertices), np.vstack(triangles).astype(np.uint32)


def _polygons(planes: Array, middle: Array, size: float) -> list[Array]:
    """Return the corners (c, 3) of each face of the body n·p ≤ d, whose planes (m, 4) are unit n and d.

    The body lies within `size`, m, of `middle` (3,).
    """
    found = []
    for i, plane in enumerate(planes):
        normal, offset = plane[:3], plane[3]
        across, along = 2.0 * size * np.linalg.svd(normal[None])[2][1:]
        centre = middle + (offset - normal @ middle) * normal
        corners = [centre + a * across + b * along for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        for other in np.delete(planes, i, axis=0):
            corners = _cut(corners, other[:3], other[3])
        if len(corners) > 2:
            found.append(np.array(corners))
    return found


def _cut(corners: list[Array], normal: Array, offset: float) -> list[Array]:
    """Return what is left of a convex polygon where n·p ≤ d."""
    kept: list[Array] = []
    for k, corner in enumerate(corners):
        last = corners[k - 1]
        a, b = float(normal @ last) - offset, float(normal @ corner) - offset
        if (a > 0.0) != (b > 0.0):
            kept.append(last + a / (a - b) * (corner - last))
        if b <= 0.0:
            kept.append(corner)
    return kept
