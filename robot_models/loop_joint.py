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
    gear        1     all but x1 = c0 + c1 x2 + c2 x2² + c3 x2³ + c4 x2⁴ of two joints, or of two sums of joints

In the sidecar of a robot (`robot_models.sidecar`) it is a table, with the names of the public convention of URDF and
YAML for closed loops (frames, type):

    [[closed_loop]]
    name = "coupler"
    type = "hinge"
    frames = ["coupler_end", "rocker_end"]   # links; "world" is the base
    axis = [0, 1, 0]                         # in either frame; axes = [[...], [...]] if they differ
    points = [[0.4, 0, 0], [0, 0, 0.3]]      # in either frame, m; their origins if left out

The frames of a slider or a weld have the same directions when it is closed. A distance has `length`, m; a gear has
`joints` and `polynomial` instead of frames. Of more than two joints it has `coefficients`, a row for x1 and one for x2:
x1 is the sum of the first row's coefficients times the joints, x2 that of the second row's.

A hinge, a slider and a cylinder leave coordinates free: the angle of the second side to the first about the axis, rad,
the distance along it, m, or both. These may have friction, limits and a drive:

    friction = 0.2          # Coulomb's, N m (N)
    damping = 0.01          # viscous, N m s/rad (N s/m)
    limits = [-1.0, 0.5]    # hard stops, rad (m); inf where there is none
    drives = ["coupler"]    # the loop joint's name, beside those of the tree's joints, at the top of the file

