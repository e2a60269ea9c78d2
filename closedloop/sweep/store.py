"""The parts of a sweep on disk: each is there whole, or not at all, whatever is killed when.

Beside ``sweep.parquet`` lies the folder ``sweep.parquet.parts`` with

    sweep.json           what the sweep is: nothing else may put parts here
    part-00000012.arrow  the rows of a part; written last, so that where it is the part is done
    part-00000012.npz    its whole columns, if any are kept

A file is written under another name, flushed to the disk and then renamed, which the operating system does at once or
not at all. A lock on the file ``lock``, which dies with its process, keeps a second sweep out.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import OutputError

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]

FORMAT = "closedloop sweep 2"
UNFINISHED = ".unfinished"


class Store:
    """The folder of a sweep's parts; used as a context, which holds the lock.

    Parameters
    ----------
    identity : dict
        What the sweep is, see `closedloop.sweep.run.Sweep.identity`.
    out : Path
        The table that the parts will become.

    Raises
    ------
    OutputError
        If the folder cannot be written, is another sweep's, or is being written by another process.
    """

    def __init__(self, identity: dict[str, Any], out: Path) -> None:
        self.identity, self.out = identity, out
        self.folder = out.with_name(f"{out.name}.parts")
        self._lock: IO[str] | None = None

    def __enter__(self) -> Store:
        description, lock = self.folder / "sweep.json", self.folder / "lock"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            names = {path.name for path in self.folder.iterdir() if not path.name.endswith(UNFINISHED)}
            if names - {"lock"} and description.name not in names:
                raise OutputError(f"--out {self.out}: {self.folder} is there and holds no sweep; name another file")
            self._lock = lock.open("a", encoding="utf-8")
            _lock(self._lock, self.out)
            for unfinished in self.folder.glob(f".*{UNFINISHED}"):  # of those that were killed: the lock is ours
                unfinished.unlink()
            if not description.exists():
                text = json.dumps({"format": FORMAT, "identity": self.identity}, indent=1)
                whole(description, lambda path: path.write_text(text, encoding="utf-8"))
            try:
                found = json.loads(description.read_text(encoding="utf-8"))
            except ValueError:
                found = None
            check_identity(found, self.identity, self.out)
        except OSError as error:
            self._close()
            if isinstance(error, OutputError):
                raise
            raise unwritable(self.out, error) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def rows_of(self, part: int) -> Path:
        """Return where the rows of a part are."""
        return self.folder / f"part-{part:08}.arrow"

    def columns_of(self, part: int) -> Path:
        """Return where the whole columns of a part are."""
        return self.folder / f"part-{part:08}.npz"

    def has(self, part: int, runs: int) -> bool:
        """Return whether a part is there, with this many runs."""
        path = self.rows_of(part)
        if not path.exists():
            return False
        try:
            complete = bool(self.read(part).num_rows == runs)
            if complete and self.identity["keep"]:
                with np.load(self.columns_of(part), allow_pickle=False) as columns:
                    complete = set(columns.files) == set(self.identity["keep"])
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):  # of a disk that lost its power
            complete = False
        return complete

    def read(self, part: int) -> pa.Table:
        """Return the rows of a part."""
        import pyarrow as pa

        with pa.OSFile(str(self.rows_of(part)), "rb") as file:
            return pa.ipc.open_file(file).read_all()

    def write(self, part: int, rows: pa.Table, columns: dict[str, Array]) -> None:
        """Write a part."""
        import pyarrow as pa

        def write_rows(path: Path) -> None:
            with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, rows.schema) as writer:
                writer.write_table(rows)

        def write_columns(path: Path) -> None:
            with path.open("wb") as file:
                np.savez(file, **columns)  # type: ignore[arg-type]

        try:
            if columns:
                whole(self.columns_of(part), write_columns)
            whole(self.rows_of(part), write_rows)
        except OSError as error:
            raise OutputError(
                f"{self.folder}: cannot be written: {error.strerror or error}; what was done is kept"
            ) from None

    def remove(self) -> None:
        """Remove the folder, once the table is there."""
        self._close()
        shutil.rmtree(self.folder, ignore_errors=True)


def unwritable(out: Path, error: OSError) -> OutputError:
    """Return the refusal of a place that cannot be written."""
    return OutputError(f"--out {out}: cannot be written: {error.strerror or error}; name another file")


def whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file such that it is there whole or not at all."""
    unfinished = path.with_name(f".{path.name}{UNFINISHED}")
    try:
        write(unfinished)
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise


def check_identity(found: Any, identity: dict[str, Any], out: Path) -> None:
    """Refuse a file or folder that belongs to another sweep.

    Raises
    ------
    OutputError
        With what is different.
    """
    if not isinstance(found, dict) or found.get("format") != FORMAT or not isinstance(found.get("identity"), dict):
        raise OutputError(f"--out {out}: is there and is no sweep; nothing was overwritten; name another file")
    theirs, mine = found["identity"], json.loads(json.dumps(identity))
    different = [key for key in mine if theirs.get(key) != mine[key]]
    if different:
        raise OutputError(
            f"--out {out}: belongs to another sweep: not the same {', '.join(different)}; nothing was overwritten; "
            "name another file, or remove it"
        )


def _lock(file: IO[str], out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not a Unix
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise OutputError(f"--out {out}: another process is at work on this sweep; wait for it, or end it") from None
