"""Whole columns of a sweep as a NetCDF-4 file, on a disk that may be full.

HDF5 does not survive a failed write: its cache keeps the data that it could not write, and the process ends with a
segmentation fault when the file is closed. So write errors are hidden from it: see `Unfailing`.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from closedloop.record.columns.recorded import ALL_COLUMNS

if TYPE_CHECKING:
    from closedloop.studies.sweep.store import Store


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
    error : OSError or None
        The first.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file.raw if isinstance(file, (io.BufferedRandom, io.BufferedWriter)) else file
        self._at = self._end = 0
        self._held: list[tuple[int, bytes]] = []
        self.error: OSError | None = None

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
            except OSError as error:
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
            except OSError as error:
                self.error = error
        return self._end


def write_columns(
    file: BinaryIO, store: Store, parts: int, attributes: dict[str, str], step: float, check: Callable[[], None]
) -> None:
    """Write the whole columns of all parts into a file.

    Parameters
    ----------
    file : binary file
        Open for reading and writing, empty.
    store : Store
        All parts are there.
    parts : int
        How many parts there are.
    attributes : dict of str to str
        Of the file.
    step : float
        Time between the rows of a run, s, where the runs do not say.
    check : callable
        Called between two parts; it may raise.

    Raises
    ------
    OSError
        If something could not be written.
    """
    import h5netcdf

    runs, rows = store.identity["runs"], 0
    for part in range(parts):
        rows = max(rows, max(store.read(part)["rows"].to_pylist(), default=0))
    steady = Unfailing(file)
    with h5netcdf.File(steady, "w") as out:
        out.attrs.update(attributes)
        out.dimensions = {"run": runs, "time": rows, "axis": 3}
        if "time.step" in store.identity["axes"]:
            steps = out.create_variable("time_step", ("run",), "f8")
            steps.attrs["units"] = "s"
        else:
            out.create_variable("time", ("time",), data=step * np.arange(rows)).attrs["units"] = "s"
        first = 0
        for part in range(parts):
            check()
            table = store.read(part)
            stop = first + len(table)
            if "time.step" in store.identity["axes"]:
                steps[first:stop] = table["time.step"].to_numpy()
            for name, data in store.read_columns(part).items():
                if data.shape[1] == 0:  # no run of this part has a row
                    continue
                if name not in out.variables:
                    _create(out, name, rows, data.shape[2:])
                out.variables[name][first:stop, : data.shape[1]] = data
                steady.check()
            first = stop
    steady.check()


def _create(file: Any, name: str, rows: int, wide: tuple[int, ...]) -> None:
    column = ALL_COLUMNS[name]
    if wide and column.dims[1] not in file.dimensions:
        file.dimensions[column.dims[1]] = wide[0]
    variable = file.create_variable(
        name, ("run", *column.dims), "f8", fillvalue=np.nan, chunks=(1, max(rows, 1), *wide), fletcher32=True
    )  # fmt: skip
    variable.attrs["units"], variable.attrs["long_name"] = column.units, column.meaning
