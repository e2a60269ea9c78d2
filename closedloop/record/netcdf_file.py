"""NetCDF-4 files on a disk that may be full.

HDF5 does not survive a failed write: it ends the process when the file is closed. So the room is reserved before it
begins (`closedloop.base.files.write_whole`), and what was not needed is given back.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from numpy.typing import NDArray

from closedloop.base.files import write_whole

# Bytes that HDF5 takes beside numbers and texts at most: for a file, and for each variable.
OF_FILE, OF_VARIABLE = 100_000, 10_000


class Variable(NamedTuple):
    """What is written of a variable."""

    dims: tuple[str, ...]  # the names of its dimensions
    data: NDArray[Any]  # numbers, or text as an array of objects
    attributes: Mapping[str, str] = {}  # texts by name


def write_netcdf(
    path: Path, dimensions: Mapping[str, int], variables: Mapping[str, Variable], attributes: Mapping[str, Any],
    then: Callable[[BinaryIO], None],
) -> Path:  # fmt: skip
    """Write a NetCDF-4 file whole, or not at all.

    Parameters
    ----------
    dimensions : mapping
        Lengths by name.
    variables : mapping
        By name; one with the name of a dimension has that dimension alone.
    attributes : mapping
        The file's own attributes.
    then : callable
        Writes what goes behind it.

    Raises
    ------
    OutputError
    """
    import h5py

    def write(out: Any) -> None:
        out.dimensions = {name: length or None for name, length in dimensions.items()}  # it knows no empty one
        for name, (dims, data, texts) in variables.items():
            kind = h5py.string_dtype() if data.dtype == object else data.dtype
            out.create_variable(name, dims, kind, data=data).attrs.update(texts)
        out.attrs.update(attributes)

    texts = [*attributes.values(), *(text for each in variables.values() for text in each.attributes.values())]
    room = sum(each.data.nbytes + OF_VARIABLE for each in variables.values()) + 4 * sum(
        len(str(text)) for text in texts
    )
    return write_reserved(path, room, write, then)


def write_reserved(
    path: Path, room: int, write: Callable[[Any], None], then: Callable[[BinaryIO], None] = lambda file: None
) -> Path:
    """Let a function write an `h5netcdf.File` for which so many bytes are reserved, beside those for an empty one."""
    import h5netcdf

    def whole(file: BinaryIO) -> None:
        empty = io.BytesIO()
        h5netcdf.File(empty, "w").close()
        file.write(empty.getbuffer())  # a file that HDF5 makes it would truncate, and so give the room back
        with h5netcdf.File(file, "r+") as out:
            write(out)
        file.seek(0, io.SEEK_END)
        then(file)

    return write_whole(path, whole, reserve=OF_FILE + room)
