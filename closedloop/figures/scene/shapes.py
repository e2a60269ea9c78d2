"""The visible shapes of a robot: triangles, each set fixed in the frame of a joint.

The visual shapes of its URDF are used: boxes, cylinders, spheres, and meshes where their files are installed; or the
geoms of its MJCF. A robot without any is drawn as a rod from each joint to the next.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from robot_models import RobotModel
from robot_models.collision import collision_shapes
from robot_models.mesh_files import mesh_file, source_folder

if TYPE_CHECKING:
    import trimesh

# Triangles of one visual shape at most, where the library that reduces meshes is installed.
MOST_TRIANGLES = 1500
GREY, ROD, MARK = (0.62, 0.65, 0.68), (0.30, 0.45, 0.60), (0.62, 0.48, 0.80)


@dataclass(frozen=True)
class Shape:
    """Triangles fixed in the frame of a joint."""

    joint: int  # 0 for what stands still; k for what moves with the k-th joint, counted from 1
    vertices: NDArray[np.float32]  # (V, 3): m, in the joint's frame
    faces: NDArray[np.int32]  # (F, 3): numbers of vertices, counter-clockwise seen from outside
    colour: tuple[float, float, float]  # red, green, blue, 0 to 1


@lru_cache(maxsize=8)
def robot_shapes(model: RobotModel, tip: str) -> tuple[Shape, ...]:
    """Return the shapes of a robot whose frame `tip` is the tip."""
    mechanism = model.pinocchio_model()
    shapes = _visuals(model, mechanism) if model.format == "urdf" else _geoms(model, mechanism)
    return tuple(shapes or _rods(mechanism, tip))


def _visuals(model: RobotModel, mechanism: Any) -> list[Shape]:
    """Return the shapes that a URDF gives; none if it gives none that can be read."""
    import pinocchio as pin
    from yourdfpy import URDF

    options = {"build_scene_graph": False, "load_meshes": False}
    robot = URDF.load(io.BytesIO(model.text.encode()), **options).robot
    named = {m.name: m.color for m in robot.materials}
    shapes = []
    for link in robot.links:
        if not mechanism.existFrame(link.name, pin.FrameType.BODY):
            continue
        frame = mechanism.frames[mechanism.getFrameId(link.name, pin.FrameType.BODY)]
        for visual in link.visuals:
            origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin, dtype=float)
            place = frame.placement.homogeneous @ origin
            for mesh, colour in _meshes(visual, named, source_folder(model.source)):
                shapes.append(_shape(int(frame.parentJoint), mesh, place, colour or GREY))
    return shapes


def _geoms(model: RobotModel, mechanism: Any) -> list[Shape]:
    """Return the geoms that an MJCF gives, but for meshes and planes."""
    import trimesh

    shapes = []
    for link in model.frames:
        for geom in collision_shapes(model, link, visual=True):
            a, b, _ = geom.size
            if geom.kind == "box":
                mesh = trimesh.creation.box(2.0 * geom.size)
            elif geom.kind == "cylinder":
                mesh = trimesh.creation.cylinder(a, 2.0 * b, sections=32)
            elif geom.kind == "capsule":
                mesh = trimesh.creation.capsule(2.0 * b, a)
                mesh.apply_translation(-mesh.bounds.mean(axis=0))
            else:
                mesh = trimesh.creation.icosphere(3)
                mesh.apply_scale(geom.size if geom.kind == "ellipsoid" else a)
            frame = mechanism.frames[mechanism.getFrameId(link)]
            place = frame.placement.homogeneous @ geom.place
            shapes.append(_shape(int(frame.parentJoint), mesh, place, geom.colour or GREY))
    return shapes


def _shape(joint: int, mesh: trimesh.Trimesh, place: Array, colour: tuple[float, float, float]) -> Shape:
    vertices = np.asarray(mesh.vertices) @ place[:3, :3].T + place[:3, 3]
    return Shape(joint, vertices.astype(np.float32), np.asarray(mesh.faces, dtype=np.int32), colour)


def _meshes(visual: Any, named: dict[str, Any], folder: Path | None) -> list[tuple[trimesh.Trimesh, Any]]:
    """Return the triangles of one visual shape, and their colour: the shape's own, else that of its file, or None.

    `named` are the colours of the robot's materials by name.
    """
    import trimesh

    shape, material = visual.geometry, visual.material
    given = None if material is None else material.color or named.get(material.name)
    colour = None if given is None else tuple(float(c) for c in given.rgba[:3])
    if shape.box is not None:
        return [(trimesh.creation.box(np.asarray(shape.box.size)), colour)]
    if shape.cylinder is not None:
        return [(trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length, sections=32), colour)]
    if shape.sphere is not None:
        return [(trimesh.creation.icosphere(3, shape.sphere.radius), colour)]
    if shape.mesh is None:
        return []
    file = mesh_file(shape.mesh.filename, folder)
    if file is None:
        return []
    scale = np.ones(3) if shape.mesh.scale is None else np.broadcast_to(np.asarray(shape.mesh.scale, dtype=float), 3)
    return [(mesh, colour or own) for mesh, own in _read(file, tuple(scale.tolist()))]


@lru_cache(maxsize=64)
def _read(file: Path, scale: tuple[float, float, float]) -> list[tuple[trimesh.Trimesh, Any]]:
    """Return the meshes of a file, scaled and reduced, each with its colour; none if the file cannot be read."""
    import trimesh

    try:
        scene = trimesh.load_scene(file)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception:  # whatever a reader of meshes makes of a file; a run does not depend on it
        return []
    total, found = sum(len(part.faces) for part in parts), []
    for part in parts:
        colour = _colour_of(part)
        bare = trimesh.Trimesh(part.vertices * np.array(scale), part.faces, process=True)
        found.append((_reduced(bare, max(60, MOST_TRIANGLES * len(part.faces) // total)), colour))
    return found


def _colour_of(mesh: trimesh.Trimesh) -> tuple[float, float, float] | None:
    material = getattr(mesh.visual, "material", None)
    main = getattr(material, "main_color", None)
    return None if main is None else tuple(float(c) / 255.0 for c in main[:3])  # type: ignore[return-value]


def _reduced(mesh: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """Return a mesh of about so many triangles at most; as it is where the library for that is not installed."""
    if len(mesh.faces) <= most:
        return mesh
    try:
        return mesh.simplify_quadric_decimation(face_count=most)
    except ImportError:
        return mesh


def _rods(mechanism: Any, tip: str) -> list[Shape]:
    """Return a rod from each joint to those that follow it, and to the tip, and a ball at each joint."""
    import trimesh

    frame = mechanism.frames[mechanism.getFrameId(tip)]
    ends = [(int(mechanism.parents[j]), mechanism.jointPlacements[j].translation) for j in range(1, mechanism.njoints)]
    ends.append((int(frame.parentJoint), frame.placement.translation))
    reach = sum(float(np.linalg.norm(end)) for _, end in ends) or 1.0
    shapes = [
        _shape(joint, trimesh.creation.icosphere(2, 0.03 * reach), np.eye(4), GREY)
        for joint in range(mechanism.njoints)
    ]
    for joint, end in ends:
        if np.linalg.norm(end) > 1e-6 * reach:
            rod = trimesh.creation.cylinder(0.018 * reach, segment=[np.zeros(3), np.asarray(end)], sections=24)
            shapes.append(_shape(joint, rod, np.eye(4), ROD))
    return shapes


# Radius and height, in hundredths of the arm's reach, of the cylinder along its axis that a loop joint is drawn as.
_MARKS = {
    "hinge": (1.4, 7.0), "cylinder": (1.0, 14.0), "universal": (0.9, 7.0), "planar": (5.0, 0.4), "gear": (4.0, 1.2)
}  # fmt: skip


def mark_shape(kind: str, size: float, length: float = 0.0) -> Shape:
    """Return what a loop joint is drawn as, in a frame at its place whose z is its axis.

    Parameters
    ----------
    kind : str
        Its type, see `robot_models.loop_joint`. One that is not known here is a ball, as a point is.
    size : float
        The arm's reach, m.
    length : float
        Of a rod along z from its place, m; 0: it is none.
    """
    import trimesh

    part = 0.01 * size
    if length > 0.0:
        mesh = trimesh.creation.cylinder(0.7 * part, segment=[np.zeros(3), np.array([0.0, 0.0, length])], sections=24)
    elif kind in ("slider", "weld"):
        mesh = trimesh.creation.box(part * np.array([2.0, 2.0, 14.0 if kind == "slider" else 2.0]))
    elif kind in _MARKS:
        radius, height = _MARKS[kind]
        mesh = trimesh.creation.cylinder(part * radius, part * height, sections=24)
    else:
        mesh = trimesh.creation.icosphere(2, 1.8 * part)
    return _shape(0, mesh, np.eye(4), MARK)