of a cylinder a pair of each, angle and distance, and two names, "coupler_angle" and "coupler_distance"
(`robot_models.loop_coordinate`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from math import inf, isfinite, sqrt
from typing import Any

import numpy as np

from robot_models.errors import ModelError, shown
from robot_models.mechanism import MAX_JOINTS

Vector = tuple[float, ...]
#: Axes along which, and pairs of axes about which, a type binds: of x, y, z with z its axis. A pair (i, j) keeps axis i
#: of the second side perpendicular to axis j of the first.
BINDS: dict[str, tuple[tuple[int, ...], tuple[tuple[int, int], ...]]] = {
    "point": ((0, 1, 2), ()), "hinge": ((0, 1, 2), ((0, 2), (1, 2))), "slider": ((0, 1), ((0, 1), (1, 2), (2, 0))),
    "cylinder": ((0, 1), ((0, 2), (1, 2))), "universal": ((0, 1, 2), ((2, 2),)), "planar": ((2,), ((0, 2), (1, 2))),
    "weld": ((0, 1, 2), ((0, 1), (1, 2), (2, 0))),
}  # fmt: skip
#: Rows that each type takes.
ROWS = {kind: len(along) + len(about) for kind, (along, about) in BINDS.items()} | {"distance": 1, "gear": 1}
#: Other names of types.
SYNONYMS = {"3d": "point", "6d": "weld"}
#: Types that have an axis.
WITH_AXIS = ("hinge", "slider", "cylinder", "universal", "planar")
#: What the types leave free that is a coordinate: the kind of each, and how its name ends.
FREE: dict[str, tuple[tuple[str, str], ...]] = {
    "hinge": (("revolute", ""),),
    "slider": (("prismatic", ""),),
    "cylinder": (("revolute", "_angle"), ("prismatic", "_distance")),
}
#: Keys of what acts on these coordinates.
ACTING = ("friction", "damping", "limits")
#: What stands for the base as a frame.
WORLD = "world"
#: A shorter distance has no direction to speak of, m.
SHORTEST = 1e-6
#: The largest number of a loop joint, m and others.
MOST_NUMBER = 1e6
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
    #: Of a gear between sums of joints the two rows of coefficients, one for each joint; none: x1 = q1, x2 = q2.
    coefficients: tuple[Vector, ...] = ()
    #: Coulomb's friction, N m (N), and viscous, N m s/rad (N s/m), of each coordinate; none if left out.
    friction: Vector = ()
    damping: Vector = ()
    #: Lower and upper stop of each coordinate, rad (m), infinite where there is none.
    limits: tuple[Vector, ...] = ()
    #: Of a weld that stands for another loop joint: the joints of the tree that are its coordinates.
    coordinates: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """How many rows it takes."""
        return ROWS[self.type]

    @property
    def free(self) -> tuple[str, ...]:
        """Names of its coordinates; none if its type has none."""
        return tuple(self.name + ending for _, ending in FREE.get(self.type, ()))

    @property
    def sums(self) -> tuple[dict[str, float], dict[str, float]]:
        """Of a gear the coefficients of the joints in x1 and in x2, without zeros."""
        first, second = self.coefficients or ((1.0, 0.0), (0.0, 1.0))
        one, other = (dict(zip(self.joints, row, strict=False)) for row in (first, second))
        return {joint: c for joint, c in one.items() if c}, {joint: c for joint, c in other.items() if c}

    def as_table(self) -> dict[str, Any]:
        """Return its fields, for JSON."""
        return asdict(self)


def loop_joint(table: Mapping[str, Any], where: str) -> LoopJoint:
    """Return the loop joint that a table of a sidecar, or of a run file, describes.

    Raises `ModelError` if a key is unknown, or a value is not what it asks for.
    """
    if not isinstance(table, Mapping):
        raise ModelError(f"{where}: a closed_loop is {shown(table)}: it must be a table, [[closed_loop]]")
    given = dict(table)
    name = given.setdefault("name", given.get("type", "loop"))
    if not (isinstance(name, str) and name.strip() and name.isprintable()):
        raise ModelError(f"{where}: closed_loop.name is {shown(name)}: it must be a text of one line")
    where = f"{where}: closed_loop {name!r}"
    kind = given.get("type")
    kind = SYNONYMS.get(kind, kind) if isinstance(kind, str) else kind
    if not (isinstance(kind, str) and kind in ROWS):
        raise ModelError(f"{where}: type is {shown(kind)}: it must be {' or '.join(map(repr, ROWS))}")
    given["type"] = kind
    axes = "axis" if "axis" in given else "axes"  # the key that was given
    if axes == "axis":
        if "axes" in given:
            raise ModelError(f"{where}: axis and axes are both given: one is enough (axis: the same in both frames)")
        given["axes"] = 2 * [given.pop("axis")]
    allowed = {"name", "type"} | (
        {"joints", "polynomial", "coefficients"} if kind == "gear" else {"frames", "points", "turn"}
    )
    allowed |= {"axes"} if kind in WITH_AXIS or "coordinates" in given else set()
    allowed |= set(ACTING) if kind in FREE else {"coordinates"} if kind == "weld" else set()
    allowed |= {"length"} if kind == "distance" else set()
    defaults = {entry.name: _listed(entry.default) for entry in fields(LoopJoint)}
    spare = {key for key in given if key in defaults and _listed(given[key]) == defaults[key]}
    for key in given.keys() - allowed - spare:
        if key in ACTING:
            raise ModelError(f"{where}: {key} is for {', '.join(FREE)}: a {kind} has no coordinate for it")
        raise ModelError(f"{where}: {key} is not for type {kind!r}: known are axis, {', '.join(sorted(allowed))}")
    made: dict[str, Any] = {"name": name, "type": kind}
    if kind == "gear":
        summed = bool(_listed(given.get("coefficients", [])))
        counts = range(1, MAX_JOINTS + 1) if summed else (1, 2)
        made["joints"] = _names(given.get("joints"), f"{where}: joints", counts)
        if summed:
            made["coefficients"] = _coefficients(given["coefficients"], len(made["joints"]), f"{where}: coefficients")
        made["polynomial"] = _polynomial(given.get("polynomial", [0.0, 1.0]), where)
    else:
        made["frames"] = _names(given.get("frames"), f"{where}: frames", (2,))
    for key in ("points", "axes", "turn"):
        if key in given:
            where_given = f"{where}: {axes if key == 'axes' else key}"
            if key == "axes" and axes == "axis":  # the same in either frame
                made[key] = 2 * _vectors([given[key][0]], 1, where_given)
            else:
                made[key] = _vectors(given[key], 3 if key == "turn" else 2, where_given)
    if kind in WITH_AXIS:
        if "axes" not in given:
            raise ModelError(f"{where}: a {kind} needs an axis, such as axis = [0, 0, 1]")
        made["axes"] = tuple(_direction(axis, f"{where}: {axes}") for axis in made["axes"])
    if given.get("coordinates"):
        made["coordinates"] = _names(given["coordinates"], f"{where}: coordinates", (1, 2))
        made["axes"] = tuple(_direction(axis, f"{where}: {axes}") for axis in made["axes"])
    made |= {
        key: _acting(given[key], key, kind, f"{where}: {key}") for key in ACTING if _listed(given.get(key, ())) != []
    }
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

    Raises `ModelError`, which names the nearest.
    """
    for loop in loops:
        bound = (*loop.joints, *loop.coordinates)
        for kind, names, known in (("frame", loop.frames, (*frames, WORLD)), ("joint", bound, joints)):
            for name in names:
                if name not in known:
                    raise ModelError(f"{where}: closed_loop {loop.name!r} names {_unknown(kind, name, known)}")
        if len(set(loop.frames)) == 1 or len(set(loop.joints)) < len(loop.joints):
            raise ModelError(f"{where}: closed_loop {loop.name!r} binds {(*loop.frames, *loop.joints)[0]!r} to itself")
    for drive in drives:
        if drive not in joints:
            raise ModelError(f"{where}: drives names {_unknown('joint', drive, joints)}")
        if drives.count(drive) > 1:
            raise ModelError(f"{where}: drives names {shown(drive)} twice: name each joint once")
    if len({loop.name for loop in loops}) < len(loops):
        raise ModelError(f"{where}: two loops have the same name: name each")
    if (rows := sum(loop.rows for loop in loops)) > MOST_ROWS:
        raise ModelError(
            f"{where}: the {len(loops)} loops take {rows} rows, and {MOST_ROWS} is the most; bind fewer links"
        )


def without(loop: LoopJoint, locked: Mapping[str, float]) -> LoopJoint:
    """Return a gear between the joints that are left where some are held, rad (m)."""
    first, second = loop.sums
    left = tuple(joint for joint in loop.joints if joint not in locked)
    held, shift = (sum(c * locked[joint] for joint, c in each.items() if joint in locked) for each in (first, second))
    moved = np.polynomial.Polynomial(loop.polynomial)(np.polynomial.Polynomial([shift, 1.0])) - held
    rows = tuple(tuple(each.get(joint, 0.0) for joint in left) for each in (first, second))
    if not loop.coefficients and len(left) == 1:
        return replace(loop, joints=left, polynomial=(float(moved(0.0)), 0.0, 0.0, 0.0, 0.0))
    coefficients = [*moved.coef.tolist(), *5 * [0.0]][:5]
    return replace(loop, joints=left, polynomial=tuple(coefficients), coefficients=rows)


def _listed(value: Any) -> Any:
    """Return tuples as the lists that JSON and TOML have."""
    return [_listed(x) for x in value] if isinstance(value, list | tuple) else value


def _unknown(kind: str, name: str, known: Sequence[str]) -> str:
    near = get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known[-8:])}"
    return f"no {kind} {shown(name)}: {hint}"


def _names(value: Any, what: str, counts: Sequence[int]) -> tuple[str, ...]:
    few = f"{counts[0]} to {counts[-1]}" if len(counts) > 2 else " or ".join(map(str, counts))
    if not (isinstance(value, list | tuple) and len(value) in counts and all(isinstance(x, str) for x in value)):
        raise ModelError(f"{what} is {shown(value)}: it must be {few} names")
    return tuple(value)


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MOST_NUMBER:
        raise ModelError(f"{what} is {shown(value)}: it must be a finite number, at most {MOST_NUMBER:g}")
    return float(value)


def _vectors(value: Any, count: int, what: str) -> tuple[Vector, ...]:
    if not (isinstance(value, list | tuple) and len(value) == count):
        raise ModelError(f"{what} is {shown(value)}: it must be {count} vectors of three numbers")
    for each in value:
        if not (isinstance(each, list | tuple) and len(each) == 3):
            raise ModelError(f"{what} has {shown(each)}: it must be three numbers")
    return tuple(tuple(_number(x, what) for x in each) for each in value)


def _acting(value: Any, key: str, kind: str, what: str) -> tuple[Any, ...]:
    """Return friction or damping of each coordinate of a type, or the pair of limits of each."""
    each = value if len(FREE[kind]) > 1 else [value]
    one = "a pair of limits, the lower first" if key == "limits" else "a number, zero or more"
    wanted = one if len(FREE[kind]) == 1 else f"two, of the angle and of the distance, each {one}"
    if not isinstance(each, list | tuple) or len(each) != len(FREE[kind]):
        raise ModelError(f"{what} is {shown(value)}: it must be {wanted}")
    if key != "limits":
        made = tuple(_number(x, what) for x in each)
        if min(made) < 0.0:
            raise ModelError(f"{what} is {shown(value)}: it must be {wanted}")
        return made
    for pair in each:
        if not (isinstance(pair, list | tuple) and len(pair) == 2):
            raise ModelError(f"{what} is {shown(value)}: it must be {wanted}")
    pairs = tuple(tuple(x if x in (-inf, inf) else _number(x, what) for x in pair) for pair in each)
    if not all(low < high for low, high in pairs):
        raise ModelError(f"{what} is {shown(value)}: it must be {wanted}")
    return pairs


def _direction(axis: Vector, what: str) -> Vector:
    length = sqrt(sum(x * x for x in axis))
    if not (isfinite(length) and length > 1e-10):
        raise ModelError(f"{what} is {shown(list(axis))}: it has no direction; give three numbers, not all zero")
    return tuple(x / length for x in axis)


def _coefficients(value: Any, n: int, what: str) -> tuple[Vector, ...]:
    rows = value if isinstance(value, list | tuple) else ()
    if not (len(rows) == 2 and all(isinstance(row, list | tuple) and len(row) == n for row in rows)):
        raise ModelError(f"{what} is {shown(value)}: it must be two rows of {n} numbers, one for each joint")
    made = tuple(tuple(_number(x, what) for x in row) for row in rows)
    if not any(made[0]):
        raise ModelError(f"{what} is {shown(value)}: the first row must not be all zero")
    return made


def _polynomial(value: Any, where: str) -> Vector:
    if not (isinstance(value, list | tuple) and 1 <= len(value) <= 5):
        raise ModelError(f"{where}: polynomial is {shown(value)}: it must be one to five coefficients")
    numbers = [_number(x, f"{where}: polynomial") for x in value]
    return tuple(numbers + [0.0] * (5 - len(numbers)))
