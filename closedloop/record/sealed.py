"""An HDF5 file with a seal: behind its last byte, where no reader looks, a line with the SHA-256 of all before it.

    closedloop SHA-256 of all bytes before this line: 0123... 4567...

A file whose seal is broken is damaged. But anyone can seal a file, and HDF5 that reads damaged bytes may loop for ever,
deaf to Ctrl-C, or end the process: it reads in this process what this user has written on this machine, and nothing
else. That is told by the second number, an HMAC with a key of this user (`seal_key`). Any other file, with a seal
or without (made before there was one, or changed by another program, which cuts it off), is read by a process of its
own, which can be ended.
"""

from __future__ import annotations

import hashlib
import hmac
import io
import json
import os
import secrets
import stat
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import RunFileError
from closedloop.base.files import kind_of, reason_of
from closedloop.jit.cache_folder import trusted_content, trusted_root

_WORDS = b"\nclosedloop SHA-256 of all bytes before this line: "
# With and without the HMAC, which lines of earlier versions lack.
SEAL_LENGTH, _UNSIGNED_LENGTH = len(_WORDS) + 64 + 1 + 64 + 1, len(_WORDS) + 64 + 1
# The time that reading may take, s, beside that for the bytes, of which so many are read in a second.
PATIENCE, BYTES_A_SECOND = 30.0, 5e6

Attributes = dict[str, str | int | float]
Columns = dict[str, NDArray[Any]]


def seal(content: bytes | memoryview) -> bytes:
    """Return the line that goes behind the content of a file that this process writes."""
    return _line(hashlib.sha256(content))


def seal_file(file: BinaryIO) -> None:
    """Write the line behind the content of an open file that this process has written."""
    total = hashlib.sha256()
    file.seek(0)
    while block := file.read(1 << 20):
        total.update(block)
    file.write(_line(total))


def _line(total: Any) -> bytes:
    signed = hmac.new(seal_key(), total.digest(), "sha256").hexdigest()
    return _WORDS + f"{total.hexdigest()} {signed}\n".encode()


def unsealed(whole: memoryview) -> tuple[memoryview, bool]:
    """Return what stands before the seal of a file's bytes, and whether this user has written it on this machine."""
    length = _seal_length(bytes(whole[-SEAL_LENGTH:]))
    content, line = whole[: len(whole) - length], bytes(whole[len(whole) - length :])
    total = hashlib.sha256(content)
    told = _WORDS + total.hexdigest().encode()
    if line[: len(told)] != told or line[len(told) : len(told) + 1] not in (b" ", b"\n"):
        raise ValueError("is damaged: its bytes are not those that were written (their SHA-256 differs)")
    return content, hmac.compare_digest(line, _line(total))


def _seal_length(end: bytes) -> int:
    """Return how long the seal is at the end of a file, 0 if there is none."""
    return next((length for length in (SEAL_LENGTH, _UNSIGNED_LENGTH) if end[-length:].startswith(_WORDS)), 0)


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
        if not _seal_length(file.read()):
            return _read_apart(path, size, names)
        file.seek(0)
        whole = file.read()
    try:
        ours = unsealed(memoryview(whole))[1]
    except ValueError as error:
        raise RunFileError(str(error)) from None
    if not ours:
        del whole
        return _read_apart(path, size, names)
    from closedloop.record.hdf5_reader import read_hdf5

    return read_hdf5(io.BytesIO(whole), len(whole), names)  # of bytes this is no copy


def _size_of_file(path: Path) -> int:
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a null byte in the name
        raise RunFileError("there is no such file") from None
    if not stat.S_ISREG(found.st_mode):
        raise RunFileError(f"is {kind_of(found.st_mode)}, not a run file")
    return found.st_size


def _read_apart(path: Path, size: int, names: list[str]) -> tuple[Attributes, Columns]:
    """Read a file of which this process does not know who wrote it in a process that can be ended, by Ctrl-C too."""
    from importlib.util import find_spec

    found = find_spec("closedloop.record.hdf5_reader")
    assert found is not None
    assert found.origin is not None
    limit = PATIENCE + size / BYTES_A_SECOND
    command = [sys.executable, "-P", found.origin, os.path.abspath(path), *names]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as reader:  # fmt: skip
        try:
            answer, _ = reader.communicate(timeout=limit)
        except BaseException as error:
            reader.kill()
            reader.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                raise RunFileError(f"is damaged: HDF5 did not finish reading it in {limit:.0f} s") from None
            raise
    if reader.returncode != 0:
        raise RunFileError("is not a run file, or is damaged: HDF5 failed while reading it")
    end = answer.index(b"\n") if b"\n" in answer else len(answer)
    said, rest = json.loads(answer[:end]), memoryview(answer)[end + 1 :]
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


NAME, LENGTH = "closedloop-seal-key", 32


@cache
def seal_key() -> bytes:
    """Return the key of this user, made if there is none: 32 random bytes in the cache folder, for this user to read.

    What is signed with it was written by a process of this user on this machine. Where it cannot be kept safely each
    process has its own, and knows what it has written.
    """
    with suppress(OSError):
        root = trusted_root()
        if root is not None:
            path = root / NAME
            if not path.exists():
                _make(path)
            if _is_private(path) and len(key := trusted_content(path) or b"") == LENGTH:
                return key
    return secrets.token_bytes(LENGTH)


def _make(path: Path) -> None:
    """Write a key, unless another process has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file, name = tempfile.mkstemp(dir=path.parent)  # for this user alone
    try:
        with os.fdopen(file, "wb") as key:
            key.write(secrets.token_bytes(LENGTH))
        with suppress(FileExistsError):
            os.link(name, path)
    finally:
        os.unlink(name)


def _is_private(path: Path) -> bool:
    """Whether nobody else can have read it; where files have no such modes (Windows) a user's profile is private."""
    found = path.lstat()
    others = stat.S_IRWXG | stat.S_IRWXO
    return stat.S_ISREG(found.st_mode) and not (hasattr(os, "geteuid") and found.st_mode & others)
