"""The key by which a user's own files are known, so that they need not be read by a process of their own.

32 random bytes in the user's cache folder, for this user alone to read. What is signed with it was written by a process
of this user on this machine. Where it cannot be kept safely each process has its own, and knows what it has written.
"""

from __future__ import annotations

import os
import secrets
import stat
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

from closedloop.jit.cache_folder import trusted_content, trusted_root

NAME, LENGTH = "closedloop-seal-key", 32


@cache
def seal_key() -> bytes:
    """Return the key of this user, made if there is none; that of this process where it cannot be kept."""
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
