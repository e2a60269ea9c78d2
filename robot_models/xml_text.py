"""XML and TOML from strangers: bytes to an element tree, text to tables, or a one-line reason why not, soon.

The tree is built by the standard library's expat. A document type declaration is refused before any of it is
read, so no entity is ever expanded and nothing outside the file is ever fetched.
"""

import re
import stat
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from sys import float_info
from typing import Any

from robot_models.errors import ModelError

#: Far above any published robot description (the largest in example-robot-data has 0.2 MB).
MAX_BYTES = 16_000_000

#: Elements nested deeper than this are an attack or a mistake; recursive readers further on rely on it.
MAX_DEPTH = 200

#: Elements of one document. The largest of example-robot-data has 3 600; at this bound parsing takes 0.2 s.
MAX_ELEMENTS = 100_000

# Plain ASCII decimals only. Python's float() also takes "1_0", "nan" and Arabic digits, which the C++ readers
# do not, and a number must not mean two things in two engines.
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?", re.ASCII)

_SIGNIFICANT = re.compile(r"[-+.0]*[1-9]", re.ASCII)

_ENCODING = re.compile(r"""\s*<\?xml[^>]*?encoding\s*=\s*["']([^"']+)""")


class _Builder(ET.TreeBuilder):
    """A tree builder that stops at a DOCTYPE and at absurd nesting or size."""

    depth = 0
    elements = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse the declaration (entities can only come from one)."""
        raise ModelError("a <!DOCTYPE> declaration is not accepted: write the file without it")

    def start(self, tag: str, attrs: dict[str, str]) -> ET.Element:
        """Open an element, counting the nesting."""
        self.depth += 1
        self.elements += 1
        if self.depth > MAX_DEPTH:
            raise ModelError(f"elements are nested deeper than {MAX_DEPTH} levels")
        if self.elements > MAX_ELEMENTS:
            raise ModelError(f"more than {MAX_ELEMENTS} elements: a robot description has far fewer")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ET.Element:
        """Close an element."""
        self.depth -= 1
        return super().end(tag)


def read_text(path: Path) -> str:
    """Return a file's text.

    path: the file; UTF-8, with or without a byte order mark
    Raises `ModelError` if the file is missing, a folder, a pipe or a device, unreadable, too large or not UTF-8.
    """
    try:
        kind = path.stat().st_mode
        if stat.S_ISDIR(kind):
            raise ModelError(f"{path} is a folder: name the .urdf or .xml file in it")
        if not stat.S_ISREG(kind):  # reading a pipe may wait for ever, and a device may never end
            raise ModelError(f"{path} is a pipe, a socket or a device: name a file")
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ModelError(f"no such file: {path}") from None
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}") from None
    except ValueError as error:  # a NUL in the path; ModelError is a ValueError too
        raise error if isinstance(error, ModelError) else ModelError(f"cannot read {path}: {error}") from None
    if len(raw) > MAX_BYTES:
        raise ModelError(f"{path} is larger than {MAX_BYTES // 10**6} MB: a robot description is far smaller")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} is not UTF-8 (byte {error.start}): save it as UTF-8") from None
    return text


def parse(text: str, where: str) -> ET.Element:
    """Return the root element of an XML text.

    Raises `ModelError` if the text is empty, malformed (with line and column), declares a DOCTYPE or nests absurdly.
    """
    if not text.strip():
        raise ModelError(f"{where} is empty")
    if len(text) > MAX_BYTES:
        raise ModelError(f"{where} is longer than {MAX_BYTES} characters")
    declared = _ENCODING.match(text)
    if declared and declared[1].lower() not in ("utf-8", "utf8", "us-ascii", "ascii"):
        raise ModelError(f"{where} declares the encoding {declared[1]!r}: save it as UTF-8 and declare that")
    parser = ET.XMLParser(target=_Builder())
    try:
        parser.feed(text)
        root: ET.Element = parser.close()
    except ET.ParseError as error:
        line, column = error.position
        reason = str(error).split(":")[0]
        raise ModelError(f"{where} is not well-formed XML: {reason}, line {line}, column {column + 1}") from None
    except UnicodeEncodeError:
        raise ModelError(f"{where} holds a character that UTF-8 cannot carry") from None
    except ModelError as error:
        raise ModelError(f"{where}: {error}") from None
    return root


def tidy(root: ET.Element) -> bool:
    """Take the blanks from both ends of every attribute, and leave none but plain ones between numbers, in place.

    What counts as a blank differs from reader to reader: urdfdom drops an `<inertial>` whose mass is "1 " or has a
    tab before it, where others read 1. After this no reader meets a tab, a line end, a no-break space or any other
    of Unicode's blanks around or between numbers, nor around a word.

    Returns whether anything was changed.
    """
    changed = False
    for element in root.iter():
        for key, value in element.attrib.items():
            plain, words = value.strip(), value.split()
            if any(c.isspace() and c != " " for c in plain) and all(map(_NUMBER.fullmatch, words)):
                plain = " ".join(words)
            if plain != value:
                element.set(key, plain)
                changed = True
    return changed


#: The largest angle that is read, rad or degrees: of a larger one the sine is rounding.
MAX_ANGLE = 1e6


def angles(value: str, count: int, what: str) -> list[float]:
    """Return the angles in an attribute, as `numbers` does.

    Raises `ModelError` also where an angle is beyond `MAX_ANGLE`.
    """
    found = numbers(value, count, what)
    if max(map(abs, found)) > MAX_ANGLE:
        raise ModelError(f"{what} is {value!r}: an angle must be at most {MAX_ANGLE:g}")
    return found


def numbers(value: str, count: int | None, what: str) -> list[float]:
    """Return the finite numbers in an attribute.

    value: the attribute's text, numbers separated by white space
    count: how many there must be; None for any positive number of them
    what: how to name the attribute and its owner in a message
    Raises `ModelError` if a word is not a plain decimal number, is too large or too small for a double, or there are
    too few or too many.
    """
    words = value.split()
    if not words or (count is not None and len(words) != count):
        wanted = "a number" if count == 1 else f"{count or 'some'} numbers"
        raise ModelError(f"{what} is {value!r}: it must be {wanted}")
    result = []
    for word in words:
        number = float(word) if _NUMBER.fullmatch(word) else float("nan")
        if number - number != 0.0:  # nan, or an overflow such as 1e999
            raise ModelError(f"{what} is {value!r}: {word!r} is not a finite decimal number")
        if abs(number) < float_info.min and _SIGNIFICANT.match(word):  # one reader rounds it to 0, another drops it
            raise ModelError(f"{what} is {value!r}: {word!r} is too small for a double: write 0")
        result.append(number)
    return result


def words(values: Iterable[float]) -> str:
    """Return numbers as an attribute has them, each read back to the last bit."""
    return " ".join(repr(float(value)) for value in values)


#: A dotted key of more parts than this is an attack or a mistake; the parser's time grows with their cube.
MOST_PARTS = 20

_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}[ \t]*+\.[ \t]*+){{{MOST_PARTS}}}", re.ASCII)


def toml_tables(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises `ValueError` if the text is no TOML, or is nested too deeply: the reason.
    """
    if _LONG_KEY.search(text):
        raise ValueError(f"a key has more than {MOST_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
