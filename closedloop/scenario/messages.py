"""The kinds, keys and units of a scenario's sections, in words: for help, and for messages about faults."""

import difflib
import re
import textwrap
import tomllib
from collections.abc import Collection, Iterator, Mapping
from functools import cache, lru_cache
from importlib.resources import files
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from annotated_types import Ge, Gt, Le
from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from closedloop.base.errors import ScenarioError, one_line
from closedloop.base.families import NOT_NAMED, Family, OneOf, how_to_name, users_named
from closedloop.base.sections import Section, SizeError, field_units, is_left_out, sizes
from closedloop.scenario.scenario import Scenario, families, families_in
from closedloop.scenario.tables import described_key, plain_section, table_type
from robot_models.errors import shown
from robot_models.errors import shown as shown_value

ALIKE = 0.5  # of difflib's ratio, from which on a word is taken for a misspelt one


@cache
def _other_words() -> dict[str, Any]:
    """Return the words of textbooks, of other simulators and of code for our "keys" and "sections"."""
    return tomllib.loads((files("closedloop.scenario") / "other_words.toml").read_text(encoding="utf-8"))


def called(word: str) -> tuple[str, ...]:
    """Return the keys that others call so, the likeliest first."""
    return tuple(_other_words()["keys"].get(_plain(word), ()))


def key_meant(word: str, known: Collection[str]) -> str | None:
    """Return which of the known keys is most likely meant by a word, None if none is."""
    alike = [name for name in known if name.lower() == _plain(word)]
    meant = [name for name in called(word) if name in known]
    near = difflib.get_close_matches(word, known, n=1, cutoff=ALIKE)
    return next(iter([*alike, *meant, *near]), None)


def section_meant(word: str, known: Collection[str]) -> str | None:
    """Return which of the known sections is most likely meant by a word, None if none is."""
    other = _other_words()["sections"].get(_plain(word))
    if other in known:
        return other
    return next(iter(difflib.get_close_matches(word, known, n=1, cutoff=ALIKE)), None)


def _plain(word: str) -> str:
    return word.lower().replace("-", "_").replace(" ", "_")


# What a key that picks a member of a family takes beside the names that ship.
OWN = "MODULE:CLASS of your own"


def variants(section: str) -> Mapping[str, type[Section]]:
    """Return kind -> section type; the key is "" where there is one type without a kind."""
    field = Scenario.model_fields.get(section)
    if field is None:
        return {}
    if family := _family(section):
        return family
    types = get_args(field.annotation) or (field.annotation,)
    found: dict[str, type[Section]] = {}
    for kind in types:
        if isinstance(kind, type) and issubclass(kind, Section):
            tag = kind.model_fields.get("kind")
            found[tag.default if tag else ""] = kind
    return found


def _family(section: str) -> Family[Any] | None:
    """Return the family that a section's kinds are the members of, None if it is no family."""
    return next((each for each in Scenario.model_fields[section].metadata if isinstance(each, Family)), None)


def _shipped_kinds(section: str) -> list[str]:
    """Return the kinds of a section that ship: what a refusal lists, whatever was named in this process before."""
    family = _family(section)
    return list(variants(section)) if family is None else family.names()


def usual_kind(section: str) -> str:
    """Return the kind of a section that names none, "" where there are no kinds."""
    family = _family(section)
    return next(iter(variants(section)), "") if family is None else family.usual or ""


def variant_keys(section: str, kind: Any) -> set[str]:
    """Return the keys that a section of this kind may have."""
    variant = variants(section).get(kind)
    return {key for key, field in variant.model_fields.items() if not is_left_out(field)} if variant else set()


# What is right, for the kinds of fault whose text does not depend on the key.
CURES = {
    "greater_than": "must be greater than 0",
    "greater_than_equal": "must not be negative",
    "finite_number": "must be finite, not NaN or infinite",
    "string_type": "must be text",
    "tuple_type": "must be a list of numbers",
}
# Lengths of lists of fixed length: of a line, a vector, a quaternion, a tensor.
COUNTS = {2: "two", 3: "three", 4: "four", 6: "six", 7: "seven"}

