"""Loop joints: what closes the loops of a mechanism whose tree is a URDF or an MJCF.

A loop joint holds two frames together, each on a link, or one on a link and the world. It leaves the two free to move
as its type says, and binds the rest by up to six rows (R of Eqs. 2-10):

    type        rows  what stays free
    point       3     to turn about the common point (also written "3d")
    hinge       5     to turn about the common axis
    slider      5     to slide along the common axis
    cylinder    4     to turn about the common axis and to slide along it
    universal   4     to turn about the axis on either side, which stay perpendicular
    planar      3     to slide across the common axis and to turn about it
    weld        6     nothing (also "6d")
    distance    1     all but the distance of the two points
    gear        1     all but q1 = c0 + c1 q2 + c2 q2² + c3 q2³ + c4 q2⁴ of two joints

In the sidecar of a robot (`robot_models.sidecar`) it is a table, with the names of the public convention of URDF and
YAML for closed loops (frames, type):

    [[closed_loop]]
    name = "coupler"
    type = "hinge"
    frames = ["coupler_end", "rocker_end"]   # links; "world" is the base
    axis = [0, 1, 0]                         # in either frame; axes = [[...], [...]] if they differ
    points = [[0.4, 0, 0], [0, 0, 0.3]]      # in either frame, m; their origins if left out

The frames of a slider or a weld have the same directions when it is closed. A distance has `length`, m; a gear has
`joints` and `polynomial` instead of frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from difflib import get_close_matches
from math import isfinite, sqrt
from typing import Any

from robot_models.errors import ModelError, shown

Vector = tuple[float, ...]
#: Axes along which, and pairs of axes about which, a type binds: of x, y, z with z its axis. A pair (i, j) keeps axis i
#: of the second side perpendicular to axis j of the first.
BINDS: dict[str, tuple[tuple[int, ...], tuple[tuple[int, int], ...]]] = {
    "point": ((0, 1, 2), ()),
    "hinge": ((0, 1, 2), ((0, 2), (1, 2))),
    "slider": ((0, 1), ((0, 1), (1, 2), (2, 0))),
    "cylinder": ((0, 1), ((0, 2), (1, 2))),
    "universal": ((0, 1, 2), ((2, 2),)),
    "planar": ((2,), ((0, 2), (1, 2))),
    "weld": ((0, 1, 2), ((0, 1), (1, 2), (2, 0))),
}
#: Rows that each type takes.
ROWS = {kind: len(along) + len(about) for kind, (along, about) in BINDS.items()} | {"distance": 1, "gear": 1}
#: Other names of types.
SYNONYMS = {"3d": "point", "6d": "weld"}
#: Types that have an axis.
WITH_AXIS = ("hinge", "slider", "cylinder", "universal", "planar")
#: What stands for the base as a frame.
WORLD = "world"
#: A shorter distance has no direction to speak of, m.
SHORTEST = 1e-6
#: No mechanism has more rows in its loops.
MOST_ROWS = 120

_SAME = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ORIGINS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_Z = ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class LoopJoint:
    """One loop joint; see the module for the types.

    Lengths in m, directions of length one. Vectors of the first of a pair are in the axes of the first frame, of the
    second in those of the second.
    """

    name: str
    type: str
    #: Names of the two frames, of which the second may be "world"; none for a gear.
    frames: tuple[str, ...] = ()
    points: tuple[Vector, ...] = _ORIGINS
    axes: tuple[Vector, ...] = _Z
    #: Directions of the first frame's axes in the second frame when closed: the columns of a rotation, row by row.
    turn: tuple[Vector, ...] = _SAME
    length: float = 0.0
    #: Names of the two joints of a gear; one alone is held at c0.
    joints: tuple[str, ...] = ()
    polynomial: Vector = (0.0, 1.0, 0.0, 0.0, 0.0)

    @property
    def rows(self) -> int:
        """How many rows it takes."""
        return ROWS[self.type]

    def as_table(self) -> dict[str, Any]:
        """Return its fields, for JSON."""
        return asdict(self)


def loop_joint(table: Mapping[str, Any], where: str) -> LoopJoint:
    """Return the loop joint that a table of a sidecar, or of a run file, describes.

    Raises
    ------
    ModelError
        A key is unknown, or a value is not what it asks for.
    """
    if not isinstance(table, Mapping):
        raise ModelError(f"{where}: a closed_loop is {shown(table)}: it must be a table, [[closed_loop]]")
    given = dict(table)
    name = given.setdefault("name", given.get("type", "loop"))
    if not (isinstance(name, str) and name.strip()):
        raise ModelError(f"{where}: closed_loop.name is {shown(name)}: it must be a text")
    where = f"{where}: closed_loop {name!r}"
    kind = given.get("type")
    kind = SYNONYMS.get(kind, kind) if isinstance(kind, str) else kind
    if not (isinstance(kind, str) and kind in ROWS):
        raise ModelError(f"{where}: type is {shown(kind)}: it must be {' or '.join(map(repr, ROWS))}")
    given["type"] = kind
    if "axis" in given:
        given.setdefault("axes", [given["axis"], given["axis"]])
        del given["axis"]
    allowed = {"name", "type"} | ({"joints", "polynomial"} if kind == "gear" else {"frames", "points", "turn"})
    allowed |= {"axes"} if kind in WITH_AXIS else set()
    allowed |= {"length"} if kind == "distance" else set()
    defaults = {entry.name: _listed(entry.default) for entry in fields(LoopJoint)}
    spare = {key for key in given if key in defaults and _listed(given[key]) == defaults[key]}
    for key in given.keys() - allowed - spare:
        raise ModelError(f"{where}: {key} is not for type {kind!r}: known are axis, {', '.join(sorted(allowed))}")
    made: dict[str, Any] = {"name": name, "type": kind}
    if kind == "gear":
        made["joints"] = _names(given.get("joints"), f"{where}: joints", (1, 2))
        made["polynomial"] = _polynomial(given.get("polynomial", [0.0, 1.0]), where)
    else:
        made["frames"] = _names(given.get("frames"), f"{where}: frames", (2,))
    for key in ("points", "axes", "turn"):
        if key in given:
            made[key] = _vectors(given[key], 3 if key == "turn" else 2, f"{where}: {key}")
    if kind in WITH_AXIS:
        if "axes" not in given:
            raise ModelError(f"{where}: a {kind} needs an axis, such as axis = [0, 0, 1]")
        made["axes"] = tuple(_direction(axis, f"{where}: axis") for axis in made["axes"])
    if kind == "distance":
        made["length"] = _number(given.get("length"), f"{where}: length")
        if not made["length"] >= SHORTEST:
            raise ModelError(
                f"{where}: length is {made['length']:g}: it must be at least {SHORTEST:g} m; a point has none"
            )
    return LoopJoint(**made)


def check_loops(
    loops: Sequence[LoopJoint], drives: Sequence[str], frames: Sequence[str], joints: Sequence[str], where: str
) -> None:
    """Refuse loop joints between frames or joints that the robot does not have, and drives that are no joints.

    Raises
    ------
    ModelError
        The message names the nearest.
    """
    for loop in loops:
        for kind, names, known in (("frame", loop.frames, (*frames, WORLD)), ("joint", loop.joints, joints)):
            for name in names:
                if name not in known:
                    raise ModelError(f"{where}: closed_loop {loop.name!r} names {_unknown(kind, name, known)}")
        if len(set(loop.frames)) == 1 or len(set(loop.joints)) < len(loop.joints):
            raise ModelError(f"{where}: closed_loop {loop.name!r} binds {(*loop.frames, *loop.joints)[0]!r} to itself")
    for drive in drives:
        if drive not in joints:
            raise ModelError(f"{where}: drives names {_unknown('joint', drive, joints)}")
    if len({loop.name for loop in loops}) < len(loops):
        raise ModelError(f"{where}: two loops have the same name: name each")
    if sum(loop.rows for loop in loops) > MOST_ROWS:
        raise ModelError(f"{where}: the loops take more than {MOST_ROWS} rows")


def _listed(value: Any) -> Any:
    """Return tuples as the lists that JSON and TOML have."""
    return [_listed(x) for x in value] if isinstance(value, list | tuple) else value


def _unknown(kind: str, name: str, known: Sequence[str]) -> str:
    near = get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known[-8:])}"
    return f"no {kind} {shown(name)}: {hint}"


def _names(value: Any, what: str, counts: tuple[int, ...]) -> tuple[str, ...]:
    if not (isinstance(value, list | tuple) and len(value) in counts and all(isinstance(x, str) for x in value)):
        raise ModelError(f"{what} is {shown(value)}: it must be {' or '.join(map(str, counts))} names")
    return tuple(value)


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e6:
        raise ModelError(f"{what} is {shown(value)}: it must be a finite number, at most 1e6")
    return float(value)


def _vectors(value: Any, count: int, what: str) -> tuple[Vector, ...]:
    if not (isinstance(value, list | tuple) and len(value) == count):
        raise ModelError(f"{what} is {shown(value)}: it must be {count} vectors of three numbers")
    for each in value:
        if not (isinstance(each, list | tuple) and len(each) == 3):
            raise ModelError(f"{what} has {shown(each)}: it must be three numbers")
    return tuple(tuple(_number(x, what) for x in each) for each in value)


def _direction(axis: Vector, what: str) -> Vector:
    length = sqrt(sum(x * x for x in axis))
    if not (isfinite(length) and length > 1e-10):
        raise ModelError(f"{what} is {shown(list(axis))}: it has no direction; give three numbers, not all zero")
    return tuple(x / length for x in axis)


def _polynomial(value: Any, where: str) -> Vector:
    if not (isinstance(value, list | tuple) and 1 <= len(value) <= 5):
        raise ModelError(f"{where}: polynomial is {shown(value)}: it must be one to five coefficients")
    numbers = [_number(x, f"{where}: polynomial") for x in value]
    return tuple(numbers + [0.0] * (5 - len(numbers)))
