"""The file of a part: its content, its name, and a seal over both (`closedloop.record.sealed`)."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from closedloop.base.files import write_whole
from closedloop.record.sealed import seal, unsealed


def write_part(path: Path, content: memoryview) -> None:
    """Write a part's file whole, or not at all.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    named = memoryview(b"".join((content, path.name.encode())))

    def write(file: BinaryIO) -> None:
        file.write(named)
        file.write(seal(named))

    write_whole(path, write)


def read_part(path: Path) -> memoryview:
    """Return the content of a part's file.

    Raises
    ------
    OSError, ValueError
        If there is none, it is damaged, or it was written under another name.
    """
    named, name = unsealed(memoryview(path.read_bytes())), path.name.encode()
    if named[-len(name) :] != name:
        raise ValueError("is another file")
    return named[: -len(name)]
