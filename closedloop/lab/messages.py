"""Messages to the page: a tree of plain values and arrays as bytes, which both a socket and a file can hold.

Four bytes give the length of the header, which is JSON, padded to whole words; behind it are the arrays, which the
header names by where they begin and how many numbers they have. `web/numbers.js` reads them.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

# Of an array in the header, by its type: 32-bit numbers, the least significant byte first; NaN stays NaN.
FLOATS, WHOLE = "$f", "$u"
WORD = 4


def pack(message: Any) -> bytes:
    """Return a message as bytes: dicts, lists, text, numbers, None, and arrays of any shape, which are read flat.

    A number that is not finite, outside of an array, is sent as null.
    """
    arrays: list[bytes] = []
    count = 0

    def plain(value: Any) -> Any:
        nonlocal count
        if isinstance(value, np.ndarray):
            kind, form = (WHOLE, "<u4") if value.dtype.kind in "ui" else (FLOATS, "<f4")
            with np.errstate(over="ignore"):
                arrays.append(np.ascontiguousarray(value.astype(form)).tobytes())
            found = {kind: [count, value.size]}
            count += value.size
            return found
        if isinstance(value, dict):
            return {str(key): plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        if isinstance(value, float | np.floating):
            return float(value) if np.isfinite(value) else None
        return value.item() if isinstance(value, np.generic) else value

    header = json.dumps(plain(message), allow_nan=False, ensure_ascii=False).encode("utf-8", "replace")
    header += b" " * (-len(header) % WORD)
    return struct.pack("<I", len(header)) + header + b"".join(arrays)


def unpack(data: bytes) -> Any:
    """Return the message of `pack`, with flat arrays of 32 bits."""
    (length,) = struct.unpack_from("<I", data)
    begin = WORD + length

    def arrays(value: dict[str, Any]) -> Any:
        for kind, form in ((FLOATS, "<f4"), (WHOLE, "<u4")):
            if kind in value:
                return np.frombuffer(data, form, value[kind][1], begin + WORD * value[kind][0])
        return value

    return json.loads(data[WORD:begin], object_hook=arrays)


def in_text(messages: Iterator[Any] | list[Any]) -> str:
    """Return messages as lines of base64, as a page holds them."""
    return "\n".join(base64.b64encode(pack(message)).decode("ascii") for message in messages)


def from_text(text: str) -> list[Any]:
    """Return the messages of `in_text`."""
    return [unpack(base64.b64decode(line)) for line in text.split()]
