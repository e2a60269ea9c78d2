"""A robot by its name or its file: its canonical text, and what is known beside it."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from robot_models import example_robots, shipped, urdf
from robot_models.errors import ModelError
from robot_models.sidecar import Sidecar, read_sidecar
from robot_models.urdf_loops import Beside, read_beside
from robot_models.xml_text import parse, read_text

if TYPE_CHECKING:
    from os import PathLike

Format = Literal["urdf", "mjcf"]

_ROOTS: dict[str, Format] = {"robot": "urdf", "mujoco": "mjcf"}
_SUFFIXES = (".urdf", ".xml", ".mjcf", ".xacro")


@dataclass(frozen=True)
class Description:
    """A canonical text and what is known beside it; `lock` in the sidecar is the default."""

    name: str
    text: str
    format: Format
    where: str
    sidecar: Sidecar
    #: What of the file is left out, or is not as it should be, a line each.
    warnings: list[str] = field(default_factory=list)


def find(name: "str | PathLike[str]", mocap: Collection[str] = ()) -> Description:
    """Return the description of a robot that comes with a package, or of a file; of `mocap` see `mjcf.read`.

    Raises `ModelError` if there is no such robot, or its text is at fault.
    """
    if name in shipped.shipped_names():
        return _from_file(str(name), shipped.path_of(str(name)), "robot_models")
    if names_a_file(name):
        path = Path(name)
        return _from_file(path.stem, path, "", mocap)
    assert isinstance(name, str)
    if name not in example_robots.example_names():
        known = (*shipped.shipped_names(), *example_robots.example_names())
        near = get_close_matches(name.lower(), known, n=3)
        hint = (
            f"did you mean {' or '.join(map(repr, near))}?"
            if near
            else "`closedloop robots` lists them, such as wam4, panda and ur5"
        )
        if not example_robots.installed():
            hint = f"robots of other makers, as panda and ur5, need {example_robots.NEEDS}"
        raise ModelError(f"no robot is named {name!r}: {hint} (or give the path of a .urdf or MJCF .xml)")
    example = example_robots.find(name)
    own = _of_urdf(urdf.read(example.text, name), name, name)
    sidecar = replace(example.sidecar, closed_loop=own.sidecar.closed_loop, drives=own.sidecar.drives)
    if example.rotors is not None:
        rotors = example_robots.rotor_inertia(example.rotors, list(urdf.joint_types(own.text)))
        sidecar = replace(sidecar, drive_inertia=rotors)
    return replace(own, sidecar=sidecar)


def names_a_file(name: "str | PathLike[str]") -> bool:
    """Whether this is the path of a file, not the name of a robot that comes with a package."""
    path = Path(name)
    return not isinstance(name, str) or path.suffix.lower() in _SUFFIXES or len(path.parts) > 1


def _from_file(name: str, path: Path, owner: str, mocap: Collection[str] = ()) -> Description:
    where = path.name if owner else str(path)
    text = read_text(path)
    root = parse(text, where).tag
    if root not in _ROOTS:
        raise ModelError(f"{where} is neither URDF nor MJCF: its root is <{root}>, not <robot> or <mujoco>")
    format = _ROOTS[root]
    if path.suffix.lower() == ".xacro":
        text = urdf.expanded(path, where)
    beside = read_beside(path.with_suffix(".yaml"), text) if format == "urdf" else Beside(text)
    found = canonical(beside.text, format, name, where, path, mocap)
    own, sidecar = found.sidecar, read_sidecar(path.with_suffix(".toml"), joint_names(found.text, format))
    sidecar = replace(
        sidecar,
        source=sidecar.source or ("" if owner else where),
        home=dict(own.home) | dict(sidecar.home),
        drives=sidecar.drives or beside.drives or own.drives,
        closed_loop=(*own.closed_loop, *beside.loops, *sidecar.closed_loop),
    )
    return replace(found, sidecar=sidecar, warnings=[*found.warnings, *beside.warnings])


def canonical(
    text: str, format: Format, name: str, where: str, path: Path | None, mocap: Collection[str] = ()
) -> Description:
    """Return the description of a text alone, that of the file `path` if there is one.

    Raises `ModelError` if the text is at fault.
    """
    if format == "urdf":
        return _of_urdf(urdf.read(text, where), name, where)
    from robot_models import mjcf  # here: it imports MuJoCo

    said = mjcf.read(text, where, path, mocap)
    sidecar = Sidecar(home=said.home, drives=said.drives, closed_loop=said.loops)
    return Description(name, said.text, format, where, sidecar, said.warnings)


def _of_urdf(text: str, name: str, where: str) -> Description:
    """Return the description of a plain URDF: a joint that mimics another is bound to it and has no drive."""
    loops, warnings = urdf.mimics(text, where)
    bound = {loop.joints[0] for loop in loops}
    drives = tuple(name for name in joint_names(text, "urdf") if name not in bound) if loops else None
    return Description(name, text, "urdf", where, Sidecar(closed_loop=loops, drives=drives), warnings)


def joint_names(text: str, format: Format) -> tuple[str, ...]:
    """Return the joints of a canonical text that move by one coordinate, in its order."""
    if format == "mjcf":
        from robot_models import mjcf

        return tuple(name for name, kind in mjcf.joint_types(text) if kind not in mjcf.POSITIONS)
    kinds = urdf.joint_types(text)
    return tuple(joint for joint, kind in kinds.items() if kind in urdf.MOVING and kind not in urdf.MANY)
