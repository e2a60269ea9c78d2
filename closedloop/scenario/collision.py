"""Contacts of whole links: `at = "collision"` of a [[contact]] as the contacts of the link's collision shapes.

    box                 its eight corners
    mesh                the corners of its convex hull
    sphere              a ball
    capsule             a ball at either end
    ellipsoid           itself
    cylinder            the edge of either end, and three points of it, on which it stands

With a plane that is all that can touch. With a curved or moving surface balls and points are what can touch it.
Two links touch by `pair_of`: balls, corners and edges of the one with the other; with time stepping two boxes touch in
eight points at most, wherever these are.
"""

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, ScenarioError
from closedloop.mechanics.contacts.sections import COLLISION, BoxSection, ContactSection, EdgeSection
from closedloop.mechanics.integrators import steps_impulses
from closedloop.mechanics.loops.boxes import MOST_POINTS
from closedloop.mechanics.surface.kinds.box import Box
from closedloop.mechanics.surface.kinds.capsule import Capsule
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.surface import Surface
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of
from robot_models import RobotModel
from robot_models.collision import MOST_CORNERS, CollisionShape, collision_shapes
from robot_models.loop_joint import WORLD

# Points of each edge of a cylinder on which it stands.
FEET = 3
# Shapes of two links that may touch each other.
PAIRED = ("box", "sphere", "capsule")
# A mesh whose surface is inside its convex hull by more than this share of its size is not convex.
INSIDE = 1e-6


