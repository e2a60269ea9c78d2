"""Scenarios that differ from one another in a few keys.

variants = Variants(scenario, ("law.force", "law.kp"))
variants.scenario((12.0, 900.0))
"""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from typing import Any

import numpy as np
from pydantic import ValidationError

from closedloop.base.errors import ScenarioError
from closedloop.base.families import Absent, field_alone
from closedloop.base.sections import Section
from closedloop.scenario.load import plain, scenario_of
from closedloop.scenario.scenario import Scenario, families
from closedloop.scenario.tables import table_type

# Where a run starts.
START = {"start.q", "start.v"}
# Values that a key of a section may have which name no kind.
NUMBERS = (int, float, list, tuple, np.ndarray, np.generic)
# As many scenarios are looked at, spread over all, before a batch is begun of which none could be read.
LOOKED_AT = 100


class Variants:
    """A scenario and the keys that change from run to run.

    Parameters
    ----------
    scenario : Scenario
        What all runs have in common.
    keys : sequence of str
        Dotted keys, as `load_scenario` takes them.
    """

    def __init__(self, scenario: Scenario, keys: Sequence[str]) -> None:
        self.base, self.keys = scenario, tuple(keys)
        self._data = scenario.model_dump(mode="python", exclude_none=True)
        self._held = {section: getattr(scenario, section) for section in self._data}
        self._touched = {key.partition(".")[0] for key in self.keys} & set(self._data)
        self._alone = all(map(self._is_alone, self.keys))

    def scenario(self, values: Sequence[Any]) -> Scenario:
        """Return the scenario in which each key has its value."""
        changes = dict(zip(self.keys, values, strict=True))
        if self._alone and all(isinstance(value, NUMBERS) for value in values):
            with suppress(ValidationError, RecursionError):  # said below
                return self.base.with_valid(_sections_with(vars(self.base), changes))
        touched = {section: deepcopy(self._data[section]) for section in self._touched}
        try:  # the sections that no key is of are taken as they are: that they are valid is known
            return scenario_of(self._held | touched, self.base.name, changes)
        except ScenarioError:  # said from all that was given
            touched = {section: deepcopy(self._data[section]) for section in self._touched}
            return scenario_of(self._data | touched, self.base.name, changes)

    def _is_alone(self, key: str) -> bool:
        """Whether a key, given a number or a list, says something about its own section and about no other."""
        section, _, name = key.partition(".")
        held = self._held.get(section)
        if section in ("robot", "time") or not isinstance(held, Section) or isinstance(held, Absent):
            return False
        return name in type(held).model_fields and key not in families()

    def look(self, points: Sequence[Sequence[Any]]) -> Scenario:
        """Return the first of these scenarios that can be read; see `LOOKED_AT`.

        Raises
        ------
        ScenarioError
            What is wrong with the first, if none of those looked at can be read: a key is unknown, most likely. An
            unforeseen error is raised as it is.
        """
        first: Exception | None = None
        for at in sorted(set(np.linspace(0, len(points) - 1, LOOKED_AT).round().astype(int).tolist())):
            try:
                return self.scenario(points[at])
            except Exception as error:  # of its own run, which says it, as long as there are others
                first = first or error
        assert first is not None
        raise first


def _sections_with(sections: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Section]:
    """Return those of the sections that have other values of keys.

    Raises
    ------
    ValidationError
        If a value is wrong.
    """
    found: dict[str, Section] = {}
    for key, value in changes.items():
        name, _, field = key.partition(".")
        section: Section = found.get(name, sections[name])
        given, validator = value if isinstance(value, float) else plain(value), field_alone(type(section), field)
        if validator is not None:
            found[name] = section.with_valid({field: validator.validate_python(given)})
        else:
            held = {each: there for each, there in vars(section).items() if there is not None}
            found[name] = type(section).model_validate({**held, field: given})
    return found


def replaced(scenario: Scenario, changes: Mapping[str, Any]) -> Scenario:
    """Return a scenario with other values of some keys; see `Scenario.replace`."""
    if changes.keys() <= START and all(isinstance(value, list | tuple | np.ndarray) for value in changes.values()):
        with suppress(ValidationError):  # said below, from all that was given
            return scenario.with_valid(_sections_with(vars(scenario), changes))  # no other section depends on it
    return Variants(scenario, tuple(changes)).scenario(tuple(changes.values()))


def refuse_lost(given: Mapping[str, Any], kinds: Iterable[tuple[str, Any]]) -> None:
    """Refuse a key given beside kinds that change from run to run, if one of these kinds does not know it.

    Parameters
    ----------
    given : mapping
        The overrides that all runs have in common.
    kinds : iterable of (str, value)
        Keys that change, and one of their values each; only those that pick a kind matter.
    """
    from closedloop.scenario.messages import variant_keys

    faults: dict[str, tuple[str, str]] = {}
    for key, kind in kinds:
        section, _, last = key.partition(".")
        for mine in given if last == "kind" and isinstance(kind, str) else ():
            part = mine.split(".")
            known = variant_keys(section, kind)  # none of a kind that there is not: of its own runs, which say it
            if known and part[0] == section and len(part) > 1 and part[1] not in known:
                faults.setdefault(mine, (key, kind))
    if faults:
        raise ScenarioError(
            *(
                f"{mine} is given, and {key} = {kind!r} has no such key: sweep each kind with its own keys"
                for mine, (key, kind) in faults.items()
            )
        )


def split_overrides(arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Take --SECTION.KEY VALUE and --SECTION.KEY=VALUE out of the arguments; return them as overrides, and the rest.

    A section that is a list of tables may be given whole: --external_force '[{ force = [0, 0, 5], start = 1.0 }]'.
    """
    overrides: dict[str, Any] = {}
    rest: list[str] = []
    words = iter(arguments)
    for word in words:
        key, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or not ("." in key or table_type(key)):
            rest.append(word)
            continue
        if not equals:
            value = next(words, "--")
            if value.startswith("--"):
                raise ScenarioError(f"command line: {word} needs a value, such as --law.force 15")
        if any("\ud800" <= character <= "\udfff" for character in word + value):  # half a character
            raise ScenarioError(f"command line: --{key}: its value must be text in the encoding of this locale")
        overrides[key] = toml_value(value)
    return overrides, rest


def _listed(text: str) -> Any:
    """Return numbers with commas between them, such as 0,0,1, as a list, and other text as it is."""
    try:
        return [float(word) for word in text.split(",")] if "," in text else text
    except ValueError:
        return text


def toml_value(text: str) -> Any:
    """Read a value as TOML would; what is not TOML is text, so that --robot.model panda needs no quotes.

    A list of numbers needs no brackets: --surface.normal 0,0,1.
    """
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # no TOML, a number of thousands of digits, a thousand brackets
        return _listed(text)
    return document["value"] if len(document) == 1 else text
