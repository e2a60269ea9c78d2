"""How the inputs of what is there differ from those of what is asked for, in words."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

# Characters of a key's two values that are shown.
MOST_SHOWN = 200


def difference(
    keys: Sequence[str], names: Mapping[str, str], found: Mapping[str, Any], question: Mapping[str, Any]
) -> str:
    """Return how inputs differ: of two scenarios the first key that does, with its values, else what differs.

    Parameters
    ----------
    names : mapping of str to str
        What they are called.
    found, question : mapping
        The inputs there and those asked for; "scenario" is TOML text.
    """
    different = dict.fromkeys(names.get(key, key) for key in keys)
    if "scenario" in different:
        try:
            there, here = (_flat(tomllib.loads(str(text["scenario"]))) for text in (found, question))
        except (KeyError, ValueError, RecursionError):
            there = here = {}
        changed = [key for key in there | here if there.get(key) != here.get(key)]
        if changed:
            key, more = changed[0], len(changed) - 1
            different.pop("scenario")
            told = f"{key} is {there.get(key, 'not set')} there and {here.get(key, 'not set')} here"
            different = {told[:MOST_SHOWN] + (f", {more} more keys differ" if more else ""): None} | different
    named = [name if " is " in name else f"the {name} differs" for name in different]
    return ", ".join(named)


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat
