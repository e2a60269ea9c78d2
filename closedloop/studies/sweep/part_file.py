"""The file of a part: its content, its name, and a line with the SHA-256 of both (`closedloop.record.sealed`)."""

from __future__ import annotations

from pathlib import Path

from closedloop.base.files import write_whole
from closedloop.record.sealed import seal, unsealed


def write_part(path: Path, content: memoryview) -> None:
    """Write a part's file whole, or not at all."""
    named = b"".join((content, path.name.encode()))
    write_whole(path, b"".join((named, seal(named))))


def read_part(path: Path) -> memoryview:
    """Return the content of a part's file.

    Raises
    ------
    OSError, ValueError
        If there is none, it is damaged, or it was written under another name.
    """
    named, name = unsealed(memoryview(path.read_bytes())), path.name.encode()
    if named is None or named[-len(name) :] != name:
        raise ValueError("is damaged, or another file")
    return named[: -len(name)]
