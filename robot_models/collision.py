"""The collision shapes of a link, as its robot's file gives them: data, in the axes of the link's frame.

And where the meshes that a URDF names lie: beside it, in its ROS package, or in example-robot-data; and a digest of all
that a run reads of a robot: whether what was computed with it is still about the same one.
"""

import hashlib
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError
from robot_models.mechanism import transform
from robot_models.mjcf_coupling import rotation
from robot_models.model import RobotModel
from robot_models.urdf import origin_of

#: Formats that are read; a description may name any file.
FORMATS = (".dae", ".stl", ".obj", ".ply")


def source_folder(source: str) -> Path | None:
    """Return the folder of the file that a robot was read from, None if it came with a package."""
    path = Path(source)
    return path.parent.resolve() if path.suffix in (".urdf", ".xacro") and path.is_file() else None


def mesh_file(name: str, folder: Path | None) -> Path | None:
    """Return the file of a mesh if it is there, of a robot whose URDF lies in `folder`.

    A package is a folder of its name that the URDF lies in, or that lies beside one that it lies in.
    """
    places: list[tuple[Path, Path]] = []  # a folder, and the path from it
    if name.startswith("package://"):
        whole = Path(name.removeprefix("package://"))
        above = [] if folder is None else [folder, *folder.parents]
        places = [(each, whole) for each in (*above, _share()) if each is not None]
    elif folder is not None:
        places = [(folder.parent, Path(folder.name) / name.removeprefix("file://"))]
    for root, relative in places:
        with suppress(OSError, RuntimeError, ValueError):  # links in a circle, a name that no file can have
            path = (root / relative).resolve()
            if path.suffix.lower() in FORMATS and path.is_relative_to(root.resolve()) and path.is_file():
                return path
    return None


@lru_cache(maxsize=1)
def _share() -> Path | None:
    """Return the folder in which the package example-robot-data lies."""
    try:
        from example_robot_data import robots_loader

        return Path(robots_loader.getModelPath("/panda_description/urdf/panda.urdf")).resolve().parents[1]
    except (ModuleNotFoundError, OSError):  # an optional package
        return None


# Fields that no number of a run depends on.
TOLD = ("description", "source", "notes")


def digest_of(model: RobotModel) -> str:
    """Return the SHA-256 of a robot's description, of what its sidecar adds, and of the meshes that may touch."""
    read = {each.name: getattr(model, each.name) for each in fields(model) if each.name not in TOLD}
    return hashlib.sha256(json.dumps([read, _meshes(model)], default=_plain).encode()).hexdigest()


def _meshes(model: RobotModel) -> dict[str, str]:
    """Return a digest of the file of each collision mesh of a URDF, "" where there is none; those of an MJCF are not
    read."""
    if model.format != "urdf":
        return {}
    found = ET.fromstring(model.text).iterfind("link/collision/geometry/mesh")
    files = {name: mesh_file(name, source_folder(model.source)) for mesh in found if (name := mesh.get("filename", ""))}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() if file else "" for name, file in sorted(files.items())}


