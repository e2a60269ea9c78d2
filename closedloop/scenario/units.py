"""The unit, the meaning and the type of a scenario's key, for labels and tables."""

from __future__ import annotations

import re
from functools import lru_cache

from closedloop.families import users_named

_UNITS = (
    "N m s/rad", "N m/rad", "N s/m", "N m", "m/s", "rad/s", "1/s²", "1/s", "m/s²", "1/m", "s/m", "N/m", "Hz", "N", "kg",
    "m", "s", "rad",
)  # fmt: skip
# A unit stands after a comma, and a comma, a bracket, a word or nothing follows.
_UNIT = re.compile(r", (" + "|".join(re.escape(unit) for unit in _UNITS) + r")(?=$|[,;:( ])")


@lru_cache(maxsize=8)
def _descriptions(users: tuple[str, ...]) -> dict[str, str]:
    """Return key -> what it is; `users` are the users' classes that have keys of their own (`users_named`)."""
    from closedloop.scenario.messages import variant_keys, variants
    from closedloop.scenario.scenario import Scenario

    found: dict[str, str] = {}
    for section in Scenario.model_fields:
        for kind, variant in variants(section).items():
            for key in sorted(variant_keys(section, kind)):
                text = variant.model_fields[key].description or ""
                if text not in found.get(f"{section}.{key}", "").split(" | "):
                    found[f"{section}.{key}"] = " | ".join(filter(None, (found.get(f"{section}.{key}"), text)))
    return found


def key_description(key: str) -> str:
    """Return what a dotted key is, as --help has it; that of every kind, where kinds differ."""
    return _descriptions(users_named()).get(key, "")


def key_unit(key: str) -> str:
    """Return the unit of a dotted key, "" if it has none or if its kinds differ."""
    found = {match.group(1) for match in _UNIT.finditer(key_description(key).replace(" | ", ", "))}
    return found.pop() if len(found) == 1 else ""


def takes_whole_numbers(key: str) -> bool:
    """Return whether a dotted key takes whole numbers only."""
    from closedloop.scenario.messages import variants

    section, _, name = key.partition(".")
    fields = [variant.model_fields.get(name) for variant in variants(section).values()]
    return any(field is not None and field.annotation is int for field in fields)