def with_collision_shapes(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario in which each contact of a link's collision shapes is a contact for each part of them."""
    sections = scenario.contact or ()
    if not any(section.at == COLLISION for section in sections):
        return scenario
    found: list[ContactSection] = []
    for name, section in zip(names_of(sections), sections, strict=True):
        if section.at != COLLISION:
            found.append(section if section.name else section.model_copy(update={"name": name}))
            continue
        if section.onto == COLLISION:
            parts = _pairs(section, model, name, steps_impulses(scenario.time.integrator))
        else:
            parts = [part for shape in _shapes(section, model, name) for part in parts_of(shape, f"contact {name!r}")]
        names = [name] if len(parts) == 1 else [f"{name} {k}" for k in range(1, len(parts) + 1)]
        found += [section.model_copy(update={"name": own} | part) for own, part in zip(names, parts, strict=True)]
    return scenario.model_copy(update={"contact": tuple(found)})


def _pairs(section: ContactSection, model: RobotModel, name: str, stepping: bool) -> list[dict[str, Any]]:
    """Return the contacts of the collision shapes of two links."""
    if section.against == WORLD:
        raise ScenarioError(f"contact {name!r}: onto = {COLLISION!r}: the world has no collision shapes: name a link")
    if section.surface is not None or section.motion is not None:
        raise ScenarioError(f"contact {name!r}: onto = {COLLISION!r} takes the shapes of the link: leave surface out")
    others = _shapes(section.model_copy(update={"link": section.against}), model, name)
    parts: list[dict[str, Any]] = []
    for shape in _shapes(section, model, name):
        for other in others:
            for kind in (shape.kind, other.kind):
                if kind not in PAIRED:
                    raise ScenarioError(
                        f"contact {name!r}: onto = {COLLISION!r}: a {kind} touches planes and other surfaces only: "
                        "shapes of two links may be boxes, spheres and capsules"
                    )
            boxes = stepping and shape.kind == other.kind == "box" and not section.resists
            parts += (points_of_boxes if boxes else pair_of)(shape, other, section.link, section.against)
    return [{"onto": "surface"} | part for part in parts]


def hulls_taken(scenario: Scenario, model: RobotModel) -> list[str]:
    """Return a line for each contact that takes the convex hull of a mesh that is not convex."""
    lines = []
    sections = scenario.contact or ()
    for name, section in zip(names_of(sections), sections, strict=True):
        for shape in _shapes(section, model, name) if section.at == COLLISION else ():
            if shape.kind == "mesh" and _is_hollow(shape):
                lines.append(f"contact {name!r}: the mesh {shape.file!r} is not convex: its convex hull touches")
    return lines


def _shapes(section: ContactSection, model: RobotModel, name: str) -> list[CollisionShape]:
    try:
        model.require_frame(section.link)
    except ModelError as error:
        raise ScenarioError(f"contact {name!r}: link: {error}") from None
    shapes = collision_shapes(model, section.link)
    if not shapes:
        raise ScenarioError(
            f"contact {name!r}: at = {COLLISION!r}: link {section.link!r} of {model.name} has no collision shape: give "
            "at as a point or a list of points"
        )
    return shapes


def parts_of(shape: CollisionShape, where: str) -> list[dict[str, Any]]:
    """Return what of a shape can touch, as the keys of a contact each: at, radius, half_axes."""
    turn, origin, (a, b, c) = shape.place[:3, :3], shape.place[:3, 3], shape.size

    def at(point: Any) -> tuple[float, ...]:
        return tuple((origin + turn @ np.asarray(point, dtype=float)).tolist())

    def half_axes(lengths: Any) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple((length * turn[:, i]).tolist()) for i, length in enumerate(lengths))

    if shape.kind == "box":
        return [{"at": at((x, y, z))} for z in (-c, c) for y in (-b, b) for x in (-a, a)]
    if shape.kind == "sphere":
        return [{"at": at(np.zeros(3)), "radius": float(a)}]
    if shape.kind == "capsule":
        return [{"at": at((0, 0, end * b)), "radius": float(a)} for end in (-1, 1)]
    if shape.kind == "ellipsoid":
        return [{"at": at(np.zeros(3)), "half_axes": half_axes(shape.size)}]
    if shape.kind == "cylinder":
        angles = 2.0 * np.pi * np.arange(FEET) / FEET
        feet = [(a * np.cos(x), a * np.sin(x)) for x in angles]
        edges = [{"at": at((0, 0, end * b)), "half_axes": half_axes((a, a))} for end in (-1, 1)]
        return edges + [{"at": at((x, y, end * b))} for end in (-1, 1) for x, y in feet]
    hull = hull_of(shape.vertices)
    if hull is None:
        raise ScenarioError(
            f"{where}: the mesh {shape.file!r} is flat: give the mesh of a solid, or at as a list of points"
        )
    corners = shape.vertices[np.sort(hull.vertices)]
    if len(corners) > MOST_CORNERS:
        raise ScenarioError(
            f"{where}: the convex hull of the mesh {shape.file!r} has {len(corners)} corners; at most {MOST_CORNERS}: "
            "give a simpler mesh, or at as a list of points"
        )
    return [{"at": at(corner)} for corner in corners]


