"""What may stand in an MJCF: elements, attributes, names and references, for the whole file.

MuJoCo refuses a misspelt attribute, a name that occurs twice and a reference to nothing; a file that it refuses is not
a model, even where the fault lies in a section that has no part in the mechanism.
"""

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from pathlib import Path

from robot_models.errors import ModelError
from robot_models.xml_text import numbers

# One element a line, indented by dots: its tag, how often it may stand in its parent (?, *, ! for once, R for nested)
# and its attributes, from mj_printSchema of MuJoCo 3.17; a test compares the two. Behind an attribute stands what it
# holds, as MuJoCo's own answers to trial values say: ":3" three numbers, ":1-5" one to five, ":1-" any number of them,
# an "i" behind for whole ones and an "f" for such as fit a float; "=a|b" one of these words; "!" that it must be
# given.
_FILE = Path(__file__).with_name("mjcf_schema.txt")

_WHOLE = re.compile(r"[-+]?[0-9]{1,12}", re.ASCII)
_FLOAT_MAX = 3.4e38

#: Elements that enclose bodies; what may stand in them is judged where they are read.
_BODIES = ("worldbody", "body", "frame", "replicate")

# Sections in which all elements share one space of names.
_SHARED = ("actuator", "sensor", "tendon", "equality")

# What an actuator drives, one of these.
_DRIVEN = {"joint", "jointinparent", "tendon", "slidersite", "site", "body"}

# Which attribute names an element of which space, wherever it stands.
_REFERENCES = {
    **dict.fromkeys(("joint", "jointinparent", "joint1", "joint2"), "joint"),
    **dict.fromkeys(("site", "refsite", "cranksite", "slidersite", "sidesite"), "site"),
    **dict.fromkeys(("body", "body1", "body2", "target"), "body"),
    **dict.fromkeys(("geom", "geom1", "geom2"), "geom"),
    **{name: name for name in ("material", "mesh", "texture", "hfield", "tendon", "actuator")},
}


@dataclass
class _Element:
    """One line of the schema."""

    many: str
    attributes: dict[str, str]
    children: dict[str, "_Element"] = field(default_factory=dict)


@cache
def _schema() -> _Element:
    path: list[_Element] = []
    for line in _FILE.read_text(encoding="utf-8").splitlines():
        tag, many, *attributes = line.split()
        depth = (len(tag) - len(tag.lstrip("."))) // 2
        element = _Element(many, dict(_split(word) for word in attributes))
        del path[depth:]
        if path:
            path[-1].children[tag.lstrip(".")] = element
        path.append(element)
    return path[0]


def _split(word: str) -> tuple[str, str]:
    end = min((word.index(mark) for mark in "!:=" if mark in word), default=len(word))
    return word[:end], word[end:]


def check_schema(root: ET.Element, where: str) -> None:
    """Refuse elements and attributes that MJCF does not know, repeated names and dangling references.

    Parameters
    ----------
    root
        The document, its includes resolved.
    where
        How to name it in a message.

    Raises
    ------
    ModelError
        The first fault, by its element.
    """
    schema = _schema()
    names: dict[str, set[str]] = {"body": {"world"}}
    _check_attributes(root, schema, f"{where}: <mujoco>")
    for section in root:
        if section.tag in _BODIES:
            continue  # below, with what it holds
        if section.tag not in schema.children:
            raise ModelError(f"{where}: <mujoco> does not know <{section.tag}>{_near(section.tag, schema.children)}")
        _walk(section, schema.children[section.tag], section.tag, names, where)
    for section in root.findall("worldbody"):
        _walk(section, schema.children["body"], "worldbody", names, where)
    for section in root:
        _check_references(section, names, where)


def _walk(element: ET.Element, schema: _Element, section: str, names: dict[str, set[str]], where: str) -> None:
    at = f"{where}: <{element.tag}>" + (f" {element.get('name')!r}" if element.get("name") else "")
    _check_attributes(element, schema, at)
    name = element.get("name") or (_stem(element) if section == "asset" else "")
    if name and element.tag != section:
        space = section if section in _SHARED else {"freejoint": "joint"}.get(element.tag, element.tag)
        taken = names.setdefault(space, set())
        if name in taken:
            raise ModelError(f"{at}: the name is taken: names must differ")
        taken.add(name)
    counts: dict[str, int] = {}
    for child in element:
        inside = schema.children.get(child.tag)
        if inside is None and child.tag in ("body", "default") and child.tag in (element.tag, _alias(element.tag)):
            inside = schema
        if inside is None:
            if element.tag in _BODIES:
                continue  # refused by name, with the reason, where bodies are read
            raise ModelError(f"{at} does not know <{child.tag}>{_near(child.tag, schema.children)}")
        counts[child.tag] = counts.get(child.tag, 0) + 1
        if inside.many == "?" and counts[child.tag] > 1:
            raise ModelError(f"{at} has {counts[child.tag]} <{child.tag}>: one is allowed")
        _walk(child, inside, section, names, where)


def _alias(tag: str) -> str:
    return "body" if tag == "worldbody" else tag


def _check_attributes(element: ET.Element, schema: _Element, at: str) -> None:
    for key, value in element.attrib.items():
        if key not in schema.attributes:
            raise ModelError(f"{at}: unknown attribute {key!r}{_near(key, schema.attributes)}")
        _check_value(value, schema.attributes[key], f"{at}: {key}")
    for key, holds in schema.attributes.items():
        if holds.startswith("!") and key not in element.attrib:
            raise ModelError(f"{at} lacks {key!r}")
    if element.tag == "worldbody" and element.attrib:
        raise ModelError(f"{at}: the world has no attributes: give them to a body in it")


def _check_value(value: str, holds: str, what: str) -> None:
    holds = holds.removeprefix("!")
    if holds.startswith("="):
        words = holds[1:].split("|")
        if value not in words:
            raise ModelError(f"{what} is {value!r}: it must be one of {', '.join(words)}")
    if not holds.startswith(":"):
        return
    kind = holds[-1] if holds[-1] in "if" else ""
    least, *most = holds[1:].removesuffix(kind).split("-")
    exact = int(least) if not most else None
    found = numbers(value, exact, what)
    if most and not int(least) <= len(found) <= int(most[0] or len(found)):
        raise ModelError(f"{what} is {value!r}: it must be {least} to {most[0]} numbers")
    if kind == "i" and not all(_WHOLE.fullmatch(word) and abs(int(word)) < 2**31 for word in value.split()):
        raise ModelError(f"{what} is {value!r}: it must be {'a whole number' if exact == 1 else 'whole numbers'}")
    if kind == "f" and any(abs(number) > _FLOAT_MAX for number in found):
        raise ModelError(f"{what} is {value!r}: some number is far too large")


def _check_references(section: ET.Element, names: dict[str, set[str]], where: str) -> None:
    if section.tag in ("default", "visual", "extension", "custom"):
        return
    for element in section.iter():
        if section.tag == "actuator" and element is not section and not _DRIVEN & set(element.attrib):
            raise ModelError(f"{where}: <{element.tag}> {element.get('name', '')!r} drives nothing: give it a joint")
        for key, value in element.attrib.items():
            space = _REFERENCES.get(key, "")
            if space and value not in names.get(space, ()):
                raise ModelError(f"{where}: <{element.tag}>: {key} {value!r} is not in the model")


def _stem(element: ET.Element) -> str:
    """Return the name that an asset takes from its file."""
    return Path(element.get("file", "")).stem


def _near(word: str, known: object) -> str:
    near = get_close_matches(word, list(known), n=1)  # type: ignore[call-overload]
    return f": did you mean {near[0]!r}?" if near else ""
