"""The sidecar: what a robot description cannot say, in a small TOML of the same name beside it.

`my.urdf` may have `my.toml`:

    description = "What the robot is"
    source = "Where the values come from"
    tip = "tool0"             # the link whose origin touches the surface, unless the caller names another

    [home]                    # a sensible posture: rad, or m for a prismatic joint
    J1 = 0.3

    [lock]                    # joints held rigid at a value: rad or m
    finger = 0.0

    [drive_inertia]           # joint-side drive inertia: kg m², or kg for a prismatic joint
    J1 = 0.2

    drives = ["J1", "J4"]     # joints with a drive, at the top of the file; all if left out

    [[closed_loop]]           # what closes a loop of the mechanism, see `robot_models.loop_joint`
    type = "hinge"
    frames = ["coupler_end", "rocker_end"]
    axis = [0, 1, 0]

Every key is optional and no other is known. A scenario of that name, which has [robot] or [law], is no sidecar.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

from robot_models.errors import ModelError, shown
from robot_models.loop_joint import LoopJoint, loop_joint
from robot_models.physics import MOST
from robot_models.xml_text import read_text, toml_tables

_TEXTS = ("description", "source", "tip")
_TABLES = ("home", "lock", "drive_inertia")
_LISTS = ("drives", "closed_loop")
# What no scenario has.
_OWN = {"source", "tip", *_TABLES, *_LISTS}


@dataclass(frozen=True)
class Sidecar:
    """What a sidecar says; empty where it is silent. Units as in the module's example.

    `where` is its path, "" if there is none.
    """

    description: str = ""
    source: str = ""
    tip: str | None = None
    home: Mapping[str, float] = field(default_factory=dict)
    lock: Mapping[str, float] = field(default_factory=dict)
    drive_inertia: Mapping[str, float] = field(default_factory=dict)
    drives: tuple[str, ...] | None = None
    closed_loop: tuple[LoopJoint, ...] = ()
    where: str = ""


def read_sidecar(path: Path, joints: Collection[str]) -> Sidecar:
    """Read the sidecar of a robot, or return an empty one where there is none.

    path: where the sidecar would be
    joints: names of the joints that move in the description
    Raises `ModelError` if the TOML is malformed, has an unknown key or joint, or a value that is not what the key asks
    for.
    """
    if not path.exists():
        return Sidecar()
    try:
        table = toml_tables(read_text(path))
    except ModelError:
        raise
    except ValueError as error:
        raise ModelError(f"{path} is not valid TOML: {str(error).splitlines()[0]}") from None
    if {"law", "robot"} & set(table) and not _OWN & set(table):
        return Sidecar()  # it is a scenario, of the same name
    given = table.get("closed_loop", ())
    loops = tuple(loop_joint(each, str(path)) for each in given) if isinstance(given, list) else ()
    joints = (*joints, *(name for loop in loops for name in loop.free if name not in joints))
    for key, value in table.items():
        if key not in _TEXTS + _TABLES + _LISTS:
            scenario = {"law", "robot"} & set(table)
            hint = " (it looks like a scenario: give it another name than the robot's)" if scenario else ""
            raise ModelError(
                f"{path}: unknown key {shown(key)}: known are {', '.join(_TEXTS + _TABLES + _LISTS)}{hint}"
            )
        if key in _TEXTS and not (isinstance(value, str) and value.strip()):
            raise ModelError(f"{path}: {key} is {shown(value)}: it must be a text")
        if key in _TABLES:
            _check_table(path, key, value, joints)
        if key in _LISTS and not (isinstance(value, list) and value):
            wanted = (
                "the names of joints in [ ]" if key == "drives" else "one table a loop, each headed [[closed_loop]]"
            )
            raise ModelError(f"{path}: {key} is {shown(value)}: it must be {wanted}")
    if not all(isinstance(name, str) for name in table.get("drives", ())):
        raise ModelError(f"{path}: drives is {shown(table['drives'])}: it must be a list of joints")
    table["drives"] = tuple(table["drives"]) if "drives" in table else None
    table["closed_loop"] = loops
    return Sidecar(**table, where=str(path))


def _check_table(path: Path, key: str, table: object, joints: Collection[str]) -> None:
    if not isinstance(table, dict):
        raise ModelError(f"{path}: {key} is {shown(table)}: it must be a table of joints, [{key}]")
    for joint, value in table.items():
        if joint not in joints:
            near = get_close_matches(joint, joints, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"the joints are {', '.join(joints)}"
            raise ModelError(f"{path}: [{key}] names {shown(joint)}, which is no moving joint: {hint}")
        most, unit, _ = MOST["armature" if key == "drive_inertia" else "home"]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not abs(value) <= most or (key == "drive_inertia" and value < 0):
            wanted = f"zero or more, at most {most:g} {unit}" if key == "drive_inertia" else f"at most {most:g} {unit}"
            raise ModelError(f"{path}: [{key}] {joint} is {shown(value)}: it must be a finite number, {wanted}")
