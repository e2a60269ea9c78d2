"""Attributes and columns of an HDF5 file as plain values; also a program of its own.

HDF5 trusts what it reads: a damaged file can make it loop for ever, or end the process. So `closedloop.record.sealed`
lets a process of its own read a file that nothing vouches for: ``python hdf5_reader.py FILE NAME ...`` writes a line of
JSON and the bytes of the columns to standard output. That process must start quickly: nothing of this package is
imported.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any, BinaryIO

import h5py
import numpy as np

# A column that says it is larger than its file, compressed at best, is not read.
BEST_COMPRESSION = 1100


def read_hdf5(
    source: str | BinaryIO, size: int, names: list[str]
) -> tuple[dict[str, str | int | float], dict[str, np.ndarray[Any, Any]]]:
    """Return the attributes of a file that are text or one number, and those of the columns named that are numbers.

    Parameters
    ----------
    source : path or binary file
        The file.
    size : int
        Its length in bytes.
    names : list of str
        Columns; those that the attribute `added` names are read as well.

    Raises
    ------
    ValueError
        If a column is not numbers, larger than the file can hold, or not in the file itself.
    """
    attributes: dict[str, str | int | float] = {}
    columns: dict[str, np.ndarray[Any, Any]] = {}
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


def _added(attributes: dict[str, str | int | float]) -> list[str]:
    """Return the names that the JSON table `added` has; none if it is no such table, which the reader's caller says."""
    try:
        return list(dict(json.loads(str(attributes.get("added", "{}")))))
    except (TypeError, ValueError):
        return []


def _plain(value: Any) -> str | int | float | None:
    """Return an attribute as text or number, None if it is anything else."""
    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind in "SO" else None
    if isinstance(value, np.ndarray) and value.size == 1:  # netCDF has arrays only
        value = value.reshape(-1)[0]
    if isinstance(value, np.number):
        value = value.item()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str | int | float) else None


def main() -> None:
    """Read the file named first on the command line, and write what it holds."""
    path, names = sys.argv[1], sys.argv[2:]
    out = sys.stdout.buffer
    try:
        attributes, columns = read_hdf5(path, os.path.getsize(path), names)
    except Exception as error:  # whatever HDF5 and h5py may say of a damaged file
        out.write(json.dumps({"error": f"{type(error).__name__}: {error}"}).encode())
        return
    described = [(name, column.dtype.str, column.shape) for name, column in columns.items()]
    out.write(json.dumps({"attributes": attributes, "columns": described}).encode() + b"\n")
    for column in columns.values():
        out.write(column.data.cast("B") if column.size else b"")


if __name__ == "__main__":
    main()
