"""Standard output and standard error whose errors stop no command.

The reader of a pipe may have ended (``| head -1``), the disk may be full, a stream may be closed, or its encoding may
lack characters, which others then replace. Errors are kept and reported afterwards; nothing raises, not even when
Python ends.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import select
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any


class Patient(io.RawIOBase):
    """A raw stream that accepts all writes; after the first failure it discards them.

    Attributes
    ----------
    failure : OSError or None
        The first error.
    """

    def __init__(self, inner: Any) -> None:
        super().__init__()
        self.inner = inner
        self.failure: OSError | None = None

    def writable(self) -> bool:
        """It can be written."""
        return True

    def fileno(self) -> int:
        """Return the descriptor."""
        return int(self.inner.fileno())

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return bool(self.inner.isatty())

    def write(self, data: Any, /) -> int:
        """Write, or know why not."""
        view = memoryview(data).cast("B")
        while self.failure is None:
            try:
                written = self.inner.write(view)
                if written is not None:
                    return int(written)
                select.select([], [self.inner], [])  # a pipe that does not wait, and is full
            except OSError as error:
                self.failure = error
            except ValueError as error:  # closed
                self.failure = OSError(errno.EBADF, str(error))
        return view.nbytes


@contextmanager
def patient_output() -> Iterator[list[Patient]]:
    """Let standard output and error be such streams meanwhile; yield that of the output, if it became one."""
    _fill_closed_descriptors()
    before = sys.stdout, sys.stderr
    out, made = _patient(sys.stdout)
    err, _ = _patient(sys.stderr)
    sys.stdout, sys.stderr = out, err
    try:
        yield made
    finally:
        with suppress(ValueError):  # someone closed it
            out.flush()
        with suppress(ValueError):
            err.flush()
        sys.stdout, sys.stderr = before


def _fill_closed_descriptors() -> None:
    """Open what was closed (``>&-``) on the null device: else the next file that is opened gets what is printed."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _patient(stream: Any) -> tuple[IO[str], list[Patient]]:
    """Return a stream in place of this one; itself where it is no file, as in a test or a notebook."""
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8"), []
    inner = getattr(stream, "buffer", None)
    inner = getattr(inner, "raw", inner)
    if not (isinstance(stream, io.TextIOWrapper) and isinstance(inner, io.RawIOBase)):
        return stream, []
    with suppress(OSError):
        stream.flush()
    raw = Patient(inner)
    text = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=HANDLER,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
    return text, [raw]


HANDLER = "closedloop.command.streams"
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
