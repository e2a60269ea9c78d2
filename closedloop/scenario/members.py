"""The users' classes that a scenario selects, and whether they are known in this process."""

from __future__ import annotations

from collections.abc import Iterator

from closedloop.base.errors import ScenarioError
from closedloop.base.families import Absent, Member, how_to_name
from closedloop.jit.user_code import source_digest
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.scenario.scenario import Scenario, families
from closedloop.scenario.tables import names_of_members


def members_of_users(scenario: Scenario) -> dict[str, str]:
    """Return the keys that select a user's class in a scenario, and its name, MODULE:CLASS."""
    return {key: name for key, name in _picked(scenario) if ":" in name}


def _picked(scenario: Scenario) -> Iterator[tuple[str, str]]:
    for key in families():
        section, _, name = key.partition(".")
        yield key, str(getattr(getattr(scenario, section), name))
    for i, contact in enumerate(scenario.contact or ()):
        yield f"contact.{i}.restitution_law", contact.restitution_law


def refuse_absent(scenario: Scenario) -> None:
    """Refuse to run a scenario read from a run file with a user's class that has not been named in this process."""
    for key, name in members_of_users(scenario).items():
        if _class_of(scenario, key, name) is None:
            raise ScenarioError(f"{key} = {name!r}: {how_to_name(key, name)}")


def member_digests(scenario: Scenario) -> dict[str, str]:
    """Return, for each user's class in a scenario, name -> SHA-256 of the text that it is defined in, "" if unknown."""
    found = {name: _class_of(scenario, key, name) for key, name in members_of_users(scenario).items()}
    return {name: "" if member is None else source_digest(member) for name, member in found.items()}


def _class_of(scenario: Scenario, key: str, name: str) -> type[Member] | None:
    """Return the class of a member that a scenario has, None if it is absent."""
    if key not in families():  # of a table of a list
        return names_of_members(ContactSection)[key.rpartition(".")[2]].get(name)
    section = getattr(scenario, key.partition(".")[0])
    if isinstance(section, Member | Absent):  # its own class, whatever else was given this name since
        return type(section) if isinstance(section, Member) else None
    return families()[key].get(name)
