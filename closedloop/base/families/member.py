"""The base classes of members, and the users' classes that were named in this process."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import ConfigDict, model_validator

from closedloop.base.sections import Section
from robot_models.errors import shown

users: dict[str, type[Member]] = {}  # name -> class of every user's member that was named in this process


class Member:
    """Base of all members of families.

    Attributes
    ----------
    folder : str
        Of a family's base class: the package whose modules are the members that ship.
    """

    folder: ClassVar[str] = ""

    @classmethod
    def member_name(cls) -> str:
        """Return the kind that picks this class: the name of its file, or of a user's class MODULE:CLASS."""
        package, _, file = cls.__module__.rpartition(".")
        return file if package == cls.folder else f"{cls.__module__}:{cls.__qualname__}"


class Parameters(Member, Section):
    """A member with parameters: a section of the scenario, typed, frozen, with units and bounds."""

    kind: str = ""

    @model_validator(mode="before")
    @classmethod
    def _of_this_kind(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        name = cls.member_name()
        if data.get("kind", name) != name:
            raise ValueError(f"kind = {shown(data['kind'])}: this is {name!r}")
        return {"kind": name} | data


class Absent(Section):
    """A section of a run file whose `kind` is a user's class not named in this process: kept, and never run."""

    model_config = ConfigDict(extra="allow")
    kind: str


def users_named() -> tuple[str, ...]:
    """Return the names of all users' classes that were named in this process."""
    return tuple(users)


def is_users(member: Member | type[Member]) -> bool:
    """Whether a member is a user's class."""
    return ":" in member.member_name()
