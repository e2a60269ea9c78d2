"""Descriptions of a scenario's keys, for --help, and the one-line messages about faults in one."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Annotated, Any, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from closedloop.errors import one_line
from closedloop.families import NOT_NAMED, Family, OneOf, how_to_name
from closedloop.scenario.scenario import Scenario
from closedloop.sections import Section, SizeError, sizes
from robot_models.errors import shown as shown_value

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
    return list(variants(section)) if family is None else family.shipped()


def _usual(section: str) -> str:
    """Return the kind of a section that names none, "" where there are no kinds."""
    family = _family(section)
    return next(iter(variants(section)), "") if family is None else family.usual or ""


def variant_keys(section: str, kind: Any) -> set[str]:
    """Return the keys that a section of this kind may have."""
    variant = variants(section).get(kind)
    return set(variant.model_fields) if variant else set()


def describe_keys() -> list[tuple[str, str]]:
    """Return (dotted key, what it is) for every key a scenario may have, in order."""
    rows: list[tuple[str, str]] = []
    for section in Scenario.model_fields:
        for kind, variant in variants(section).items():
            for key, field in variant.model_fields.items():
                if key == "kind":
                    continue
                suffix = f" [{kind}]" if len(variants(section)) > 1 else ""
                default = "" if field.is_required() or field.default is None else f" (default {field.default})"
                span = "".join(f"; {size}" for size in sizes(Annotated[field.annotation, *field.metadata, None]))
                names = "".join(f"{_members(one)}; " for one in field.metadata if isinstance(one, OneOf))
                rows.append((f"{section}.{key}", f"{names}{field.description or ''}{span}{default}{suffix}"))
        if len(variants(section)) > 1:
            own = f" | {OWN}" if _family(section) else ""
            rows.append((f"{section}.kind", " | ".join(variants(section)) + own))
    return rows


def _members(key: OneOf) -> str:
    """Return the names that a key may say, with the order of each that has one."""
    orders = {name: getattr(member, "order", None) for family in key.families for name, member in family.items()}
    said = (name if order is None else f"{name} (order {order})" for name, order in orders.items())
    return ", ".join([*said, OWN])


# What is right, for the kinds of fault whose text does not depend on the key.
CURES = {
    "greater_than": "must be greater than 0",
    "greater_than_equal": "must not be negative",
    "finite_number": "must be finite, not NaN or infinite",
    "string_type": "must be text",
    "tuple_type": "must be a list of numbers",
    "too_long": "must be three numbers",  # the only lists of fixed length are vectors
    "too_short": "must be three numbers",
}


LONGEST_KEY = 60  # characters, more than any has; a joint's name may


def explain(error: ValidationError, data: dict[str, Any]) -> str:
    """Return one line about an error of pydantic's: which key, which value, what would be right."""
    # An unknown key first: it is often the misspelt name of one that is missing.
    problems = sorted(error.errors(include_url=False), key=lambda p: p["type"] != "extra_forbidden")
    return one_line(_explain_first(problems, data))


def _explain_first(problems: list[ErrorDetails], data: dict[str, Any]) -> str:
    first = problems[0]
    location = [_brief(str(part)) for part in first["loc"]]
    section = location[0] if location else ""
    # pydantic names the branch of a union that it tried, after the section; a user knows only keys and places in lists.
    union = section in Scenario.model_fields and _family(section) is None and len(variants(section)) > 1
    if union and location[1:2] and location[1] in variants(section):
        del location[1]
    known = _all_keys(section)
    path = [p for k, p in enumerate(location) if p.isdigit() or k == 0 or p in known or "lock" in location]
    name = "".join(f"[{p}]" if p.isdigit() else f".{p}" for p in path).removeprefix(".")
    kind, value = first["type"], first.get("input")
    shown = "a table" if isinstance(value, dict) else shown_value(value)
    if isinstance(value, bool):
        shown = str(value).lower()  # as TOML spells it
    others = {tuple(p["loc"][:2]) for p in problems} - {tuple(first["loc"][:2])}
    more = f" (and {len(others)} more)" if others else ""
    if kind == "extra_forbidden":
        return f"unknown key '{'.'.join(location)}'; {_known_keys(section, location, data)}{more}"
    if kind == "missing" and location[-1].isdigit():
        name, shown, cure = name.partition("[")[0], shown_value(value), CURES["too_short"]
    elif kind == "missing":
        return f"'{'.'.join(location)}' is missing{more}"
    elif kind == "value_error" and isinstance(first["ctx"]["error"], SizeError):
        cure = str(first["ctx"]["error"])
    elif name == "surface.offset":
        cure = 'must be a finite number of metres, or "start"'
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        shown = shown_value(first["ctx"].get("tag")) if kind == "union_tag_invalid" else "missing"
        more = ""  # the other faults are those of no kind
        name, cure = f"{name}.kind", f"must be {' or '.join(map(repr, _shipped_kinds(section)))}"
    elif kind == NOT_NAMED:
        user = first["ctx"]["name"]
        name = f"{name}.kind" if isinstance(value, dict) else name
        shown, cure, more = shown_value(user), how_to_name(name, user), ""
    elif kind == "literal_error":
        more = "" if name.endswith(".kind") else more
        cure = f"must be {first['ctx']['expected']}"
    elif kind in ("model_type", "model_attributes_type", "dict_type"):
        cure = f"must be a section of its own, [{name}]"
    elif kind == "less_than_equal":
        cure = f"must be at most {first['ctx']['le']:g}"
    elif kind == "value_error":
        cure = str(first["ctx"]["error"])
    else:
        cure = CURES.get(kind, first["msg"])
    return f"{name} = {shown}: {cure}{more}"


def _brief(key: str) -> str:
    """Return a key as messages show it: whole, but for one of absurd length."""
    return key if len(key) <= LONGEST_KEY else f"{key[:LONGEST_KEY]}..."


def _all_keys(section: str) -> set[str]:
    return {key for kind in variants(section) for key in variant_keys(section, kind)}


def _known_keys(section: str, path: list[str], data: dict[str, Any]) -> str:
    if len(path) == 1:
        known = list(Scenario.model_fields)
        place = "sections are"
    else:
        kinds = variants(section)
        kind = data[section].get("kind", _usual(section)) if isinstance(data[section], dict) else ""
        known = sorted(variant_keys(section, kind if isinstance(kind, str) and kind in kinds else ""))
        place = f"[{section}] knows"
    near = difflib.get_close_matches(path[-1], known, n=1, cutoff=0.5)
    return f"did you mean '{'.'.join([*path[:-1], near[0]])}'?" if near else f"{place} {', '.join(known)}"
