"""Users' classes and functions: named as MODULE:NAME, and whether they are known in this process.

    --law my_laws:soft_touch --reference.kind my_paths:Spiral

The module, and what it imports, may be in the current folder. That folder is searched last, and a module with the name
of an installed one is refused.
"""

import importlib
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import cache, lru_cache
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from operator import attrgetter
from typing import Any

from closedloop.base.errors import ClosedLoopError, ScenarioError
from closedloop.base.families import Absent, Member, how_to_name
from closedloop.jit.user_code import source_digest
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.scenario.scenario import Scenario, families
from closedloop.scenario.tables import names_of_members


def name_members(given: Iterable[tuple[str, Any]]) -> None:
    """Import the users' classes that the command line names, such as --reference.kind my_paths:Spiral."""
    for key, value in given:
        family = families().get(key)
        if family is not None and isinstance(value, str) and ":" in value:
            with importing(f"--{key}", value, "MODULE:CLASS, such as my_module:MyClass"):
                family.named(value, key)


def import_law(name: str) -> Any:
    """Return the function that --law names; see `import_function`."""
    return import_function("--law", name, "my_laws:soft_touch")


def import_function(option: str, name: str, example: str) -> Any:
    """Return the function that an option of the command line names."""
    with importing(option, name, f"MODULE:FUNCTION, such as {example}") as (module, function):
        found = getattr(importlib.import_module(module), function, None)
    if not callable(found):
        raise ScenarioError(f"{option} {name}: '{module}' has no function '{function}'")
    return found


@contextmanager
def importing(option: str, name: str, wanted: str) -> Iterator[tuple[str, str]]:
    """Let MODULE:NAME be imported meanwhile; yield the two names.

    What the module prints as it is imported goes to standard error: standard output is for results.

    `option`: for messages, such as ``--law``.
    `name`: MODULE:NAME.
    `wanted`: what it should look like.
    Raises ScenarioError if it does not look like that, there is no such module, or it cannot be imported; says in which
        line of which file.
    """
    module, _, attribute = name.partition(":")
    if not (attribute and all(part.isidentifier() for part in module.split("."))):
        raise ScenarioError(f"{option} {name}: must be {wanted}")
    file = _look_here(option, name, module.partition(".")[0])
    try:
        with redirect_stdout(sys.stderr):
            yield module, attribute
    except ClosedLoopError:
        raise
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            what = f"there is no module '{module}' here or among the installed packages"
        else:
            what = _where_and_what(error, file)
        raise ScenarioError(f"{option} {name}: {what}") from None


def _look_here(option: str, name: str, top: str) -> str:
    """Let modules of the current folder be found, after all others; return the file of the named one, or ""."""
    try:
        here = os.getcwd()
    except OSError:  # it was deleted
        return ""
    importlib.invalidate_caches()
    ours, other = PathFinder.find_spec(top, [here]), _installed(top)
    if ours is not None and ours.origin is not None and other is not None and not _same(ours.origin, other.origin):
        raise ScenarioError(
            f"{option} {name}: {_short(ours.origin)} has the name of another module, {other.origin or top}: rename it"
        )
    if here not in sys.path:
        sys.path.append(here)
    return "" if ours is None else ours.origin or ""


def _installed(top: str) -> ModuleSpec | None:
    try:
        found = find_spec(top)
    except ValueError:  # such as __main__, which has none
        return ModuleSpec(top, None)
    # A folder without __init__.py has no origin, and takes the place of no module.
    return None if found is None or found.origin is None else found


def _same(a: str, b: str | None) -> bool:
    try:
        return b is not None and os.path.samefile(a, b)
    except OSError:  # such as "built-in"
        return False


def _where_and_what(error: BaseException, file: str) -> str:
    """Return file:line: what, of the line of the user's file; `file` is where to look if no line of it ran."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{_short(error.filename)}:{error.lineno or 1}: {error.msg}"
    # The first two are `importing` and the command that imports.
    frames = [frame for frame in traceback.extract_tb(error.__traceback__)[2:] if os.path.isfile(frame.filename)]
    frames = [frame for frame in frames if frame.filename != importlib.__file__]
    here = [frame for frame in frames if not os.path.isabs(_short(frame.filename))]
    what = ": ".join([type(error).__name__, *str(error).splitlines()[:1]])
    if isinstance(error, SystemExit):
        what = f"calls sys.exit({error.code!r})"
    for frame in reversed(here or frames):
        return f"{_short(frame.filename)}:{frame.lineno}: {what}"
    return f"{_short(file)}: {what}" if file else what


def _short(path: str) -> str:
    """Return a path below the current folder from there, another as it is."""
    try:
        short = os.path.relpath(path)
    except (OSError, ValueError):  # no current folder, or another drive
        return path
    return path if short.startswith(os.pardir) else short


def members_of_users(scenario: Scenario) -> dict[str, str]:
    """Return the keys that select a user's class in a scenario, and its name, MODULE:CLASS."""
    sure, nested = _keys_of_kinds()
    names = (*attrgetter(*sure)(scenario), *(_at(scenario, parts) for parts in nested))
    return dict(_of_users(names, tuple(contact.restitution_law for contact in scenario.contact or ())))


@lru_cache(maxsize=64)
def _of_users(names: tuple[str | None, ...], laws: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Return the keys that select a user's class, and its name, of all names in order, None what is left out."""
    sure, nested = _keys_of_kinds()
    keys = (*sure, *map(".".join, nested), *(f"contact.{i}.restitution_law" for i in range(len(laws))))
    return tuple((key, name) for key, name in zip(keys, (*names, *laws), strict=True) if name and ":" in name)


def _at(found: Any, parts: Iterable[str]) -> Any:
    """Return what a scenario or a section has at a dotted key, None if a section on the way is left out."""
    for part in parts:
        found = getattr(found, part, None)
    return found


@cache
def _keys_of_kinds() -> tuple[tuple[str, ...], list[list[str]]]:
    """Return the keys that pick a member: those of sections, and the parts of others, whose section may be left out."""
    keys = list(families())
    return tuple(key for key in keys if key.count(".") == 1), [key.split(".") for key in keys if key.count(".") > 1]


def member_digests(scenario: Scenario) -> dict[str, str]:
    """Return, for each user's class in a scenario, name -> SHA-256 of the text that it is defined in, "" if unknown.

    Raises ScenarioError if it was read from a run file with a class that has not been named in this process.
    """
    found = {}
    for key, name in members_of_users(scenario).items():
        member = _class_of(scenario, key, name)
        if member is None:
            raise ScenarioError(f"{key} = {name!r}: {how_to_name(key, name)}")
        found[name] = source_digest(member)
    return found


def lacks_members(scenario: Scenario) -> bool:
    """Whether a scenario, read from a run file, names a user's class that has not been named in this process."""
    return any(_class_of(scenario, key, name) is None for key, name in members_of_users(scenario).items())


def _class_of(scenario: Scenario, key: str, name: str) -> type[Member] | None:
    """Return the class of a member that a scenario has, None if it is absent."""
    if key not in families():  # of a table of a list
        return names_of_members(ContactSection)[key.rpartition(".")[2]].get(name)
    section = _at(scenario, key.split(".")[:-1])
    if isinstance(section, Member | Absent):  # its own class, whatever else was given this name since
        return type(section) if isinstance(section, Member) else None
    return families()[key].get(name)
