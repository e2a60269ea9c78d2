"""The refusal of a user's class that only a file names."""

from __future__ import annotations

from pydantic_core import PydanticCustomError

# Context of a validation: keep the section of a class that has not been named in this process, as `Absent`, unrun.
KEEP_ABSENT = "keep absent members"
NOT_NAMED = "not_named"


def not_named(name: str) -> PydanticCustomError:
    """Return the refusal of a user's class that only a file names; see `how_to_name`."""
    return PydanticCustomError(NOT_NAMED, "names a class", {"name": name})


def how_to_name(key: str, name: str) -> str:
    """Return, in words, why a file's `key` = `name` is refused, and what would be right."""
    return (
        "names a class of a user's own, and a file can make no code run: name it yourself, with "
        f'--{key} {name} on the command line or {{"{key}": "{name}"}} in Python'
    )
