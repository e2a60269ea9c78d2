"""Sections that are lists of tables, as [[contact]], and the keys of one table, by its name or its number.

contact.floor left.friction     of the one with that name
contact.0.friction              of the first
contact.*.friction              of all
mocap.hand.motion.speed         of the [[mocap]] of that frame

A table whose key `at` is a list of points is a table for each of them, "floor 1", "floor 2" ... of one with the name
"floor", which is still the name of all of them. So is one whose `at` is a face of a link that presses with its area,
as points of a soft pad, each with its share:

    at = { disc = 0.03, rings = 3 }                    a disc of 30 mm, of 1 + 6 + 12 + 18 points
    at = { rectangle = [0.04, 0.02], points = [5, 3] } of the sides 40 and 20 mm

The pad is an elastic foundation (Winkler's): what it gives at one place does not depend on the others. So the pressure
at a place is the depth there times the stiffness of an area, k/A, and a point stands for a cell of the area A/n with
k/n and d/n. All cells are equally large, and the points of a face pressed whole have its area's exact second moments.
So its force and the moment of a tilt are exact; where a part of the face is clear of the surface, the error is that of
cells which are cut by the edge of what presses.

K. L. Johnson, Contact Mechanics, 1985, Sec. 4.3 (the elastic foundation).
"""

import re
from collections.abc import Sequence
from functools import cache
from itertools import groupby
from typing import Any, get_args

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import OneOf
from closedloop.base.sections import Section
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.surface.compliances.hunt_crossley import HuntCrossley
from closedloop.mechanics.surface.compliances.kelvin_voigt import KelvinVoigt
from closedloop.mechanics.surface.placed import contact_frame, unit
from closedloop.scenario.scenario import Scenario, families, families_in
from robot_models.errors import shown

# Kinds of compliance whose force is shared by points, and the parameters that are.
SHARED: dict[str, tuple[type[Any], tuple[str, ...]]] = {
    "kelvin_voigt": (KelvinVoigt, ("stiffness", "damping")), "hunt_crossley": (HuntCrossley, ("stiffness",)),
}  # fmt: skip
RINGS, MOST_POINTS = 3, 400
FORMS = "{ disc = radius, rings = 3 } or { rectangle = [length, width], points = [5, 3] }, with centre and normal"


def disc(radius: float, rings: int) -> Array:
    """Return points (n, 2), m, of a disc: one in the middle and 6, 12, 18 ... around it, n = 1 + 3 k (k + 1)."""
    found = [np.zeros((1, 2))]
    count = 1 + 3 * rings * (rings + 1)
    for k in range(1, rings + 1):
        inner, outer = (1 + 3 * i * (i + 1) for i in (k - 1, k))  # cells within, and with this ring
        middle = radius * np.sqrt((inner + outer) / (2.0 * count))  # the root of the mean square of its radii
        # In the middle cell all is at the centre: the first ring takes over its second moment.
        middle = np.sqrt(middle**2 + radius**2 / (2.0 * count) / 6.0) if k == 1 else middle
        angle = 2.0 * np.pi * (np.arange(6 * k) + 0.5 * (k % 2)) / (6 * k)
        found.append(middle * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.vstack(found)


def rectangle(length: float, width: float, points: tuple[int, int]) -> Array:
    """Return points (n, 2), m, of a rectangle: those in the middles of cells, spread by 1/√(1 − 1/n²) along a side."""
    sides = [
        0.5 * side * (2.0 * np.arange(n) + 1.0 - n) / n / np.sqrt(1.0 - 1.0 / n**2)
        for side, n in zip((length, width), points, strict=True)
    ]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)


def points_of_face(face: dict[str, Any], name: str) -> list[list[float]]:
    """Return the points of a face, m, axes of its link.

    Raises ScenarioError if the face is none.
    """
    where = f"contact {name!r}: at"
    kinds = {"disc": "rings", "rectangle": "points"}
    kind = next((each for each in kinds if each in face), None)
    if kind is None or set(face) - {kind, kinds[kind], "centre", "normal"}:
        raise ScenarioError(f"{where}: must be {FORMS}, not {face}")
    try:
        if kind == "disc":
            flat = disc(_length(face["disc"]), _count(face.get("rings", RINGS), 1))
        else:
            length, width = map(_length, face["rectangle"])
            across, up = (_count(n, 2) for n in face.get("points", (5, 5)))
            flat = rectangle(length, width, (across, up))
        centre = np.array(face.get("centre", (0.0, 0.0, 0.0)), dtype=float)
        frame = contact_frame(unit(face.get("normal", (0.0, 0.0, 1.0)), "normal"))
        if centre.shape != (3,) or not np.all(np.isfinite(centre)):
            raise ValueError
    except (TypeError, ValueError, KeyError):
        raise ScenarioError(
            f"{where}: must be {FORMS}: lengths above 0 in metres, at least 1 ring or 2 points"
        ) from None
    if len(flat) > MOST_POINTS:
        raise ScenarioError(f"{where}: has {len(flat)} points; at most {MOST_POINTS}")
    found: list[list[float]] = (centre + flat @ frame[1:]).tolist()
    return found


