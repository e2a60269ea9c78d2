"""The folder where compiled code is kept between processes: where it is, and how long it stays.

    ROOT/closedloop-0123456789abcdef/       a digest of the text of all kernel files, of compiler and processor
        closedloop-cache                    the marker: we made this folder; its time stamp is that of the last use
        step.run-<32 hex>.nbc               one compiled form of one function, see `closedloop.jit.inside.compile_cache`

Folders of other versions of the source are kept for a month after their last use. Before one is removed, the folder's
name, the marker, the owner, and the name and the end of every file in it are checked; no link is followed, and a folder
with anything else in it is kept.
"""

import hashlib
import logging
import os
import re
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from closedloop.base.interrupts import compiler_at_work

# What tells a file whose text the compiled code depends on, and files that say how it is compiled.
MARKS = (
    b"\n@kernel",
    b"\n@inlined_kernel",
    b"\n@entry_kernel",
    b"\n@brief_entry",
    b"\n@long_loops_entry",
    b"@lower_builtin",
)
COMPILERS = "kernel.py", "parameters.py", "dual.py", "blocks.py", "dual8.py", "inside"  # files and a folder

MARKER = "closedloop-cache"
MAGIC = b"closedloop code 1\n"  # the end of every file
FOLDER_NAME = re.compile(r"closedloop-[0-9a-f]{16}")
CODE = ".nbc"
# Drafts were written by an earlier version.
FILE_NAME = re.compile(rf"[\w.]+-[0-9a-f]{{32}}(?:{CODE}|\.draft)(\.tmp\.[0-9a-f]{{16}})?")
# Folders of other versions go when they have not been used for so long, s; of more than so many, after a shorter time.
UNUSED, MOST_KEPT, UNUSED_OF_MANY = 30 * 86400.0, 16, 86400.0


notices = logging.getLogger("closedloop.compiling")

# Whether a folder that is not there may be made: a process in the background brings none back that was removed.
make_folders = True


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """Return where the compiled entry kernels of exactly this source are kept, whether or not it is there.

    And of this compiler and processor: what is in the folder can be used. Where other users could have put code there
    a line says so, and the next folder is taken; the last one can never be made.
    """
    with compiler_at_work():
        from closedloop.jit.inside.machine import compiler_and_processor

    digest = hashlib.sha256(repr(compiler_and_processor()).encode())
    for text in source_texts(Path(__file__).parent.parent):
        digest.update(hashlib.sha256(text).digest())
    name = f"closedloop-{digest.hexdigest()[:16]}"
    for root in _cache_roots():
        with suppress(OSError):  # of a current folder that was deleted
            root = root.absolute()
        if why := why_not_trusted(root / name):
            notices.warning(f"compiled code in {root} is not used: {why}")
        else:
            return root / name
    return Path(os.devnull) / name


