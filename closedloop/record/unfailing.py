"""A file for HDF5 on a disk that may be full.

HDF5 does not survive a failed write: its cache keeps the data that it could not write, and the process ends with a
segmentation fault when the file is closed. So write errors are hidden from it.
"""

from __future__ import annotations

import io
from contextlib import suppress
from typing import Any, BinaryIO


class Unfailing(io.RawIOBase):
    """A file in which writing does not fail: the first error is kept, and what could not be written is kept in memory.

    Reading returns what was written, so HDF5 goes on until the error is raised by `check`. After an error little more
    should be written.

    Parameters
    ----------
    file : binary file
        Open for reading and writing, empty.

    Attributes
    ----------
    error : BaseException or None
        The first; Ctrl-C is one, too.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file.raw if isinstance(file, (io.BufferedRandom, io.BufferedWriter)) else file
        self._at = self._end = 0
        self._held: list[tuple[int, bytes]] = []
        self.error: BaseException | None = None

    def check(self) -> None:
        """Raise the first error, if there was one."""
        if self.error is not None:
            raise self.error

    def seekable(self) -> bool:
        """Return that it is."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end}[whence]
        return self._at

    def tell(self) -> int:
        """Return the place."""
        return self._at

    def write(self, data: Any) -> int:
        """Write all of the data, here or there."""
        view = memoryview(data).cast("B")
        if self.error is None:
            try:
                self._file.seek(self._at)
                written = 0
                while written < len(view):
                    written += self._file.write(view[written:]) or 0
            except BaseException as error:
                self.error = error
        if self.error is not None:
            self._held.append((self._at, bytes(view)))
        self._at += len(view)
        self._end = max(self._end, self._at)
        return len(view)

    def readinto(self, into: Any) -> int:
        """Read what was written; zeros where nothing was."""
        view = memoryview(into).cast("B")
        length = max(0, min(len(view), self._end - self._at))
        view[:length] = bytes(length)
        with suppress(OSError):
            self._file.seek(self._at)
            found = self._file.read(length)
            view[: len(found)] = found
        for at, data in self._held:
            low, high = max(at, self._at), min(at + len(data), self._at + length)
            if low < high:
                view[low - self._at : high - self._at] = data[low - at : high - at]
        self._at += length
        return length

    def truncate(self, size: int | None = None) -> int:
        """Make it longer or shorter."""
        self._end = self._at if size is None else size
        if self.error is None:
            try:
                self._file.truncate(self._end)
            except BaseException as error:
                self.error = error
        return self._end
