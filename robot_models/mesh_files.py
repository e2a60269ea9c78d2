"""Where the meshes that a URDF names lie: in example-robot-data, or below the parent of the URDF's folder."""

from functools import lru_cache
from pathlib import Path

#: Formats that are read; a description may name any file.
FORMATS = (".dae", ".stl", ".obj", ".ply")


def source_folder(source: str) -> Path | None:
    """Return the folder of the file that a robot was read from, None if it came with a package."""
    path = Path(source)
    return path.parent.resolve() if path.suffix == ".urdf" and path.is_file() else None


def mesh_file(name: str, folder: Path | None) -> Path | None:
    """Return the file of a mesh if it is there, of a robot whose URDF lies in `folder`."""
    if name.startswith("package://"):
        share = _share()
        path, root = (None, None) if share is None else (share / name.removeprefix("package://"), share)
    else:
        path, root = (None, None) if folder is None else (folder / name.removeprefix("file://"), folder.parent)
    if path is None or root is None or path.suffix.lower() not in FORMATS:
        return None
    try:
        path = path.resolve()
        return path if path.is_relative_to(root.resolve()) and path.is_file() else None
    except (OSError, RuntimeError, ValueError):  # links that lead in a circle, a name that no file can have
        return None


@lru_cache(maxsize=1)
def _share() -> Path | None:
    """Return the folder in which the package example-robot-data lies."""
    try:
        from example_robot_data import robots_loader

        return Path(robots_loader.getModelPath("/panda_description/urdf/panda.urdf")).resolve().parents[1]
    except (ModuleNotFoundError, OSError):  # an optional package
        return None