_IMPORTED = re.compile(rb"^from ((?:closedloop|robot_models)[\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)
_NAME_OF_VALUE = re.compile(rb"\b[A-Z]\w*")


def source_texts(package: Path) -> list[bytes]:
    """Return the texts of all files that compiled code depends on, in the order of their names.

    Those with kernels, those that say how to compile, and those that either has constants or types from, and so on.
    """
    texts: dict[Path, bytes] = {}
    for path in sorted(package.rglob("*.py")):
        with suppress(OSError):  # an editor's lock is a link that leads nowhere
            texts[path] = path.read_bytes()
    found = {
        path
        for path, text in texts.items()
        if {path.name, path.parent.name} & {*COMPILERS} or any(mark in text for mark in MARKS)
    }
    new = set(found)
    while new:
        named = {
            package.parent.joinpath(*module.decode().split("."))
            for path in new
            for module, names in _IMPORTED.findall(texts[path])
            if _NAME_OF_VALUE.search(names)
        }
        new = {file for at in named for file in (at.with_suffix(".py"), at / "__init__.py") if file in texts} - found
        found |= new
    return [texts[path] for path in sorted(found)]


def _cache_roots() -> Iterator[Path]:
    """Yield NUMBA_CACHE_DIR if set, the user's cache folder, and the package's own __pycache__, where they can be used.

    The user's is the same for each copy of the package.
    """
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(chosen)
    users = os.environ.get("XDG_CACHE_HOME", "")
    own = [Path(__file__).parent.parent / "__pycache__"]
    with suppress(RuntimeError):  # this user has no home
        own.insert(0, Path(users) if os.path.isabs(users) else Path.home() / ".cache")
    for root in own:
        there = next((place for place in (root, *root.parents) if place.exists()), Path(os.devnull))
        if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
            yield root


def why_not_trusted(folder: Path) -> str:
    """Return why another user could have put code into a folder; "" if only this one and root could.

    As ssh asks of its files: the folder and all above it must be this user's or root's, and not writable by others,
    unless they are such that nobody can replace what is another's there, as /tmp. Where there are no such owners
    (Windows) a user's profile is private by itself.
    """
    if not hasattr(os, "geteuid"):
        return ""
    try:
        real = Path(os.path.realpath(folder))
    except OSError:  # of a current folder that was deleted: nothing can be kept there
        return ""
    for place in (real, *real.parents):
        try:
            found = place.lstat()
        except OSError:
            continue  # it is not there yet
        if not stat.S_ISDIR(found.st_mode):
            continue
        protected = place != real and found.st_mode & stat.S_ISVTX
        if why := _another_may_write(found, bool(protected)):
            return f"{place} {why}"
    return ""


def _another_may_write(found: os.stat_result, protected: bool = False) -> str:
    if found.st_uid not in (0, os.geteuid()):
        return "belongs to another user"
    by_group = found.st_mode & stat.S_IWGRP and not _is_users_own_group(found.st_gid)
    if not protected and (by_group or found.st_mode & stat.S_IWOTH):
        return "can be written by other users (chmod go-w)"
    return ""


@cache
def _is_users_own_group(number: int) -> bool:
    """Whether nobody else is in a group: many systems make one for each user, of the same name."""
    import grp
    import pwd

    try:
        me, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(number)
    except KeyError:
        return False
    return number == me.pw_gid and group.gr_name == me.pw_name and set(group.gr_mem) <= {me.pw_name}


def trusted_content(file: Path) -> bytes | None:
    """Return what is in a file of code; None if it is none, or another user could have written it."""
    try:
        # A pipe is not waited for, and no link is followed.
        opened = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0) | _BINARY)
    except OSError:
        return None
    with os.fdopen(opened, "rb") as code:
        found = os.fstat(opened)
        if not stat.S_ISREG(found.st_mode):
            return None
        if hasattr(os, "geteuid") and (why := _another_may_write(found)):
            notices.warning(f"compiled code in {file} is not used: it {why}")
            return None
        return code.read()


_BINARY = getattr(os, "O_BINARY", 0)


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether some compiled form of an entry kernel is in the folder."""
    folder = cache_folder()
    what = folder, function.__name__
    if what not in _kept:  # it is asked before each run
        with suppress(OSError):
            if any(folder.glob(f"*.{function.__name__}-*{CODE}")):
                _kept.add(what)
    return what in _kept


_kept: set[tuple[Path, str]] = set()


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
    """
    if make_folders:
        for place in reversed([place for place in (folder, *folder.parents) if not place.exists()]):
            place.mkdir(mode=0o755, exist_ok=True)
        folder.mkdir(exist_ok=True)  # says what is in the way
    marker = folder / MARKER
    if is_ours(folder):
        with suppress(OSError):  # someone else's, and only to be read
            os.utime(marker, follow_symlinks=False)
    elif not any(folder.iterdir()):
        with suppress(FileExistsError), marker.open("xb") as file:  # another process may be faster
            try:
                file.write(_marker_of(folder))
                file.flush()
            except BaseException:  # with half of a marker the folder would be nobody's for ever
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