LONGEST_KEY = 60  # characters, more than any has; a joint's name may
MOST_FAULTS = 20  # lines; a list of ten thousand points may have a fault in each


def explain(error: ValidationError, data: dict[str, Any]) -> list[str]:
    """Return a line for each fault that pydantic found: which key, which value, what would be right."""
    # Unknown keys first: one is often the misspelt name of one that is missing.
    problems = sorted(error.errors(include_url=False), key=lambda p: p["type"] != "extra_forbidden")
    unknown_kind = {p["loc"][:1] for p in problems if p["loc"][-1:] == ("kind",) and p["type"] == "literal_error"}
    lines: dict[str, str] = {}
    lengths: dict[tuple[Any, ...], int] = {}  # of the lists that have an entry too few, at least
    for problem in problems:
        if problem["type"] == "missing" and isinstance(problem["loc"][-1], int):
            lengths[problem["loc"][:-1]] = max(problem["loc"][-1] + 1, lengths.get(problem["loc"][:-1], 0))
    for problem in problems:
        if problem["type"] in ("extra_forbidden", "missing") and problem["loc"][:1] in unknown_kind:
            continue  # its keys are those of the kind that was meant
        name, line = _explain(problem, data, lengths.get(problem["loc"][:-1], 0))
        meant = (f"did you mean '{name}'?", f"did you mean '{name}.")
        if problem["type"] == "missing" and any(words in said for said in lines.values() for words in meant):
            continue  # it is there under the misspelt name
        lines.setdefault(name, one_line(line))  # the branches of a union say the same of one key
    cures = tuple(map(counted, COUNTS))
    short = [name for name, line in lines.items() if line.endswith(cures)]
    for name in short:  # of a list of another length the entries do not matter
        for entry in [each for each in lines if each.startswith(f"{name}[")]:
            del lines[entry]
    told = list(lines.values())
    more = len(told) - MOST_FAULTS
    return told if more <= 0 else [*told[:MOST_FAULTS], f"{more} more faults of this sort"]


def counted(length: int) -> str:
    """Return that a list must have so many numbers."""
    return f"must be {COUNTS.get(length, length)} numbers"


def _explain(problem: ErrorDetails, data: dict[str, Any], length: int) -> tuple[str, str]:
    """Return the key of a fault, and a line about it; `length` is that of the list in which an entry is missing."""
    location = [key if len(key) <= LONGEST_KEY else f"{key[:LONGEST_KEY]}..." for key in map(str, problem["loc"])]
    section = location[0] if location else ""
    # pydantic names the branch of a union that it tried, after the section; a user knows only keys and places in lists.
    union = section in Scenario.model_fields and _family(section) is None and len(variants(section)) > 1
    if union and location[1:2] and location[1] in variants(section):
        del location[1]
    known = _all_keys(section)
    path = [p for k, p in enumerate(location) if p.isdigit() or k == 0 or p in known or "lock" in location]
    name, whole = _dotted(path), _dotted(location)
    kind, value = problem["type"], problem.get("input")
    shown = "a table" if isinstance(value, dict) else shown_value(value)
    if isinstance(value, bool):
        shown = str(value).lower()  # as TOML spells it
    if kind == "extra_forbidden":
        return whole, f"unknown key '{whole}'; {_known_keys(section, location, data)}"
    if kind == "missing" and location[-1].isdigit():
        name, shown, cure = name.rpartition("[")[0], shown_value(value), counted(length)
    elif kind == "missing":
        return whole, f"'{whole}' is missing"
    elif kind == "value_error" and isinstance(problem["ctx"]["error"], SizeError):
        cure = str(problem["ctx"]["error"])
    elif table_type(section) and len(location) < 3 and kind in ("model_type", "tuple_type"):
        cure = f"must be tables, each headed [[{section}]]"
    elif name == "surface.offset":
        cure = 'must be a finite number of metres, or "start"'
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        shown = shown_value(problem["ctx"].get("tag")) if kind == "union_tag_invalid" else "missing"
        kinds = _shipped_kinds(section)
        if table := _with_inner(section):
            kinds = [kind for key, family in families_in(table).items() if key in path for kind in family.names()]
        name, cure = f"{name}.kind", f"must be {' or '.join(map(repr, kinds))}"
    elif kind == NOT_NAMED:
        user = problem["ctx"]["name"]
        name = f"{name}.kind" if isinstance(value, dict) else name
        given = re.sub(r"\[(\d+)\]", r".\1", name)  # of a list's table, as an override names it
        shown, cure = shown_value(user), how_to_name(given, user)
    elif kind == "literal_error":
        cure = f"must be {problem['ctx']['expected']}"
    elif kind in ("model_type", "model_attributes_type", "dict_type"):
        cure = f"must be a section of its own, [{name}]"
    elif kind == "too_long":
        cure = counted(problem["ctx"]["max_length"])
    elif kind == "less_than_equal":
        cure = f"must be at most {problem['ctx']['le']:g}"
    elif kind == "value_error":
        cure = str(problem["ctx"]["error"]) + (_by_kind(section, data) if isinstance(value, list | tuple) else "")
    else:
        cure = CURES.get(kind, problem["msg"])
    return name, f"{name} = {shown}: {cure}"


