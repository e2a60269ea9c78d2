"""Where the meshes that a URDF names lie: beside it, in its ROS package, or in example-robot-data.

And a digest of all that a run reads of a robot: whether what was computed with it is still about the same one.
"""

import hashlib
import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from robot_models.model import RobotModel

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
    read = {each.name: _plain(getattr(model, each.name)) for each in fields(model) if each.name not in TOLD}
    return hashlib.sha256(json.dumps([read, _meshes(model)]).encode()).hexdigest()


def _meshes(model: RobotModel) -> dict[str, str]:
    """Return a digest of the file of each collision mesh of a URDF, "" where there is none; those of an MJCF are not
    read."""
    if model.format != "urdf":
        return {}
    found = ET.fromstring(model.text).iterfind("link/collision/geometry/mesh")
    files = {name: mesh_file(name, source_folder(model.source)) for mesh in found if (name := mesh.get("filename", ""))}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() if file else "" for name, file in sorted(files.items())}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {each.name: _plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
