"""Atomic writes of files: written under another name in the same folder, and renamed.

An existing file is replaced only once the new one is flushed to the disk; a link is replaced by the file, not followed.
A temporary file left by a kill has a name that no other program makes, so that `remove_unfinished` may remove it.
"""

import errno
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from closedloop.base.errors import OutputError, printable

try:
    import fcntl
except ImportError:  # not on Windows, where a file in use cannot be removed anyway
    fcntl = None  # type: ignore[assignment]

_UNFINISHED = re.compile(r"\.closedloop-[0-9a-f]{32}\.unfinished")


def write_whole(
    path: str | Path, content: bytes | memoryview | Callable[[BinaryIO], object], *, reserve: int = 0,
    replace: bool = True,
) -> Path:  # fmt: skip
    """Write a file, and return its path; if that fails, the older file of that name is unchanged.

    `path`: where it goes. Its folder must be there.
    `content`: what goes into it; or a function that writes it into an open file, which can be read and sought in too.
        HDF5 does not survive a failed write (it ends the process): let it write into memory (`io.BytesIO`), or into a
        file of which enough is reserved.
    `reserve`: so many bytes of the disk are made sure of before anything is written, where the system can do that; what
        is not used stays as zeros at the end, unless the function truncates the file.
    `replace`: whether an older file of that name is replaced.
    Raises OutputError if it cannot be written: no such folder, no permission, a full disk, something there that is no
        file, or that is not to be replaced.
    """
    path = Path(path)
    unfinished = path.with_name(_unfinished_name())
    try:
        try:
            refuse_special(path)
            with _open_locked(unfinished) as file:
                if reserve > 0 and hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, reserve)
                if callable(content):
                    content(file)
                else:
                    file.write(content)
                file.flush()
                os.fsync(file.fileno())
                if fcntl is not None:
                    _give_name(unfinished, path, replace)
            if fcntl is None:  # Windows moves no open file
                _give_name(unfinished, path, replace)
        except BaseException:  # an interruption too must leave nothing behind
            with suppress(OSError, ValueError):
                unfinished.unlink(missing_ok=True)
            raise
    except OutputError:
        raise
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be written: {reason_of(error)}") from None
    return path


def _give_name(unfinished: Path, path: Path, replace: bool) -> None:
    if replace:
        unfinished.replace(path)
        return
    try:
        os.link(unfinished, path)  # unlike a renaming it fails if there is such a file
    except OSError as error:
        if os.path.lexists(path):
            raise OutputError(f"{path}: is there already and is not replaced; choose another name") from None
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK):
            raise
        unfinished.replace(path)  # a file system without hard links
    else:
        unfinished.unlink()


def remove_unfinished(folder: str | Path) -> list[Path]:
    """Remove what writers that were killed left in a folder, and return it.

    A file goes only if its name is one that `write_whole` gave, it is a regular file of this user, and no writer is at
    it any more.
    """
    gone: list[Path] = []
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if _UNFINISHED.fullmatch(entry.name)]
    except (OSError, ValueError):
        return gone
    for name in names:
        path = Path(folder) / name
        with suppress(OSError):
            if _is_abandoned(path):
                path.unlink()
                gone.append(path)
    return gone


def probe_folder(folder: Path) -> None:
    """Make a folder if need be, and a file in it that is gone again at once."""
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / _unfinished_name()
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except BaseException:  # in a `finally` an interruption before the call would leave the file
        probe.unlink(missing_ok=True)
        raise


class FolderLock:
    """The lock that one process has on a folder; without it nothing keeps others from the folder.

    It goes with the process. File systems without locks, and Windows, let everybody have it.
    """

    def __init__(self, file: int | None) -> None:
        self._file = file

    @classmethod
    def of(cls, folder: Path) -> "FolderLock | None":
        """Lock a folder; None if another process, or another lock of this one, has it.

        Raises FileNotFoundError if there is no such folder, or it was removed meanwhile.
        """
        if fcntl is None:
            return cls(None)
        try:
            file = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        except PermissionError:  # it can be written into, and not be listed
            return cls(None)
        try:
            with suppress(OSError):  # a file system without locks
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    os.close(file)
                    return None
            if not os.path.samestat(os.fstat(file), folder.stat()):
                raise FileNotFoundError(folder)
        except BaseException:
            os.close(file)
            raise
        return cls(file)

    def release(self) -> None:
        """Let others have it, whatever processes this one started meanwhile."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)
            os.close(file)


def refuse_special(path: Path) -> None:
    """Refuse to replace what is no regular file, and no link to one or to nothing."""
    for follow, link in ((False, ""), (True, "a link to ")):
        try:
            mode = path.stat(follow_symlinks=follow).st_mode
        except FileNotFoundError:
            return
        except OSError:
            if follow:
                return  # a link that leads in a circle, or to where one may not look
            raise
        if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
            raise OutputError(f"{path}: cannot be written: there is {link}{kind_of(mode)} of that name")


def kind_of(mode: int) -> str:
    """Return what a file is, in words, from its mode (`os.stat`)."""
    kinds = {
        stat.S_IFREG: "a file", stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFLNK: "a link",
    }  # fmt: skip
    return kinds.get(stat.S_IFMT(mode), "not a file")


def reason_of(error: BaseException) -> str:
    """Return why the operating system refused, in its own words where it has any."""
    number = getattr(error, "errno", None)
    if number:
        return os.strerror(number)
    return str(error).splitlines()[0].strip() if str(error).strip() else type(error).__name__


def _unfinished_name() -> str:
    return f".closedloop-{secrets.token_hex(16)}.unfinished"


def _open_locked(path: Path) -> BinaryIO:
    """Make a new file, and hold a lock on it as long as it is open."""
    while True:
        file = path.open("x+b")
        try:
            if fcntl is not None:
                with suppress(OSError):  # a file system without locks: what a kill leaves there stays there
                    fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not _same(file, path):  # taken for abandoned between the two
                    file.close()
                    continue
        except BaseException:
            file.close()
            raise
        return file


def _same(file: BinaryIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.lstat())
    except FileNotFoundError:
        return False


def _is_abandoned(path: Path) -> bool:
    found = path.lstat()
    if not stat.S_ISREG(found.st_mode) or (hasattr(os, "geteuid") and found.st_uid != os.geteuid()):
        return False
    if fcntl is None:
        return True
    with path.open("r+b") as file:
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return _same(file, path)


def why_not_there(places: Iterable[Path]) -> str:
    """Return why nothing can be made in the first of these places that is there, "" if something can."""
    try:
        there = next(place for place in places if place.exists())
    except (OSError, ValueError, StopIteration) as error:
        return reason_of(error)
    if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
        return ""
    return "Permission denied" if there.is_dir() else f"{there} is not a folder"


def made_folder(out: str | Path) -> Path:
    """Return the folder for the results, which is made."""
    folder = Path(out)
    try:
        probe_folder(folder)
    except (OSError, ValueError) as error:
        raise OutputError(f"--out {str(out)!r}: cannot be written: {reason_of(error)}; name another folder") from None
    return folder


def what_was_written(*paths: str | Path, folder: str | Path | None = None) -> str:
    """Return the line of a command that has written files, printable: a path may have any character in it.

    With a folder the names of the files stand after it.
    """
    names = ", ".join(str(path) if folder is None else Path(path).name for path in paths)
    return printable(f"wrote {names}" if folder is None else f"wrote {folder}{os.sep}: {names}")