def _by_kind(section: str, data: dict[str, Any]) -> str:
    """Return which kind of a section decides whether a key of it is a number or a list, "" where it names none."""
    given = data.get(section)
    kind = given.get("kind") if isinstance(given, dict) else None
    return f" with {section}.kind = {kind!r}" if isinstance(kind, str) else ""


def _dotted(path: list[str]) -> str:
    return "".join(f"[{p}]" if p.isdigit() else f".{p}" for p in path).removeprefix(".")


def _with_inner(section: str) -> type[Section] | None:
    """Return the type of a section, or of its tables, that may have sections of a family within, None of any other."""
    plain = plain_section(section)
    return table_type(section) or (plain if plain is not None and families_in(plain) else None)


def _all_keys(section: str) -> set[str]:
    if table := _with_inner(section):
        members = [member for family in families_in(table).values() for member in family.values()]
        return {key for each in (table, *members) for key in each.model_fields}
    return {key for kind in variants(section) for key in variant_keys(section, kind)}


def _known_in(table: type[Section], path: list[str], data: Any, whole: str) -> tuple[list[str], str]:
    """Return the keys of a table in place of an unknown one, or of a section in it, and whose they are."""
    family = families_in(table).get(path[0]) if len(path) > 1 else None
    if family is None:
        return sorted(table.model_fields), f"{whole} has"
    kind = data[path[0]].get("kind", family.usual or "")
    return sorted(family[kind].model_fields), f"{path[0]} of kind {kind!r} has"


def _known_keys(section: str, path: list[str], data: dict[str, Any]) -> str:
    """Return which keys there are in place of an unknown one: the nearest, the kind that has it, or all."""
    if len(path) == 1:
        return _known_sections(section, data)
    inner = plain_section(section)
    if table := table_type(section):
        known, place = _known_in(table, path[2:], data[path[0]][int(path[1])], f"[[{section}]]")
    elif inner is not None and path[1] in families_in(inner):
        known, place = _known_in(inner, path[1:], data[section], f"[{section}]")
    else:
        kinds = variants(section)
        given = data[section] if isinstance(data[section], dict) else {}
        kind = given.get("kind", usual_kind(section))
        kind = kind if isinstance(kind, str) and kind in kinds else ""
        known, place = sorted(variant_keys(section, kind)), f"[{section}] has"
        mine = {path[1].lower(), *called(path[1])} & set(known)
        misspelt = key_meant(path[1], sorted(_all_keys(section)))
        other_words = () if mine or misspelt in known else (*called(path[1]), *([misspelt] if misspelt else []))
        for name in (path[1], *other_words) if len(path) == 2 else ():
            others = [repr(each) for each in _shipped_kinds(section) if name in variant_keys(section, each)]
            if others:
                meant = "" if name == path[1] else f"did you mean '{section}.{name}'? "
                said = f"is {kind!r}" if "kind" in given else f"is {kind!r} where it is not given"
                return f"{meant}{section}.kind {said}, and {name} is a key of {' or '.join(others)}"
    if near := key_meant(path[-1], known):
        return f"did you mean '{_dotted([*path[:-1], near])}'?"
    if len(path) == 2 and (other := elsewhere(path[-1])):
        return f"did you mean '{other}'? {place} {', '.join(known)}"
    return f"{place} {', '.join(known)}"


