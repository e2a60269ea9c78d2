"""Where the meshes that a URDF names lie: beside it, in its ROS package, or in example-robot-data."""

from contextlib import suppress
from functools import lru_cache
from pathlib import Path

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
