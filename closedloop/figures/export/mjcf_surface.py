"""The surface of a scene as a geom of MuJoCo: a plane, a ball, a bar, an ellipsoid, else a grid of heights."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.figures.export.mjcf_text import element, numbers, quaternion
from closedloop.figures.scene.scene import Scene
from closedloop.mechanics.surface.kinds.cylinder import Cylinder
from closedloop.mechanics.surface.kinds.ellipsoid import Ellipsoid
from closedloop.mechanics.surface.kinds.height_field import HeightField
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.plane import unit

COLOUR = (0.77, 0.80, 0.84, 0.75)
GRID = 129  # heights along a side at most, of what is no shape of MuJoCo's
BASE = 0.05  # thickness of a grid of heights below its lowest, m
LEAST_RANGE = 1e-6  # of heights, m: MuJoCo takes none that is flat


def add_surface(assets: ElementTree.Element, world: ElementTree.Element, scene: Scene) -> None:
    """Add the surface where it is at t = 0, below a body that can be moved (`mocap`) if the surface moves."""
    placed = scene.ground.placed
    if placed is None:
        raise ScenarioError(
            f"surface.kind = {scene.run.scenario.surface.kind}: this class has not been imported here, so that its "
            "shape is not known; import its module first, or use --to csv or --to mcap"
        )
    turned = placed.frame[[1, 2, 0]].T  # columns: the tangents t1, t2 and the normal
    section, origin, n = placed.section, _origin(placed), placed.normal
    look: dict[str, Any] = {"name": "surface", "rgba": COLOUR, "mass": 0.0}
    body = element(world, "body", name="surface", mocap="true") if placed.moves else world
    size: tuple[float, ...]
    if isinstance(section, PlaneSurface):
        half = 0.5 * np.ptp(_tangential(scene, placed), axis=0).max()
        element(body, "geom", type="plane", pos=origin, quat=quaternion(turned), size=(half, half, 0.01), **look)
    elif isinstance(section, Sphere) and not section.inside:
        element(body, "geom", type="sphere", pos=origin - section.radius * n, size=(section.radius,), **look)
    elif isinstance(section, Ellipsoid):
        size = section.a, section.b, section.c
        element(
            body, "geom", type="ellipsoid", pos=origin - section.c * n, quat=quaternion(turned), size=size, **look
        )  # fmt: skip
    elif isinstance(section, Cylinder) and not section.inside:
        axis = unit(section.axis, "surface.axis")
        half = float(np.ptp((scene.ground.mesh[0] - origin) @ axis)) + section.radius
        along = quaternion(np.column_stack([np.cross(n, axis), n, axis]))
        size = (section.radius, half)
        element(body, "geom", type="cylinder", pos=origin - section.radius * n, quat=along, size=size, **look)
    else:
        _add_heights(assets, body, scene, placed, look)


def _origin(placed: PlacedSurface) -> Array:
    """Return a point (3,) of the surface at t = 0, m: of a plane one that its `offset` says."""
    origin: Array = placed.origin
    if isinstance(placed.section, PlaneSurface):
        origin = origin + (placed.offset - placed.normal @ origin) * placed.normal
    return origin


def _tangential(scene: Scene, placed: PlacedSurface) -> Array:
    """Return where the drawn patch of the surface lies along its tangents (k, 2), m, from its origin."""
    return (scene.ground.mesh[0] - placed.origin) @ placed.frame[1:].T


def _add_heights(
    assets: ElementTree.Element, body: ElementTree.Element, scene: Scene, placed: PlacedSurface, look: dict[str, Any]
) -> None:
    """Add a grid of heights: all of a height field, of another surface the patch around the paths."""
    section = placed.section
    if isinstance(section, HeightField):
        rows, columns = len(section.heights), len(section.heights[0])
        high = 0.5 * section.spacing * (np.array([columns, rows]) - 1.0)
        low, finer = -high, max(1, (GRID - 1) // (max(rows, columns) - 1))
        counts = finer * (columns - 1) + 1, finer * (rows - 1) + 1
    else:
        along = _tangential(scene, placed)
        low, high, counts = along.min(axis=0), along.max(axis=0), (GRID, GRID)
    x, y = (np.linspace(a, b, count) for a, b, count in zip(low, high, counts, strict=True))
    tangential = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)  # a row for each y
    inner = tangential * (1.0 - 1e-9) + 1e-9 * tangential.mean(axis=0)  # not beyond the edge by rounding
    points = placed.origin + inner @ placed.frame[1:]
    none = np.zeros_like(points)
    on_it = placed.follow(0.0, np.zeros(len(points)), (points, none, none))[0]
    heights = ((on_it - placed.origin) @ placed.normal).reshape(len(y), len(x))
    span = max(float(np.ptp(heights)), LEAST_RANGE)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    place = placed.origin + middle @ placed.frame[1:] + heights.min() * placed.normal
    # MuJoCo reads the rows from the top, as one sees them from above.
    element(
        assets, "hfield", name="surface", nrow=len(y), ncol=len(x), size=(*half, span, BASE),
        elevation=numbers(heights[::-1] - heights.min(), 9),
    )  # fmt: skip
    quat = quaternion(placed.frame[[1, 2, 0]].T)
    element(body, "geom", type="hfield", hfield="surface", pos=place, quat=quat, **look)