def _known_sections(section: str, data: dict[str, Any]) -> str:
    """Return which section is meant by an unknown one, with the key that it was given if that is one key."""
    known = list(Scenario.model_fields)
    outer, _, inner = section.partition(".")
    if inner and outer in known:
        return f"a key within a section is {outer} = {{{inner} = ...}}; a dot is for overrides, the second argument"
    near = section_meant(section, known)
    if near is None:
        other = elsewhere(section)
        return f"did you mean '{other}'?" if other else f"sections are {', '.join(known)}"
    given = data.get(section) if _other_words()["sections"].get(_plain(section)) == near else None  # not misspelt
    if isinstance(given, dict) and len(given) == 1 and (key := key_meant(next(iter(given)), _all_keys(near))):
        return f"did you mean '{near}.{key}'?"
    return f"did you mean '{near}'?"


def elsewhere(word: str) -> str | None:
    """Return the key of any section, with it, that has this name or is called so by others, as mu and dt are."""
    for name in (word, *called(word)):
        for section in Scenario.model_fields:
            if variants(section) and name in _all_keys(section) and name != "kind":
                return f"{section}.{name}"
    return None


@lru_cache(maxsize=8)
def _fields(users: tuple[str, ...]) -> dict[str, list[FieldInfo]]:
    """Return key -> its field in every kind that has one of its own.

    `users` are the users' classes that have keys of their own (`users_named`): what is remembered depends on them.
    """
    found: dict[str, list[FieldInfo]] = {}
    for section in Scenario.model_fields:
        table = table_type(section)
        for variant in [table] if table else variants(section).values():
            for key in sorted(variant.model_fields):
                found.setdefault(f"{section}.{key}", []).append(variant.model_fields[key])
    return found


def _fields_of(key: str) -> list[FieldInfo]:
    return _fields(users_named()).get(described_key(key), [])


def key_description(key: str) -> str:
    """Return what a dotted key is, as --help has it; that of every kind, where kinds differ."""
    return " | ".join(dict.fromkeys(field.description for field in _fields_of(key) if field.description))


def unchanged(section: Section, name: str, value: Any) -> str:
    """Return what is said to who sets an attribute of a scenario or of one of its sections."""
    kind, keys = type(section), []
    if kind is not Scenario:
        keys = [each for each in Scenario.model_fields if kind in variants(each).values()]
    key = ".".join([*keys[:1], name])
    return f"{key}: a scenario is not changed; scenario.replace({{{key!r}: {shown_value(value)}}}) returns another one"


def key_unit(key: str, scenario: Scenario | None = None) -> str:
    """Return the unit of a dotted key, "" if it has none or if its kinds differ and there is no scenario with one.

    Where a prismatic joint has another, it is that of a revolute one.
    """
    section, _, name = key.partition(".")
    own = getattr(type(getattr(scenario, section, None)), "model_fields", {}).get(name)
    fields = _fields_of(key) if own is None else [own]
    found = {unit.partition(" (")[0] for field in fields for unit in field_units(field)}
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


WIDTH = 80
OF_A_TABLE = "In place of N the number, from 0, or the name of one, or * for all: --{0}.*.KEY VALUE"


class Key(NamedTuple):
    """A key of a section, as some of the section's kinds have it."""

    name: str  # with the section, such as "law.kp"
    field: FieldInfo  # its type, bounds, default and description
    kinds: tuple[str, ...]  # the kinds that have it so; empty where the section has no kinds


