"""The bytes of a run file: NetCDF-4 written whole, and a line with the SHA-256 of all before it.

HDF5 does not survive a failed write: it ends the process when the file is closed. So the room is reserved before it
begins (`closedloop.base.files.write_whole`), and what was not needed is given back.

Behind the HDF5, where no reader looks, stands

    closedloop SHA-256 of all bytes before this line: 0123...

HDF5 trusts what it reads, and may loop for ever over damaged bytes or end the process: so the line is checked first. A
file without one was changed by another program, which cuts it off; HDF5 opens that as it is. Numbers that are in
another file are not read.
"""

import hashlib
import io
import json
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import RunFileError
from closedloop.base.files import kind_of, reason_of, write_whole

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


_WORDS = b"\nclosedloop SHA-256 of all bytes before this line: "
SEAL_LENGTH = len(_WORDS) + 64 + 1
# A column that says it is larger than its file, compressed at best, is not read.
BEST_COMPRESSION = 1100

Attributes = dict[str, str | int | float]
Columns = dict[str, NDArray[Any]]


def seal(content: bytes | memoryview) -> bytes:
    """Return the line that goes behind the content of a file."""
    return _WORDS + hashlib.sha256(content).hexdigest().encode() + b"\n"


def seal_file(file: BinaryIO) -> None:
    """Write the line behind the content of an open file."""
    file.seek(0)
    total = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]
    file.write(_WORDS + total.hexdigest().encode() + b"\n")


def unsealed(whole: memoryview) -> memoryview | None:
    """Return what stands before the line at the end of a file's bytes, None if there is no line.

    Raises
    ------
    ValueError
        If its SHA-256 is another.
    """
    content, line = whole[:-SEAL_LENGTH], bytes(whole[-SEAL_LENGTH:])
    if not line.startswith(_WORDS):
        return None
    if line != seal(content):
        raise ValueError("is damaged: its bytes are not those that were written (their SHA-256 differs)")
    return content


def read_sealed(path: Path, names: list[str]) -> tuple[Attributes, Columns]:
    """Return the attributes of a file that are text or one number, and those of the columns named that it has.

    Columns that the attribute `added` names are read as well.

    Raises
    ------
    RunFileError
        If it is no file, or damaged, or a column is no numbers, larger than the file can hold, or not in the file
        itself; the message does not name the file.
    OSError
        If the system refuses it.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a null byte in the name
        raise RunFileError("there is no such file") from None
    if not stat.S_ISREG(found.st_mode):
        raise RunFileError(f"is {kind_of(found.st_mode)}, not a run file")
    with path.open("rb") as file:
        file.seek(max(0, found.st_size - SEAL_LENGTH))
        source: str | BinaryIO = str(path)
        if file.read().startswith(_WORDS):
            file.seek(0)
            whole = file.read()
            try:
                unsealed(memoryview(whole))
            except ValueError as error:
                raise RunFileError(str(error)) from None
            source = io.BytesIO(whole)  # of bytes this is no copy
    try:
        return _read_hdf5(source, found.st_size, names)
    except Exception as error:  # whatever HDF5 and h5py may say of a damaged file
        raise RunFileError(f"is not a run file, or is damaged: {reason_of(error)}") from None


def _read_hdf5(source: str | BinaryIO, size: int, names: list[str]) -> tuple[Attributes, Columns]:
    """Return the attributes and the columns of a file of so many bytes."""
    import h5py

    attributes: Attributes = {}
    columns: Columns = {}
    with h5py.File(source, "r") as file:
        for name in file.attrs:
            try:
                value = _plain(file.attrs[name])
            except (OSError, TypeError, ValueError):
                continue  # of a type that is not ours
            if value is not None:
                attributes[name] = value
        for name in [*names, *_added(attributes)]:
            link = file.get(name, getlink=True)
            if link is not None and not isinstance(link, h5py.HardLink):
                raise ValueError(f"column '{name}' is a link to another place: a run file must contain its numbers")
            column = file.get(name)
            if not isinstance(column, h5py.Dataset):
                continue
            if column.external or column.is_virtual:
                raise ValueError(f"column '{name}' is in another file: a run file must contain its numbers")
            if column.dtype.kind not in "iuf" or column.shape is None:
                raise ValueError(f"column '{name}' is {column.dtype}, not numbers")
            if column.nbytes > BEST_COMPRESSION * size:
                raise ValueError(f"column '{name}' claims {column.nbytes} bytes, in a file of {size}")
            columns[name] = np.ascontiguousarray(column[()])
    return attributes, columns


def _added(attributes: Attributes) -> list[str]:
    """Return the names that the JSON table `added` has; none if it is no such table, which the reader's caller says."""
    try:
        return list(dict(json.loads(str(attributes.get("added", "{}")))))
    except (TypeError, ValueError, RecursionError):
        return []


def _plain(value: Any) -> str | int | float | None:
    """Return an attribute as text or number, None if it is anything else."""
    import h5py

    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind in "SO" else None
    if isinstance(value, np.ndarray) and value.size == 1:  # netCDF has arrays only
        value = value.reshape(-1)[0]
    if isinstance(value, np.number):
        value = value.item()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str | int | float) else None
