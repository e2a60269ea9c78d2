"""Collision shapes of two links that touch: each as contacts of balls, corners and edges of one with the other."""

from __future__ import annotations

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.contacts.sections import EdgeSection
from closedloop.mechanics.surface.kinds.box import Box
from closedloop.mechanics.surface.kinds.capsule import Capsule
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.surface import Surface
from robot_models.collision import CollisionShape

Parts = list[dict[str, Any]]


def pair_of(one: CollisionShape, other: CollisionShape, link: str, against: str) -> Parts:
    """Return the contacts of two shapes, a box, a sphere or a capsule each, as keys of their sections.

    Balls and corners of either touch the other, but of a sphere, which is a ball itself. The edges of a box, or the rod
    of a capsule, cross those of the other.
    """
    parts: Parts = []
    if other.kind != "sphere":
        parts += [part | surface_of_shape(other) | {"link": link, "against": against} for part in _points(one)]
    if one.kind != "sphere":
        parts += [part | surface_of_shape(one) | {"link": against, "against": link} for part in _points(other)]
    elif other.kind == "sphere":
        parts += [part | surface_of_shape(other) | {"link": link, "against": against} for part in _points(one)]
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


def _points(shape: CollisionShape) -> Parts:
    """Return the balls of a sphere or a capsule, and the corners of a box."""
    turn, origin, (a, b, c) = shape.place[:3, :3], shape.place[:3, 3], shape.size
    if shape.kind == "sphere":
        return [{"at": _numbers(origin), "radius": float(a)}]
    if shape.kind == "capsule":
        return [{"at": _numbers(origin + end * b * turn[:, 2]), "radius": float(a)} for end in (-1.0, 1.0)]
    corners = [(x, y, z) for z in (-c, c) for y in (-b, b) for x in (-a, a)]
    return [{"at": _numbers(origin + turn @ np.array(corner))} for corner in corners]


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
    """Return a vector as a section has it."""
    return tuple(np.asarray(vector, dtype=float).tolist())