def sections() -> dict[str, str]:
    """Return the sections of a scenario, in order, and what each is."""
    fields = Scenario.model_fields.items()  # of a family no member is imported
    found = [(name, field) for name, field in fields if _family(name) is not None or variants(name) or table_type(name)]
    return {name: field.description or "" for name, field in found}


def keys(section: str) -> list[Key]:
    """Return the keys of a section but its kind; one that means another thing in another kind is there for each."""
    found: dict[tuple[Any, ...], Key] = {}
    table = table_type(section)
    for kind, variant in ({"": table} if table else variants(section)).items():
        for name, field in variant.model_fields.items():
            if name == "kind":
                continue
            same = (name, field.description, _takes(field), _default(field), *_bounds(field))
            kinds = found[same].kinds if same in found else ()
            found[same] = Key(f"{section}.{name}", field, (*kinds, kind) if kind else ())
    order = {name: index for index, name in enumerate(dict.fromkeys(key.name for key in found.values()))}
    return sorted(found.values(), key=lambda key: order[key.name])


def all_keys() -> list[str]:
    """Return every key that a scenario may have, with its section, each once."""
    return [name for section in sections() for name in _names(section)]


def _names(section: str) -> list[str]:
    kind = [f"{section}.kind"] if _has_kinds(section) else []
    return [*kind, *dict.fromkeys(key.name for key in keys(section))]


def _has_kinds(section: str) -> bool:
    return len(variants(section)) > 1


def choices(key: str) -> list[str]:
    """Return the words that a key may say, without users' classes; none if it takes other values."""
    section, _, name = key.partition(".")
    if (family := families().get(key)) is not None:
        return family.names()
    if name == "kind" and _has_kinds(section):
        return list(variants(section))
    words = [word for found in keys(section) if found.name == key for word in _literals(found.field.annotation)]
    booleans = any(found.field.annotation is bool for found in keys(section) if found.name == key)
    return ["true", "false"] if booleans else list(dict.fromkeys(words))


def describe_section(section: str) -> str:
    """Return the help of a section: what it is, its kinds and its keys."""
    known = sections()
    if section not in known:
        near = elsewhere(section) or section_meant(section, known)
        cure = f"did you mean {near!r}?" if near else f"sections are {', '.join(known)}"
        raise ScenarioError(f"there is no section {shown(section)}; {cure}")
    lines = _wrapped(f"[{section}] ", known[section])
    if table_type(section):
        lines = [*_wrapped(f"[[{section}]] ", known[section]), "", *_wrapped("", OF_A_TABLE.format(section))]
    if _has_kinds(section):
        lines += ["", *_kinds(section)]
    place = ".N" if table_type(section) else ""  # for the number of the table
    for key in keys(section):
        kinds = "" if len(key.kinds) == len(variants(section)) else f"  [{', '.join(key.kinds)}]" if key.kinds else ""
        head = f"  --{section}{place}{key.name.removeprefix(section)} ({_default(key.field)})"
        names = next((f"{_members(one)}: " for one in key.field.metadata if isinstance(one, OneOf)), "")
        meaning = names + (key.field.description or "")
        lines += ["", *_wrapped(head, kinds, hang=8), *_wrapped("        ", meaning)]
    return "\n".join(lines)


def explain_key(key: str) -> str:
    """Return what a key is: its meaning, unit, values, bounds and default, and the kinds that have it.

    Of a word without a dot, the help of the section with that name.
    """
    key = described_key(key)
    section, dot, name = key.partition(".")
    if not dot:
        return describe_section(section)
    if section not in sections() or key not in _names(section):
        raise ScenarioError(f"there is no key {shown(key)}; {_meant(section, name)}")
    if name == "kind":
        return "\n".join([f"{key}: one of", *_kinds(section)])
    return "\n\n".join("\n".join(_explained(found)) for found in keys(section) if found.name == key)


def _meant(section: str, name: str) -> str:
    """Return which key is meant by one that there is not."""
    known = section if section in sections() else section_meant(section, sections())
    near = key_meant(name, {each.partition(".")[2]: None for each in _names(known)}) if known else None
    found = f"{known}.{near}" if near else elsewhere(name)
    return f"did you mean {found!r}?" if found else "--help SECTION lists the keys of a section"