def share_of(compliance: Any, count: int, name: str) -> dict[str, Any]:
    """Return the compliance of each of so many points that share that of a face.

    Raises ScenarioError if it has none that can be shared.
    """
    kind = compliance.get("kind") if isinstance(compliance, dict) else None
    if kind not in SHARED:
        said = "compliance: a face presses with the pressure of a soft pad: give it as kind = "
        raise ScenarioError(f"contact {name!r}: {said}{' or '.join(map(repr, SHARED))}")
    law, names = SHARED[kind]
    whole = {key: compliance.get(key, law.model_fields[key].default) for key in names}
    return compliance | {key: value / count for key, value in whole.items() if isinstance(value, int | float)}


def _length(value: Any) -> float:
    if not 0.0 < float(value) < np.inf:
        raise ValueError
    return float(value)


def _count(value: Any, least: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < least:
        raise ValueError
    return int(value)


ALL = "*"


def table_type(section: str) -> type[Section] | None:
    """Return the type of the tables of a section that is a list of them, as [[contact]] is, None of any other."""
    field = Scenario.model_fields.get(section)
    for part in get_args(field.annotation) if field is not None else ():
        for each in get_args(part):
            if isinstance(each, type) and issubclass(each, Section):
                return each
    return None


def plain_section(section: str) -> type[Section] | None:
    """Return the type of a section that is no list of tables and has no kinds, None of any other."""
    field = Scenario.model_fields.get(section)
    kind: Any = None if field is None else field.annotation
    if isinstance(kind, type) and issubclass(kind, Section) and f"{section}.kind" not in families():
        return kind
    return None


@cache
def names_of_members(table: type[Section]) -> dict[str, OneOf]:
    """Return the keys of a table whose value is the name of a member, as time.integrator is in a section."""
    fields = table.model_fields.items()
    return {name: each for name, field in fields for each in field.metadata if isinstance(each, OneOf)}


def names_in(section: str, tables: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of tables, as they are in a file or read: "contact 2" of the second that has none.

    A [[mocap]] is called after its frame.
    """
    key = "frame" if section == "mocap" else "name"
    given = (table.get(key) if isinstance(table, dict) else getattr(table, key, "") for table in tables)
    return tuple(name if isinstance(name, str) and name else f"{section} {i}" for i, name in enumerate(given, 1))


def _stem(name: str) -> str:
    """Return the name of the table that a point's was made of: "floor" of "floor 2"; itself if it was not."""
    stem, _, number = name.rpartition(" ")
    return stem if stem and number.isdigit() else name


def each_point(section: str, data: dict[str, Any]) -> None:
    """Replace each table of a section whose `at` is a list of points by a table for each point; see the top."""
    given = data.get(section)
    if not isinstance(given, list | tuple) or not table_type(section):
        return
    tables: list[Any] = []
    for name, table in zip(names_in(section, given), given, strict=True):
        points: Any = table.get("at") if isinstance(table, dict) else None
        if isinstance(points, dict):
            points = points_of_face(points, name)
            table = table | {"compliance": share_of(table.get("compliance"), len(points), name)}
        tables += [table] if not are_points(points) else _at_points([table], name, points)
    data[section] = tables


def are_points(value: Any) -> bool:
    """Whether a value is a list of points, not one point."""
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(point, list | tuple) for point in value)


def set_points(data: dict[str, Any], section: str, tables: Sequence[dict[str, Any]], points: Sequence[Any]) -> None:
    """Let tables of a section be at a list of points: those made of one list have this list in its place.

    Where it is longer, what is added is as the last of them.
    """
    given: list[Any] = data[section]
    names = dict(zip(map(id, given), names_in(section, given), strict=True))
    groups: dict[Any, list[dict[str, Any]]] = {}
    for table in tables:
        stem, name = _stem(table.get("name") or ""), names[id(table)]
        # One table alone that is asked for is spread itself, whatever others its name is like.
        groups.setdefault(stem if len(tables) > 1 and table.get("name") else name, []).append(table)
    of = {id(table): (name, group) for name, group in groups.items() for table in group}
    data[section] = [
        each
        for table in given
        for name, group in [of.get(id(table), ("", []))]
        for each in (_at_points(group, name, points) if group and table is group[0] else [] if group else [table])
    ]


def _at_points(tables: Sequence[dict[str, Any]], name: str, points: Sequence[Any]) -> list[dict[str, Any]]:
    """Return a table for each point, called after `name`: of the tables there are, and then of the last."""
    last = len(tables) - 1
    return [tables[min(k, last)] | {"name": f"{name} {k + 1}", "at": point} for k, point in enumerate(points)]


def tables_of(data: dict[str, Any], key: str) -> tuple[list[dict[str, Any]], str]:
    """Return the tables that a key is of, to be written to, and the rest of the key; see the top of this file.

    Tables at fault in themselves are left out: the validation names them.
    """
    section, _, rest = key.partition(".")
    given = data.get(section)
    if not isinstance(given, list | tuple):
        if given is None:
            raise ScenarioError(f"{key}: the scenario has no [[{section}]]")
        return [], ""
    tables = [each.model_dump(exclude_none=True) if isinstance(each, Section) else each for each in given]
    data[section] = tables
    names = names_in(section, tables)
    stems = [_stem(name) for name in names]
    named = [name for name in (*names, *stems, *map(str, range(len(tables))), ALL) if rest.startswith(f"{name}.")]
    if not named:
        raise ScenarioError(f"{key}: {_which(section, rest, names)}")
    name = max(named, key=len)
    where = [i for i, each in enumerate(names) if name == each]
    if not where and name in stems:
        where = [i for i, each in enumerate(names) if _stem(each) == name]
    elif not where:
        where = list(range(len(tables))) if name == ALL else [int(name)]
    elif len(where) > 1:
        numbers = " and ".join(f"{section}.{i}" for i in where)
        raise ScenarioError(f"{key}: the name {shown(name)} is that of {numbers}: use the number")
    return [tables[i] for i in where if isinstance(tables[i], dict)], rest[len(name) + 1 :]


def _which(section: str, rest: str, names: Sequence[str]) -> str:
    """Return what would be right in place of a key that names no table that is there."""
    if rest in (*names, *map(str, range(len(names))), ALL):
        return f"which key of it? such as {section}.{rest}.friction; --help {section} lists them"
    first = rest.partition(".")[0]
    table = table_type(section)
    if table is not None and first in table.model_fields:
        said = " or ".join(f"'{section}.{name}.{rest}'" for name in ("0", *names[:1], ALL))
        return f"which {section}? {said}, which is for all"
    listed = []
    for stem, group in groupby(enumerate(names), lambda numbered: _stem(numbered[1])):
        (i, name), *more = group
        listed.append(f"{stem!r} ({i} to {more[-1][0]})" if more else f"{name!r} ({i})")
    there = f"there is no {section} {shown(first)}; there are {', '.join(listed)}"
    return there if names else f"the list [[{section}]] is empty"


def described_key(key: str) -> str:
    """Return the key under which a key is described: that of a table without its name, that of a section in it as such.

    contact.floor left.friction     contact.friction
    contact.0.surface.radius        surface.radius
    """
    section, _, rest = key.partition(".")
    table = table_type(section) or plain_section(section)
    if table is None or not rest:
        return key
    parts, within = rest.split("."), families_in(table)
    while table_type(section) and len(parts) > 1 and parts[0] not in within:
        del parts[0]
    family = within.get(parts[0]) if len(parts) > 1 else None
    if family is None:
        return ".".join([section, *parts])
    return next(k.removesuffix("kind") + parts[1] for k, each in families().items() if each is family)


def names_of(sections: tuple[ContactSection, ...]) -> tuple[str, ...]:
    """Return the names of the contacts, in the order of their sections."""
    return names_in("contact", sections)


def patches_of(sections: tuple[ContactSection, ...]) -> dict[str, list[int]]:
    """Return the numbers of contacts, from 0, by the name that points share: "foot 1" and "foot 2" are of "foot".

    "contact 1" and "contact 2" share none: they are two that have no name.
    """
    found: dict[str, list[int]] = {}
    for k, name in enumerate(names_of(sections)):
        found.setdefault(re.sub(r"(?<!^contact) \d+$", "", name), []).append(k)
    return found


def labels_of(sections: tuple[ContactSection, ...]) -> tuple[str, ...]:
    """Return what columns call the contacts: each its own, of letters of ASCII, digits and underscores.

    "floor left" is floor_left. Where several would have one label, its number stands behind each, the first section 1:
    of two called "foot" and one called "toe", foot_1, foot_2 and toe.
    """
    plain = [re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_")[:30] for name in names_of(sections)]
    labels = [name if plain.count(name) == 1 and name else f"{name}_{i}".lstrip("_") for i, name in enumerate(plain, 1)]
    while len(set(labels)) < len(labels):  # foot, foot and foot_2
        labels = [f"{name}_{i}" if labels.count(name) > 1 else name for i, name in enumerate(labels, 1)]
    return tuple(labels)


def tangents_of(labels: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the two tangents of each contact are called, as columns along them are ordered."""
    return tuple(f"{label}_{tangent}" for label in labels for tangent in ("t1", "t2"))
