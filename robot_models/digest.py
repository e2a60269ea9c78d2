"""A digest of all that a run reads of a robot: whether what was computed with it is still about the same one."""

import hashlib
import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from robot_models.mesh_files import mesh_file, source_folder
from robot_models.model import RobotModel

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