def hull_of(vertices: Array) -> Any:
    """Return the convex hull of points (V, 3) about their mean, `scipy.spatial.ConvexHull`; None if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(vertices - np.mean(vertices, axis=0))
    except QhullError:
        return None


def _is_hollow(shape: CollisionShape) -> bool:
    """Whether a mesh's corners and triangles' centroids, which tell a notch, are inside its hull anywhere."""
    hull = hull_of(shape.vertices)
    if hull is None:
        return False
    points = np.concatenate([shape.vertices, shape.centroids]) - np.mean(shape.vertices, axis=0)
    inside = np.min(-(points @ hull.equations[:, :3].T + hull.equations[:, 3]), axis=1)
    return bool(np.max(inside) > INSIDE * np.max(np.ptp(shape.vertices, axis=0)))


Parts = list[dict[str, Any]]


def points_of_boxes(one: CollisionShape, other: CollisionShape, link: str, against: str) -> Parts:
    """Return the contacts of the points in which two boxes touch, as keys of their sections."""
    links: dict[str, Any] = {"link": link, "against": against}
    places = {"at": _numbers(one.place[:3, 3]), "through": _numbers(other.place[:3, 3])}
    axes = {"half": _axes(one), "onto": _axes(other)}
    return [links | places | {"box": BoxSection.model_validate(axes | {"point": m})} for m in range(MOST_POINTS)]


def pair_of(one: CollisionShape, other: CollisionShape, link: str, against: str) -> Parts:
    """Return the contacts of two shapes, box, sphere or capsule: balls and corners that touch, edges and rods that
    cross.
    """
    parts: Parts = []
    if other.kind != "sphere" or one.kind == "sphere":
        parts += [part | surface_of_shape(other) | {"link": link, "against": against} for part in parts_of(one, "")]
    if one.kind != "sphere":
        parts += [part | surface_of_shape(one) | {"link": against, "against": link} for part in parts_of(other, "")]
    if "sphere" in (one.kind, other.kind):
        return parts
    if one.kind == "box" and other.kind == "capsule":
        one, other, link, against = other, one, against, link
    crossings = ("first", "last") if other.kind == "box" else ("first",)
    for edge in _edges(one):
        onto = {"onto": _axes(other), "onto_radius": float(other.size[0]) if other.kind == "capsule" else 0.0}
        for crossing in crossings:
            section = EdgeSection(**edge["edge"], **onto, crossing=crossing)
            place = {"at": edge["at"], "radius": edge["radius"], "edge": section, "link": link, "against": against}
            parts.append(place | {"through": _numbers(other.place[:3, 3])})
    return parts


def surface_of_shape(shape: CollisionShape) -> dict[str, Any]:
    """Return a shape as a surface that balls and points touch: the keys surface, through and normal of a contact."""
    turn, origin, (a, b, c) = shape.place[:3, :3], shape.place[:3, 3], shape.size
    surface: Surface
    if shape.kind == "sphere":
        normal, depth, surface = turn[:, 2], a, Sphere(radius=float(a))
    else:
        normal, along, depth = (turn[:, 2], turn[:, 0], c) if shape.kind == "box" else (turn[:, 0], turn[:, 2], a)
        x, y, z = _numbers(along)
        if shape.kind == "box":
            surface = Box(edges=(2.0 * float(a), 2.0 * float(b), 2.0 * float(c)), axis=(x, y, z))
        else:
            surface = Capsule(radius=float(a), length=float(2.0 * b), axis=(x, y, z))
    return {"surface": surface, "normal": _numbers(normal), "through": _numbers(origin + depth * normal)}


def _axes(shape: CollisionShape) -> tuple[tuple[float, ...], ...]:
    """Return the half axes of a box, or of the rod of a capsule."""
    turn = shape.place[:3, :3]
    if shape.kind == "capsule":
        return (_numbers(shape.size[1] * turn[:, 2]),)
    return tuple(_numbers(shape.size[k] * turn[:, k]) for k in range(3))


def _edges(shape: CollisionShape) -> Parts:
    """Return the twelve edges of a box, with the normals of their faces, or the rod of a capsule."""
    turn, origin = shape.place[:3, :3], shape.place[:3, 3]
    if shape.kind == "capsule":
        return [{"at": _numbers(origin), "radius": float(shape.size[0]), "edge": {"half": _axes(shape)[0]}}]
    found: Parts = []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for x in (-1.0, 1.0):
            for y in (-1.0, 1.0):
                middle = origin + x * shape.size[i] * turn[:, i] + y * shape.size[j] * turn[:, j]
                sides = _numbers(x * turn[:, i]), _numbers(y * turn[:, j])
                edge = {"half": _numbers(shape.size[k] * turn[:, k]), "sides": sides}
                found.append({"at": _numbers(middle), "radius": 0.0, "edge": edge})
    return found


def _numbers(vector: Array) -> tuple[float, ...]:
    return tuple(np.asarray(vector, dtype=float).tolist())