def facts(key: Key) -> dict[str, str]:
    """Return the unit, values, bounds, default and kinds of a key, in words; "" of what it has none."""
    return {
        "unit": " or ".join(sorted(unit or "none" for unit in field_units(key.field))),
        "value": _takes(key.field),
        "bounds": "; ".join(dict.fromkeys(_bounds(key.field))),  # the same for each of three numbers
        "default": _default(key.field),
        "kinds": ", ".join(key.kinds) if _has_kinds(key.name.partition(".")[0]) else "",
    }


def _explained(key: Key) -> Iterator[str]:
    yield from _wrapped(f"{key.name}: ", key.field.description or "", hang=4)
    for what, text in facts(key).items():
        if text:
            yield from _wrapped(f"  {what:9}", text)


def kinds(section: str) -> dict[str, str]:
    """Return the kinds of a section and what each is; none of a section that has no kinds."""
    told, usual = {}, usual_kind(section)
    for kind, variant in variants(section).items() if _has_kinds(section) else ():
        text = (variant.__doc__ or "").strip().partition("\n")[0]
        text = re.sub(r'^\[.*?\](?: kind = ".*?")?(?:, .*?)?: ', "", text).rstrip(".")
        told[kind] = text + ("; the default" if kind == usual else "")
    return told


def _kinds(section: str) -> list[str]:
    lines = [line for kind, text in kinds(section).items() for line in _wrapped(f'  kind = "{kind}"  ', text, hang=8)]
    if f"{section}.kind" in families():
        lines.append(f"  or {OWN}, on the command line")
    return lines


def _members(key: OneOf) -> str:
    """Return the names that a key may say, with the order of each that has one."""
    orders = {name: getattr(member, "order", None) for family in key.families for name, member in family.items()}
    said = (name if order is None else f"{name} (order {order})" for name, order in orders.items())
    return ", ".join([*key.words, *said, OWN])


def _default(field: FieldInfo) -> str:
    """Return a key's default as TOML spells it, or that there is none."""
    if field.is_required():
        return "must be given"
    value = field.default
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"


def _bounds(field: FieldInfo) -> Iterator[str]:
    for part in field.metadata:
        if isinstance(part, Gt):
            yield f"greater than {part.gt:g}"
        elif isinstance(part, Ge):
            yield f"at least {part.ge:g}"
        elif isinstance(part, Le):
            yield f"at most {part.le:g}"
    for size in sizes(Annotated[field.annotation, *field.metadata, None]):
        yield f"magnitude {size}: {size.why}" + (f"; {size.tiny}" if size.least else "")


def _takes(field: FieldInfo) -> str:
    one = next((each for each in field.metadata if isinstance(each, OneOf)), None)
    return _members(one) if one else _kind_of_value(field.annotation)


_PLAIN = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def _kind_of_value(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    if origin is Annotated:
        return _kind_of_value(parts[0])
    if origin is Literal:
        return " or ".join(f'"{word}"' for word in parts)
    if origin is tuple:
        inner = _kind_of_value(parts[0])
        if Ellipsis not in parts:
            return f"{COUNTS[len(parts)]} {'numbers' if inner == 'a number' else f'lists of {inner}'}"
        return "a list of numbers" if inner == "a number" else f"a list of lists of {inner}"
    if origin is dict:
        return "a table of numbers by joint"
    return " or ".join(_kind_of_value(part) for part in parts if part is not NoneType)


def _literals(annotation: Any) -> Iterator[str]:
    """Return the words that an annotation names, wherever in it."""
    if get_origin(annotation) is Literal:
        yield from get_args(annotation)
    else:
        for part in get_args(annotation):
            yield from _literals(part)


def _wrapped(head: str, text: str, hang: int | None = None) -> list[str]:
    """Return lines of at most `WIDTH` characters that begin with `head`; those after the first are indented."""
    indent = " " * (len(head) if hang is None else hang)
    return textwrap.wrap(
        text, WIDTH, initial_indent=head, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False
    ) or [head.rstrip()]
