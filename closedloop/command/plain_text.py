"""Text for an output whose encoding lacks some characters, such as a Windows console or the locale C.

An error handler of Python's codecs: a missing character becomes similar ASCII (ζ zeta, ² 2, a table's line -), or its
code.
"""

from __future__ import annotations

import codecs
import unicodedata

HANDLER = "closedloop.command.plain_text"
ALIKE = {
    "−": "-", "–": "-", "—": "-", "…": "...", "×": "x", "·": "*", "≤": "<=", "≥": ">=", "≈": "~", "→": "->", "←": "<-",
    "∞": "inf", "√": "sqrt", "∂": "d", "°": " deg", "•": "*", "‘": "'", "’": "'", "“": '"', "”": '"', "„": '"',
    "µ": "u", "✓": "ok", "✗": "X", "\u0307": "'", "\u0308": "''", "█": "#",
}  # fmt: skip


def plain(character: str) -> str:
    """Return ASCII for one character."""
    if character.isascii():
        return character
    if character in ALIKE:
        return ALIKE[character]
    name = unicodedata.name(character, "")
    if name.startswith("GREEK SMALL LETTER ") and name.count(" ") == 3:
        return name.rpartition(" ")[2].lower()
    if name.startswith("GREEK CAPITAL LETTER ") and name.count(" ") == 3:
        return name.rpartition(" ")[2].capitalize()
    if name.startswith("BOX DRAWINGS"):
        horizontal, vertical = "HORIZONTAL" in name, "VERTICAL" in name
        return "-" if horizontal and not vertical else "|" if vertical and not horizontal else "+"
    parts = unicodedata.normalize("NFKD", character)
    if parts == character:
        return character.encode("ascii", "backslashreplace").decode("ascii")
    dotted = "'" if "\u0307" in parts else ""  # a derivative in time
    return "".join(plain(part) for part in parts if not unicodedata.combining(part)) + dotted


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(plain, error.object[error.start : error.end])), error.end


codecs.register_error(HANDLER, _replace)