def _plain(value: Any) -> Any:
    """Return what JSON has for an array, a mapping or a dataclass."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return dict(value if isinstance(value, Mapping) else vars(value))


Array = NDArray[np.float64]
#: Corners that the convex hull of a mesh may have where it touches: each is a contact.
MOST_CORNERS = 64
#: Names of the convex hulls in the plain text of an MJCF: their number and their body.
HULL = re.compile(r"hull (\d+) of (.*)", re.DOTALL)
SMALLEST, LARGEST = 1e-6, 1e6  # m, of a mesh: another size is a wrong unit, or a damaged file


@dataclass(frozen=True)
class CollisionShape:
    """A shape fixed to a link.

    kind: "box", "sphere", "capsule", "cylinder", "ellipsoid" or "mesh"
    size: (3,), m: half sides of a box, half axes of an ellipsoid; radius and half length, along z, of a capsule without
        its caps and of a cylinder; the radius of a sphere; zeros behind, and of a mesh
    place: (4, 4), its pose in the link's frame
    vertices: (V, 3), of a mesh, m, in its own axes; of others none
    file: of a mesh, the name in the robot's file
    colour: red, green, blue, 0 to 1, of a geom that says it
    centroids: (T, 3), of the triangles of a mesh, m; of others none
    """

    kind: str
    size: Array
    place: Array
    vertices: Array
    file: str = ""
    colour: tuple[float, float, float] | None = None
    centroids: Array = field(default_factory=lambda: np.zeros((0, 3)))


def collision_shapes(model: "RobotModel", link: str, visual: bool = False) -> list[CollisionShape]:
    """Return the collision shapes of a link; none where its file gives none, or of a frame that is no link.

    With `visual` those that are drawn: of an MJCF geoms without contact too.

    Of an MJCF they are its geoms but those without contact (contype and conaffinity 0): of meshes the corners of the
    convex hull, of planes none.

    Raises `ModelError` if the file of a mesh is not there or cannot be read.
    """
    return _of_urdf(model, link, visual) if model.format == "urdf" else _of_mjcf(model.text, link, visual)


def _shape(kind: str, size: Any, place: Array) -> CollisionShape:
    whole = np.zeros(3)
    whole[: len(size)] = size
    return CollisionShape(kind, whole, place, np.zeros((0, 3)))


def _of_mjcf(text: str, link: str, visual: bool) -> list[CollisionShape]:
    root, found = _parsed(text), []
    for body in root.iter("body"):
        for geom in body.findall("geom") if body.get("name") == link else ():
            given = geom.attrib
            if not visual and given.get("contype") == "0" and given.get("conaffinity") == "0":
                continue
            size, pos, quat, rgba = ([float(x) for x in given[key].split()] for key in ("size", "pos", "quat", "rgba"))
            shape = _shape(given["type"], size, transform(rotation(np.array(quat)), np.array(pos)))
            found.append(replace(shape, colour=(rgba[0], rgba[1], rgba[2])))
    for hull in root.iterfind("custom/numeric"):
        name = HULL.fullmatch(hull.get("name", ""))
        if name and name[2] == link:
            red, green, blue, *corners = (float(x) for x in hull.get("data", "").split())
            shape = replace(_shape("mesh", (), np.eye(4)), vertices=np.array(corners).reshape(-1, 3), file=name[0])
            found.append(replace(shape, colour=(red, green, blue)))
    return found


def _of_urdf(model: "RobotModel", link: str, visual: bool) -> list[CollisionShape]:
    found = []
    links = (each for each in _parsed(model.text).iterfind("link") if each.get("name") == link)
    for element in (each for one in links for each in one.iterfind("visual" if visual else "collision")):
        place = origin_of(element)
        for shape in element.iterfind("geometry/*"):
            sizes_of = {
                key: [float(word) for word in shape.get(key, "").split()] for key in ("size", "radius", "length")
            }
            if shape.tag == "box":
                found.append(_shape("box", 0.5 * np.array(sizes_of["size"]), place))
            elif shape.tag == "sphere":
                found.append(_shape("sphere", sizes_of["radius"], place))
            elif shape.tag == "cylinder":
                found.append(_shape("cylinder", [*sizes_of["radius"], 0.5 * sizes_of["length"][0]], place))
            elif shape.tag == "mesh":
                where = f"{model.name}: link {link!r}"
                scale = np.array([float(word) for word in shape.get("scale", "1 1 1").split()])
                folder = source_folder(model.source)
                found.append(_mesh(shape.get("filename", ""), scale, place, folder, where))
    return found


@lru_cache(maxsize=8)
def _parsed(text: str) -> ET.Element:
    return ET.fromstring(text)


def _mesh(name: str, scale: Array, place: Array, folder: Path | None, where: str) -> CollisionShape:
    import trimesh

    file = mesh_file(name, folder)
    if file is None:
        raise ModelError(f"{where}: the file of its collision mesh, {name!r}, is not there")
    if scale.size not in (1, 3):
        raise ModelError(
            f"{where}: the scale of its collision mesh {name!r} has {scale.size} numbers: it must have three"
        )
    try:
        mesh = trimesh.load_scene(file, process=False).to_mesh()  # processed, it has no vertex that is not finite
        vertices = np.asarray(mesh.vertices, dtype=float) * scale
        centroids = np.asarray(mesh.triangles_center, dtype=float) * scale
    except Exception as error:  # whatever a reader of meshes makes of a file
        raise ModelError(f"{where}: its collision mesh {name!r} cannot be read: {error}") from None
    if not len(centroids):
        raise ModelError(f"{where}: its collision mesh {name!r} has no triangles")
    if not np.isfinite(vertices).all():
        raise ModelError(f"{where}: its collision mesh {name!r} has a vertex, or a scale, that is no finite number")
    size, reach = float(np.max(np.ptp(vertices, axis=0))), float(np.max(np.abs(vertices)))
    if size < SMALLEST or reach > LARGEST:
        raise ModelError(
            f"{where}: its collision mesh {name!r} is {size:g} m large and reaches {reach:g} m: it must be at least "
            f"{SMALLEST:g} m large and reach at most {LARGEST:g} m"
        )
    return CollisionShape("mesh", np.zeros(3), place, vertices, name, centroids=centroids)
