"""TOML from strangers: text to tables, or a one-line reason why not, soon."""

import re
import tomllib
from typing import Any

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
