"""The folder where compiled code is kept between processes: where it is, and how long it stays.

    ROOT/closedloop-0123456789abcdef/       a digest of the text of all kernel files, of compiler and processor
        closedloop-cache                    the marker: we made this folder; its time stamp is that of the last use
        step.run-<32 hex>.nbc               one compiled form of one function, see `closedloop.jit.compile_cache`

Folders of other versions of the source are kept for a month after their last use. Before one is removed, the folder's
name, the marker, the owner, and the name and the end of every file in it are checked; no link is followed, and a folder
with anything else in it is kept.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from closedloop.jit.uninterrupted import compiler_at_work

# What tells a file whose text the compiled code depends on, and files that say how it is compiled.
MARKS = (b"\n@kernel", b"\n@inlined_kernel", b"\n@entry_kernel", b"\n@brief_entry", b"@lower_builtin")
COMPILERS = ("kernel.py", "inline_once.py", "blocks.py", "parameters.py", "measures.py")

MARKER = "closedloop-cache"
MAGIC = b"closedloop code 1\n"  # the end of every file
FOLDER_NAME = re.compile(r"closedloop-[0-9a-f]{16}")
FILE_NAME = re.compile(r"[\w.]+-[0-9a-f]{32}\.nbc(\.tmp\.[0-9a-f]{16})?")
# Folders of other versions go when they have not been used for so long, s; of more than so many, after a shorter time.
UNUSED, MOST_KEPT, UNUSED_OF_MANY = 30 * 86400.0, 16, 86400.0


# Whether a folder that is not there may be made: a process in the background brings none back that was removed.
make_folders = True


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """Return where the compiled entry kernels of exactly this source are kept, whether or not it is there.

    And of this compiler and processor: what is in the folder can be used.
    """
    digest = hashlib.sha256(repr(compiler_and_processor()).encode())
    for path in sorted(Path(__file__).parent.parent.rglob("*.py")):
        with suppress(OSError):  # an editor's lock is a link that leads nowhere
            text = path.read_bytes()
            if path.name in COMPILERS or any(mark in text for mark in MARKS):
                digest.update(text)
    root = _cache_root()
    with suppress(OSError):  # of a current folder that was deleted
        root = root.absolute()
    return root / f"closedloop-{digest.hexdigest()[:16]}"


@lru_cache(maxsize=1)
def compiler_and_processor() -> tuple[Any, ...]:
    """Return what compiled code depends on beside its source: versions, and the processor, which may be one's wish."""
    with compiler_at_work():
        import llvmlite
        import llvmlite.binding as llvm
        import numba
        from numba.core import config

        numba_settings: Any = config  # its attributes are made at run time, which type checkers cannot see
        versions = (numba.__version__, llvmlite.__version__, sys.implementation.cache_tag, sys.flags.optimize)
        name = numba_settings.CPU_NAME or llvm.get_host_cpu_name()
        features = numba_settings.CPU_FEATURES
        if features is None:
            features = "" if numba_settings.CPU_NAME else llvm.get_host_cpu_features().flatten()
        triple = llvm.get_process_triple()
    return (*versions, triple, name, features, numba_settings.OPT, numba_settings.ENABLE_AVX)


def _cache_root() -> Path:
    """NUMBA_CACHE_DIR if set, the package's own __pycache__ if writable, else the user's cache folder."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    beside = Path(__file__).parent.parent / "__pycache__"
    with suppress(OSError):
        beside.mkdir(exist_ok=True)
    if os.access(beside, os.W_OK | os.X_OK):
        return beside
    users = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return Path(users) if os.path.isabs(users) else Path.home() / ".cache"
    except RuntimeError:  # this user has no home: nothing can be kept
        return Path(os.devnull)


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether some compiled form of an entry kernel is in the folder."""
    with suppress(OSError):
        return any(cache_folder().glob(f"*.{function.__name__}-*.nbc"))
    return False


def why_not_kept() -> str:
    """Return why compiled code cannot be kept; "" if it can."""
    try:
        claim(cache_folder())
        with tempfile.TemporaryFile(dir=cache_folder()):
            return ""
    except OSError as error:
        return f"{cache_folder()}: {error.strerror or error}"


def claim(folder: Path) -> None:
    """Make a cache folder that does not exist, with the marker, and update the time of its last use.

    A folder with something in it and no marker is not ours, and is not used.

    Raises
    ------
    OSError
        If it cannot be made.
    """
    if make_folders:
        folder.mkdir(parents=True, exist_ok=True)
    marker = folder / MARKER
    if is_ours(folder):
        with suppress(OSError):  # someone else's, and only to be read
            os.utime(marker, follow_symlinks=False)
    elif not any(folder.iterdir()):
        with suppress(FileExistsError):  # another process may be faster
            _write_marker(marker, _marker_of(folder))


def _write_marker(marker: Path, text: bytes) -> None:
    """Write the marker, or nothing: with half of one the folder would be nobody's for ever."""
    with marker.open("xb") as file:
        try:
            file.write(text)
            file.flush()
        except BaseException:
            marker.unlink()
            raise


def is_ours(folder: Path) -> bool:
    """Whether we made a cache folder: a real folder of this user with our name and our marker in it."""
    try:
        of_folder, of_marker = folder.lstat(), (folder / MARKER).lstat()
        if not (stat.S_ISDIR(of_folder.st_mode) and stat.S_ISREG(of_marker.st_mode)):
            return False
        if hasattr(os, "geteuid") and {of_folder.st_uid, of_marker.st_uid} != {os.geteuid()}:
            return False
        return bool(FOLDER_NAME.fullmatch(folder.name)) and (folder / MARKER).read_bytes() == _marker_of(folder)
    except OSError:
        return False


def _marker_of(folder: Path) -> bytes:
    text = f"Compiled code of closedloop, format 1, folder {folder.name}: made by the package, and removed by it.\n"
    return text.encode(errors="surrogateescape")


def forget_old_caches() -> None:
    """Remove the compiled code of versions of the source that are not in use any more; nothing else, see above."""
    mine = cache_folder()
    with suppress(OSError):
        others = [folder for folder in mine.parent.iterdir() if folder.name != mine.name and is_ours(folder)]
        ages = sorted((time.time() - (folder / MARKER).lstat().st_mtime, folder) for folder in others)
        for place, (age, folder) in enumerate(ages, start=2):  # this version's own is the first
            if age > UNUSED or (place > MOST_KEPT and age > UNUSED_OF_MANY):
                _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a folder that is ours, unless there is something in it that is not."""
    with suppress(OSError):
        inside = [entry for entry in os.scandir(folder) if entry.name != MARKER]
        if not all(_is_code(entry) for entry in inside):
            return
        for entry in inside:
            os.unlink(entry.path)
        os.unlink(folder / MARKER)
        os.rmdir(folder)


def _is_code(entry: os.DirEntry[str]) -> bool:
    """Whether a file was written by `KernelCache`, whole or (until it was killed) in part."""
    found = FILE_NAME.fullmatch(entry.name)
    if not (found and entry.is_file(follow_symlinks=False)):
        return False
    with open(entry.path, "rb") as file:
        content = file.read()
    return content.endswith(MAGIC) or found[1] is not None
