"""Reading a scenario: from a file or text, with overrides laid over it, checked.

    scenario = load_scenario("wam_slide", {"law.force": 15.0})

Unknown keys are errors; `kind` picks a variant, or a member of a family of plug-ins (`closedloop.base.families`), a
user's own too where an override or Python names it.

`Variants` makes scenarios that differ from one another in a few keys:

    variants = Variants(scenario, ("law.force", "law.kp"))
    variants.scenario((12.0, 900.0))
"""

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError
from closedloop.base.families import KEEP_ABSENT, Absent, Family, field_alone
from closedloop.base.sections import Section
from closedloop.scenario import tables
from closedloop.scenario.messages import explain, variant_keys
from closedloop.scenario.scenario import Scenario, families, families_in
from robot_models.described import names_a_file
from robot_models.errors import shown
from robot_models.xml_text import toml_tables

# Where a run starts.
START = {"start.q", "start.v"}
# Values that a key of a section may have which name no kind.
NUMBERS = (int, float, list, tuple, np.ndarray, np.generic)
# As many scenarios are looked at, spread over all, before a batch is begun of which none could be read.
LOOKED_AT = 100


class Variants:
    """A scenario and the keys that change from run to run.

    `scenario`: what all runs have in common.
    `keys`: dotted keys, as `load_scenario` takes them.
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

        Raises ScenarioError: what is wrong with the first, if none of those looked at can be read: a key is unknown,
            most likely. An unforeseen error is raised as it is.
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

    Raises ValidationError if a value is wrong.
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

    `given`: the overrides that all runs have in common.
    `kinds`: keys that change, and one of their values each; only those that pick a kind matter.
    """
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
        if not word.startswith("--") or not ("." in key or tables.table_type(key)):
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


SHIPPED = Path(str(resources.files("closedloop.scenario") / "shipped"))


def shipped_scenarios() -> list[str]:
    """Return the names of the scenarios that come with the package, sorted."""
    return sorted(each.stem for each in SHIPPED.iterdir() if each.suffix == ".toml")


def is_users_file(model: str) -> bool:
    """Whether `robot.model` names a file that does not come with the package, and may be changed."""
    return names_a_file(model) and not Path(model).is_relative_to(SHIPPED)


def scenario_text(name: str | Path) -> tuple[str, str, str, Path | None]:
    """Return (TOML text, stem, how to call it in messages, its folder) of a file, or of a shipped scenario."""
    as_path = Path(name)
    if as_path.suffix == ".toml" or isinstance(name, Path):
        return _read(as_path), as_path.stem, str(as_path), as_path.parent
    shipped = shipped_scenarios()
    if name not in shipped:
        part = [each for each in shipped if name and str(name) in each]  # "wipe" of panda_wipe
        near = part or difflib.get_close_matches(str(name)[:100], shipped, n=1, cutoff=0.6)
        every = f"wam_slide is one of {len(shipped)}, 'closedloop scenarios' lists them"
        hint = f"did you mean '{near[0]}'?" if near else every
        raise ScenarioError(f"no scenario named {shown(str(name))}; {hint} (a file of your own must end in .toml)")
    return (SHIPPED / f"{name}.toml").read_text(encoding="utf-8"), str(name), str(name), SHIPPED


def robot_file(model: Any, folder: Path, where: str) -> Any:
    """Return the absolute path of a robot's file that a scenario in `folder` names, and any other value as it is."""
    if not isinstance(model, str) or not names_a_file(model):
        return model
    there = absolute(folder / model)
    if not os.path.exists(there) and os.path.exists(model):
        try:
            right = os.path.relpath(model, folder)
        except (OSError, ValueError):  # no current folder, or another drive
            right = absolute(model)
        raise ScenarioError(
            f"{where}: robot.model = {model!r}: is looked up from the folder of the scenario, and is not there but in "
            f"the current folder: write {Path(right).as_posix()!r}, or give --robot.model {model}"
        )
    return there


