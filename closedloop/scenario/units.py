"""The unit, the meaning and the type of a scenario's key, for labels and tables."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from closedloop.base.families import users_named
from closedloop.base.sections import field_units

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo


@lru_cache(maxsize=8)
def _fields(users: tuple[str, ...]) -> dict[str, list[FieldInfo]]:
    """Return key -> its field in every kind that has one of its own.

    `users` are the users' classes that have keys of their own (`users_named`): what is remembered depends on them.
    """
    from closedloop.scenario.messages import variants
    from closedloop.scenario.scenario import Scenario
    from closedloop.scenario.tables import table_type

    found: dict[str, list[FieldInfo]] = {}
    for section in Scenario.model_fields:
        table = table_type(section)
        for variant in [table] if table else variants(section).values():
            for key in sorted(variant.model_fields):
                found.setdefault(f"{section}.{key}", []).append(variant.model_fields[key])
    return found


def _fields_of(key: str) -> list[FieldInfo]:
    from closedloop.scenario.tables import described_key

    return _fields(users_named()).get(described_key(key), [])


def key_description(key: str) -> str:
    """Return what a dotted key is, as --help has it; that of every kind, where kinds differ."""
    return " | ".join(dict.fromkeys(field.description for field in _fields_of(key) if field.description))


def key_unit(key: str) -> str:
    """Return the unit of a dotted key, "" if it has none or if its kinds differ.

    Where a prismatic joint has another, it is that of a revolute one.
    """
    found = {unit.partition(" (")[0] for field in _fields_of(key) for unit in field_units(field)}
    return found.pop() if len(found) == 1 else ""


def with_unit(name: str, unit: str) -> str:
    """Return the name of a quantity with its unit in brackets, or alone if it has none."""
    return f"{name} [{typeset(unit)}]" if unit not in ("", "1") else name


def typeset(unit: str) -> str:
    """Return a unit as people read it, m/s, from what files have, m s-1."""
    return unit.replace(" s-1", "/s").replace(" s-2", "/s²")


def takes_whole_numbers(key: str) -> bool:
    """Return whether a dotted key takes whole numbers only."""
    return any(field.annotation is int for field in _fields_of(key))
