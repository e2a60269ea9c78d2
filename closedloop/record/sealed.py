"""An HDF5 file with a seal: behind its last byte, where no reader looks, a line with the SHA-256 of all before it.

    closedloop SHA-256 of all bytes before this line: 0123...

A file whose seal holds is as it was written, and HDF5 may read it in this process. One whose seal is broken is damaged.
One without (made before there was a seal, or changed by another program, which cuts it off) is read by a process of its
own, because HDF5 that reads damaged bytes may loop for ever or end the process.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import RunFileError
from closedloop.files import kind_of, reason_of

_WORDS = b"\nclosedloop SHA-256 of all bytes before this line: "
SEAL_LENGTH = len(_WORDS) + 64 + 1
# The time that reading may take, s, beside that for the bytes, of which so many are read in a second.
PATIENCE, BYTES_A_SECOND = 30.0, 5e6

Attributes = dict[str, str | int | float]
Columns = dict[str, NDArray[Any]]


def seal(content: bytes | memoryview) -> bytes:
    """Return the line that goes behind the content of a file."""
    return _WORDS + hashlib.sha256(content).hexdigest().encode() + b"\n"


def unsealed(whole: memoryview) -> memoryview:
    """Return what stands before the seal of a file's bytes.

    Raises
    ------
    ValueError
        If there is no seal, or it is broken.
    """
    content, line = whole[:-SEAL_LENGTH], whole[-SEAL_LENGTH:]
    if line != seal(content):
        raise ValueError("is damaged: its bytes are not those that were written (their SHA-256 is another)")
    return content


def read_sealed(path: Path, names: list[str]) -> tuple[Attributes, Columns]:
    """Return the attributes of a file, and those of the columns named that it has.

    Raises
    ------
    RunFileError
        If it is no file, or its seal is broken, or it cannot be read; the message does not name the file.
    OSError
        If the system refuses it.
    """
    size = _size_of_file(path)
    with path.open("rb") as file:
        file.seek(max(0, size - SEAL_LENGTH))
        if not file.read().startswith(_WORDS):
            return _read_apart(path, size, names)
        file.seek(0)
        whole = memoryview(file.read())
    try:
        content = unsealed(whole)
    except ValueError as error:
        raise RunFileError(str(error)) from None
    from closedloop.record.hdf5_reader import read_hdf5

    return read_hdf5(io.BytesIO(content), len(content), names)


def _size_of_file(path: Path) -> int:
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a null byte in the name
        raise RunFileError("there is no such file") from None
    if not stat.S_ISREG(found.st_mode):
        raise RunFileError(f"is {kind_of(found.st_mode)}, not a run file")
    return found.st_size


def _read_apart(path: Path, size: int, names: list[str]) -> tuple[Attributes, Columns]:
    """Read a file that nothing vouches for in a process that can be ended."""
    from importlib.util import find_spec

    found = find_spec("closedloop.record.hdf5_reader")
    assert found is not None
    assert found.origin is not None
    limit = PATIENCE + size / BYTES_A_SECOND
    try:
        done = subprocess.run(
            [sys.executable, "-P", found.origin, os.path.abspath(path), *names],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=limit, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise RunFileError(f"is damaged: HDF5 did not come to an end of it in {limit:.0f} s") from None
    if done.returncode != 0:
        raise RunFileError("is not a run file, or is damaged: HDF5 broke down over it")
    head, _, rest = done.stdout.partition(b"\n")
    said = json.loads(head)
    if "error" in said:
        raise RunFileError(f"is not a run file, or is damaged: {reason_of(ValueError(said['error']))}")
    columns: Columns = {}
    at = 0
    for name, kind, shape in said["columns"]:
        dtype = np.dtype(kind)
        length = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        columns[name] = np.frombuffer(rest[at : at + length], dtype).reshape(shape).copy()
        at += length
    return said["attributes"], columns