def absolute(path: str | Path) -> str:
    """Return the path from the root, so that it names the same file whoever reads it; as it is, if that is unknown."""
    try:
        return os.path.abspath(path)
    except OSError:  # the current folder was deleted
        return str(path)


def _read(path: Path) -> str:
    try:
        if path.is_dir():
            raise ScenarioError(f"{path}: cannot be read: is a folder; name the .toml file in it")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: is not UTF-8 text; a scenario is a TOML file") from None
    except ValueError as error:  # a null in the name
        raise ScenarioError(f"{str(path)!r}: cannot be read: {error}") from None


@arguments_checked(overrides="keys and their values, such as {'law.force': 15.0}")
def load_scenario(name: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario and check it.

    Parameters
    ----------
    name : str, Path or mapping
        A shipped name (see `shipped_scenarios`), a path to a .toml file, or the tables of such a file:
        ``{"robot": {"model": "wam4"}, "law": {"kind": "paper"}, ...}``.
    overrides : mapping, optional
        Dotted keys and values laid over the file before it is checked, such as ``{"law.force": 15.0}``; of a contact by
        its name or number, or of all: ``{"contact.0.friction": 0.3, "contact.*.restitution": 0.0}``. Overriding a
        `kind` drops the file's keys that the new kind does not have; keys given here are never dropped. A user's class
        is named here, as ``{"reference.kind": "my_module:MyPath"}`` or by the class itself.

    Raises
    ------
    ScenarioError
        If there is no such scenario, or the file or an override is at fault; it names the key, the value and the remedy
        of each fault, one line each.
    """
    if isinstance(name, Mapping):
        return _whole_scenario(plain(dict(name)), "scenario", overrides or {}, Path(), keep_absent=False)
    text, stem, where, folder = scenario_text(name)
    return parse_scenario(text, stem, where, overrides, folder=folder)


def parse_scenario(
    text: str, stem: str = "unnamed", where: str = "scenario", overrides: Mapping[str, Any] | None = None,
    *, keep_absent: bool = False, folder: Path | None = None,
) -> Scenario:  # fmt: skip
    """Read a scenario from TOML text; `where` names its origin in messages. See `load_scenario`.

    A robot's file is looked up from `folder`, that of the scenario's own file, if it has one. With `keep_absent` a
    user's class not named in this process is kept as it is, for inspection and not to be run: see
    `closedloop.base.families.Absent`.
    """
    try:
        data = toml_tables(text)
    except ValueError as error:
        raise ScenarioError(f"{where}: not valid TOML: {error}") from None
    if not isinstance(overrides, Mapping | None):
        raise ScenarioError(
            f"overrides = {shown(overrides)}: must be keys and their values, such as {{'law.force': 15.0}}"
        )
    data.setdefault("name", stem)
    return _whole_scenario(data, where, overrides or {}, folder, keep_absent=keep_absent)


def _whole_scenario(
    data: dict[str, Any], where: str, overrides: Mapping[str, Any], folder: Path | None, *, keep_absent: bool
) -> Scenario:
    """Check a scenario from the tables of its file, and that they say what is simulated; see `parse_scenario`."""
    robot = data.get("robot")
    given = {"robot", "robot.model"} & overrides.keys()
    if folder is not None and isinstance(robot, dict) and "model" in robot and not given:
        robot["model"] = robot_file(robot["model"], folder, where)
    scenario = scenario_of(data, where, overrides, keep_absent=keep_absent)
    if not {"robot", "law"} & data.keys():  # an empty file would be an arm that falls
        raise ScenarioError(f"{where}: 'robot' is missing: neither [robot] nor [law] says what is simulated")
    return scenario


def scenario_of(
    data: dict[str, Any], where: str, overrides: Mapping[str, Any], *, keep_absent: bool = False
) -> Scenario:
    """Check a scenario given as the tables of its file; `data` is written to. See `parse_scenario`."""
    try:
        for section in list(data):
            tables.each_point(section, data)
        for key in sorted(_standing(overrides), key=_turn):
            _override(data, key, plain(overrides[key]))
        return Scenario.model_validate(data, context={KEEP_ABSENT: keep_absent})
    except RecursionError:
        raise ScenarioError(f"{where}: a value is nested too deeply") from None
    except ValidationError as error:
        raise ScenarioError(*(f"{where}: {fault}" for fault in explain(error, data))) from None


def plain(value: Any) -> Any:
    """Return a copy of a value; numbers and arrays of numpy, also inside, as Python's, which are what a file has."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return list(value) if {*map(type, value)} == {float} else [plain(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else deepcopy(value)


def _standing(overrides: Mapping[str, Any]) -> list[str]:
    """Return the keys that stand, in the order given: a section given whole replaces the keys of it given before."""
    standing: list[str] = []
    for key in overrides:
        standing = [before for before in standing if not before.startswith(f"{key}.")]
        standing.append(key)
    return standing


def _turn(key: str) -> tuple[int, bool]:
    """Return when a key is laid over the file: sections before kinds, and kinds, which drop keys, before others.

    Of these what is for all tables of a list comes before what is for one.
    """
    return 2 if not key.endswith(".kind") and "." in key else int("." in key), f".{tables.ALL}." not in key


def _override(data: dict[str, Any], key: str, value: Any) -> None:
    if key == "robot.model" and isinstance(value, str) and names_a_file(value):
        value = absolute(value)
    if family := families().get(key):
        value = family.named(value, key)
    elif isinstance(value, dict) and (family := families().get(f"{key}.kind")) and "kind" in value:
        value["kind"] = family.named(value["kind"], f"{key}.kind")
    section, _, name = key.partition(".")
    if name and (table_of := tables.table_type(section)):
        ones, rest = tables.tables_of(data, key)
        value = _named_in_table(value, rest, table_of, key)
        spread = rest == "at" and tables.are_points(value)
        if spread:
            tables.set_points(data, section, ones, value)
        for table in () if spread else ones:
            _set(table, rest.split("."), deepcopy(value), key, families_in(table_of))
    else:
        if (table_of := tables.table_type(section)) and isinstance(value, list | tuple):
            value = [_named_in_table(each, "", table_of, f"{key}.{i}") for i, each in enumerate(value)]
        within = families_in(plain) if (plain := tables.plain_section(section)) is not None else {}
        _set(data, key.split("."), value, key, within)
        tables.each_point(section, data)


def _named_in_table(value: Any, rest: str, table_of: type[Section], key: str) -> Any:
    """Return the value of a key of a table of a list, or the table, with users' classes that it names made known."""
    if one := tables.names_of_members(table_of).get(rest):
        return one.named(value, key)
    name, _, last = rest.partition(".")
    within = families_in(table_of)
    if last == "kind" and name in within:
        return within[name].named(value, key)
    if isinstance(value, dict) and rest in within and "kind" in value:
        return value | {"kind": within[rest].named(value["kind"], f"{key}.kind")}
    if isinstance(value, dict) and not rest:
        return {name: _named_in_table(each, name, table_of, f"{key}.{name}") for name, each in value.items()}
    return value


def _set(data: dict[str, Any], parts: list[str], value: Any, key: str, within: Mapping[str, Family[Any]]) -> None:
    """Write a value to its place; a kind drops what it does not know. `within`: sections of a table of a list."""
    section = data
    for part in parts[:-1]:
        section = section.setdefault(part, {})
        if not isinstance(section, dict):
            raise ScenarioError(f"{key}: '{part}' is not a section")
    family = within.get(parts[-2]) if len(parts) > 1 else None
    of_a_section = len(parts) == 2 or family is not None
    if parts[-1] == "kind" and of_a_section and isinstance(value, str) and section.get("kind") != value:
        known = variant_keys(parts[0], value) if family is None else set(getattr(family.get(value), "model_fields", ()))
        for stale in [k for k in section if k not in known]:
            del section[stale]
    section[parts[-1]] = value
