"""What sections, keys and kinds of a scenario are, in words: for --help and --explain."""

import re
import textwrap
from collections.abc import Iterator
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from annotated_types import Ge, Gt, Le
from pydantic.fields import FieldInfo

from closedloop.base.errors import ScenarioError
from closedloop.base.families import OneOf
from closedloop.base.sections import field_units, sizes
from closedloop.scenario.messages import (
    COUNTS,
    OWN,
    elsewhere,
    is_section,
    key_meant,
    section_meant,
    usual_kind,
    variants,
)
from closedloop.scenario.scenario import Scenario, families
from closedloop.scenario.tables import described_key, table_type
from robot_models.errors import shown

WIDTH = 80
OF_A_TABLE = "In place of N the number, from 0, or the name of one, or * for all: --{0}.*.KEY VALUE"


class Key(NamedTuple):
    """A key of a section, as some of the section's kinds have it."""

    name: str  # with the section, such as "law.kp"
    field: FieldInfo  # its type, bounds, default and description
    kinds: tuple[str, ...]  # the kinds that have it so; empty where the section has no kinds


def sections() -> dict[str, str]:
    """Return the sections of a scenario, in order, and what each is."""
    fields = Scenario.model_fields.items()
    return {name: field.description or "" for name, field in fields if is_section(name) or table_type(name)}


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
    for key in keys(section):
        kinds = "" if len(key.kinds) == len(variants(section)) else f"  [{', '.join(key.kinds)}]" if key.kinds else ""
        head = f"  --{_with_place(key.name)} ({_default(key.field)})"
        lines += ["", *_wrapped(head, kinds, hang=8), *_wrapped("        ", _meaning(key))]
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


def _with_place(key: str) -> str:
    """Return a key as it is given: with a place for the number, where its section is a list of tables."""
    section, _, name = key.partition(".")
    return f"{section}.N.{name}" if table_type(section) else key


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
    """Return the lines about a key."""
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
    """Return the lines about the kinds of a section."""
    lines = [line for kind, text in kinds(section).items() for line in _wrapped(f'  kind = "{kind}"  ', text, hang=8)]
    if f"{section}.kind" in families():
        lines.append(f"  or {OWN}, on the command line")
    return lines


def _meaning(key: Key) -> str:
    """Return what a key is, with the names that it may say."""
    names = next((one for one in key.field.metadata if isinstance(one, OneOf)), None)
    return (f"{_members(names)}: " if names else "") + (key.field.description or "")


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
    """Return the bounds of a key's numbers, in words."""
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
    """Return what values a key takes, in words."""
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
