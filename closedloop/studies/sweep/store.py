"""A part of a sweep: its runs, its file, and all parts on disk.

Beside ``sweep.parquet`` lies the folder ``sweep.parquet.parts`` with

    sweep.json           what the sweep is: nothing else may put parts here
    part-00000012.arrow  the rows of a part; written last: if it exists, the part is complete
    part-00000012.npz    its whole columns, if any are kept

A file is written under another name, flushed to the disk and then renamed, which is atomic (`closedloop.base.files`).
Parts end in their name and a SHA-256 (`closedloop.record.save`): one that is damaged, or another's, is run
again. A lock on the folder, released when its process ends, keeps a second sweep out. Other files are kept.
"""

from __future__ import annotations

import io
import json
import re
import stat
import threading
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import OutputError, ScenarioError
from closedloop.base.files import FolderLock, remove_unfinished, why_not_there, write_whole
from closedloop.record.frame import difference
from closedloop.record.save import seal, unsealed
from closedloop.scenario.load import Variants, parse_scenario
from closedloop.scenario.scenario import families
from closedloop.scenario.user_module import import_law
from closedloop.simulation.batch.simulate_batch import in_blocks, run_variants, schema, table_of
from closedloop.simulation.batch.worker import Outcome, Worker
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.law_source import law_digest
from closedloop.studies.identity import NAMES

if TYPE_CHECKING:
    import pyarrow as pa


def write_part(path: Path, content: memoryview) -> None:
    """Write a part's file whole, or not at all."""
    named = b"".join((content, path.name.encode()))
    write_whole(path, b"".join((named, seal(named))))


def read_part(path: Path) -> memoryview:
    """Return the content of a part's file.

    Raises OSError or ValueError if there is none, it is damaged, or it was written under another name.
    """
    named, name = unsealed(memoryview(path.read_bytes())), path.name.encode()
    if named is None or named[-len(name) :] != name:
        raise ValueError("is damaged, or another file")
    return named[: -len(name)]


@dataclass(frozen=True)
class Job:
    """What the runs of a sweep have in common, as plain text, so that it can be sent to another machine."""

    scenario: str  # TOML of the scenario
    keys: tuple[str, ...]  # the keys that change
    kinds: tuple[str, ...]  # types of their columns in the table, in Arrow's words
    engine: str  # see `closedloop.simulate`
    keep: tuple[str, ...]  # columns to keep whole
    runs: int  # how many runs the sweep has
    # keys of the scenario that pick a user's class, with its name: the command line named it
    members: tuple[tuple[str, str], ...] = ()
    # law, law_digest: MODULE:FUNCTION of the user's law, and the SHA-256 of its text; "" for the scenario's own
    law: str = ""
    law_digest: str = ""


_importing = threading.Lock()


@lru_cache(maxsize=4)
def law_of(name: str, digest: str) -> Any:
    """Return the law of a sweep, imported here; None for the scenario's own."""
    if not name:
        return None
    with _importing:  # what a module prints as it is imported is turned to standard error, of the whole process
        law = import_law(name)
    if law_digest(law) != digest:
        raise ScenarioError(f"--law {name}: its text here is not the one that the sweep was begun with")
    return law


@lru_cache(maxsize=4)
def _variants(job: Job) -> Variants:
    for key, name in job.members:
        families()[key].named(name, key)
    return Variants(parse_scenario(job.scenario), job.keys)


def columns_of(job: Job) -> pa.Schema:
    """Return the columns of the table."""
    import pyarrow as pa

    types = {key: pa.type_for_alias(kind) for key, kind in zip(job.keys, job.kinds, strict=True)}
    return schema(types, of=_variants(job).base)


def run_part(
    job: Job, first: int, points: Sequence[Sequence[Any]], worker: Worker, ran: Callable[[], None] = lambda: None
) -> tuple[pa.Table, dict[str, Array]]:
    """Run the runs from number `first` on, with these values of the keys.

    Returns a table with a row for each run, and the columns kept, (runs, rows) or (runs, rows, k); after a run's last
    row they are NaN.
    """
    came_to: dict[int, Outcome] = {}
    for block in in_blocks(_variants(job), points, job.engine, job.runs, lanes=not job.law):
        some = run_variants(worker, _variants(job), [points[i] for i in block], job.engine, ran)
        came_to |= dict(zip(block, some, strict=True))
    outcomes = [came_to[i] for i in range(len(points))]
    return table_of(columns_of(job), first, points, outcomes), {name: _stacked(outcomes, name) for name in job.keep}


def _stacked(outcomes: Sequence[Outcome], name: str) -> Array:
    parts = [outcome.columns.get(name) for outcome in outcomes]
    rows = max((len(part) for part in parts if part is not None), default=0)
    wide = next((part.shape[1:] for part in parts if part is not None), ())
    whole = np.full((len(parts), rows, *wide), np.nan)
    for place, part in zip(whole, parts, strict=True):
        if part is not None:
            place[: len(part)] = part
    return whole


def worker_for(job: Job, shared: Cache | None = None) -> Worker:
    """Return a worker for a thread; `shared` is the cache that it shares with others."""
    return Worker(job.engine, job.keep, runs=job.runs, shared=shared, law=law_of(job.law, job.law_digest))


_here = threading.local()


def run_part_anywhere(job: Job, first: int, points: Sequence[Sequence[Any]]) -> tuple[pa.Table, dict[str, Array]]:
    """Do `run_part` with a `Worker` that this thread keeps from part to part: the task sent to a cluster."""
    if getattr(_here, "job", None) != job:
        _here.job, _here.worker = job, worker_for(job)
    return run_part(job, first, points, _here.worker)


FORMAT = "closedloop sweep 2"
DESCRIPTION = "sweep.json"
# What is written here, and so may be removed again; earlier versions had a file that they locked.
_PART = re.compile(r"part-\d{8,}\.(arrow|npz)|lock")
# What a sweep depends on, in words.
_NAMES = NAMES | {
    "design": "design",
    "axes": "list of keys and values",
    "runs": "number of runs",
    "seed": "seed",
    "keep": "list of columns kept",
    "law": "law",
    "law_digest": "text of the law",
}


class OccupiedError(OutputError):
    """A file of that name is there that is another sweep's, or nobody's; --overwrite replaces it."""


def occupied(out: Path, why: str) -> OccupiedError:
    """Return the error of a file that is there and is not replaced."""
    return OccupiedError(f"--out {out}: {why}; name another file with --out, or replace it with --overwrite")


class Store:
    """The folder of a sweep's parts; used as a context, which holds the lock.

    `identity`: what the sweep is, see `closedloop.studies.sweep.sweep.Sweep.identity`.
    `out`: the table that the parts will become.
    `overwrite`: whether the parts of another sweep are removed.
    Raises OutputError if the folder cannot be written, is another sweep's, or is being written by another process.
    """

    def __init__(self, identity: dict[str, Any], out: Path, overwrite: bool = False) -> None:
        self.identity, self.out, self.overwrite = identity, out, overwrite
        self.folder = out.with_name(f"{out.name}.parts")
        self._lock: FolderLock | None = None

    def __enter__(self) -> Store:
        try:
            self._open()
        except BaseException as error:
            if self._lock is not None and not (self.folder / DESCRIPTION).exists():
                self.remove()  # there was no sweep, and none has begun
            self._close()
            if isinstance(error, OSError) and not isinstance(error, OutputError):
                raise unwritable(self.out, error) from None
            raise
        return self

    def _open(self) -> None:
        description = self.folder / DESCRIPTION
        while self._lock is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # removed in between by another process
                if self._names() and not description.is_file():
                    raise OutputError(f"--out {self.out}: {self.folder} is there and holds no sweep; name another file")
                self._lock = FolderLock.of(self.folder)
                if self._lock is None:
                    raise OutputError(
                        f"--out {self.out}: another process is at work on this sweep; wait for it, or end it"
                    )
        remove_unfinished(self.folder)  # of those that were killed
        if self.overwrite and description.is_file():
            try:
                check_identity(_described(description), self.identity, self.out)
            except OccupiedError:
                self._remove_parts()
        if not description.exists():
            text = json.dumps({"format": FORMAT, "identity": self.identity}, indent=1)
            write_whole(description, text.encode())
        check_identity(_described(description), self.identity, self.out)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and self._lock is not None and not any(self.folder.glob("part-*.arrow")):
            self.remove()  # nothing is done that could be gone on with
        self._close()

    def _names(self) -> set[str]:
        """Return the names of what is in the folder, but for what is about to get another."""
        return {path.name for path in self.folder.iterdir() if not path.name.endswith(".unfinished")}

    def _close(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def rows_of(self, part: int) -> Path:
        """Return where the rows of a part are."""
        return self.folder / f"part-{part:08}.arrow"

    def columns_of(self, part: int) -> Path:
        """Return where the whole columns of a part are."""
        return self.folder / f"part-{part:08}.npz"

    def has(self, part: int, runs: range) -> bool:
        """Return whether a part is there as it was written, with these runs."""
        import pyarrow as pa

        if not self.rows_of(part).is_file():
            return False
        keep = self.identity["keep"]
        try:
            if self.read(part)["run"].to_pylist() != list(runs):
                return False
            return not keep or (self.columns_of(part).is_file() and self.read_columns(part).keys() == set(keep))
        except (
            OSError,
            ValueError,
            EOFError,
            KeyError,
            zipfile.BadZipFile,
            pa.ArrowException,
        ):  # a disk lost its power
            return False

    def read(self, part: int) -> pa.Table:
        """Return the rows of a part."""
        import pyarrow as pa

        return pa.ipc.open_file(pa.BufferReader(read_part(self.rows_of(part)))).read_all()

    def read_columns(self, part: int) -> dict[str, Array]:
        """Return the whole columns of a part."""
        with np.load(io.BytesIO(read_part(self.columns_of(part))), allow_pickle=False) as columns:
            return {name: columns[name] for name in columns.files}

    def write(self, part: int, rows: pa.Table, columns: dict[str, Array]) -> None:
        """Write a part, serialised in memory first, so that no library has to handle a full disk."""
        import pyarrow as pa

        table, whole_columns = pa.BufferOutputStream(), io.BytesIO()
        with pa.ipc.new_file(table, rows.schema) as writer:
            writer.write_table(rows)
        try:
            if columns:
                np.savez(whole_columns, **columns)  # type: ignore[arg-type]
                with whole_columns.getbuffer() as content:  # else an error's traceback holds the memory open
                    write_part(self.columns_of(part), content)
            write_part(self.rows_of(part), memoryview(table.getvalue()))
        except OSError as error:
            raise OutputError(f"{error}; what was done is kept: once there is room, the same command goes on") from None

    def remove(self) -> None:
        """Remove what was written here, and the folder, unless something else is in it; the lock goes last."""
        self._remove_parts()
        with suppress(OSError):  # not empty
            self.folder.rmdir()
        self._close()

    def _remove_parts(self) -> None:
        """Remove the parts, and then what says which sweep they are of."""
        mine = [path for path in self.folder.iterdir() if _PART.fullmatch(path.name)]
        for path in [*mine, self.folder / DESCRIPTION]:
            with suppress(OSError):
                if stat.S_ISREG(path.lstat().st_mode):
                    path.unlink()


def _described(description: Path) -> Any:
    """Return what a file says that its folder's parts are of, None if it cannot be read as that."""
    try:
        return json.loads(description.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        return None


def tidy(identity: dict[str, Any], out: Path) -> None:
    """Remove the parts of a sweep whose table is there: it was killed after the last rename."""
    with suppress(OutputError):
        store = Store(identity, out)
        if store.folder.is_dir():
            with store:
                store.remove()


def unwritable(out: Path, error: OSError) -> OutputError:
    """Return the refusal of a place that cannot be written."""
    return OutputError(f"--out {out}: cannot be written: {error.strerror or error}; name another file")


def why_no_place(out: Path) -> str:
    """Return why a table cannot be written there, whatever it holds, "" if it can; makes nothing."""
    if out.suffix != ".parquet":
        return f"--out {out}: must end in .parquet"
    why = why_not_there(out.absolute().parents)
    return why and f"--out {out}: cannot be written: {why}; name another file"


def check_identity(found: Any, identity: dict[str, Any], out: Path) -> None:
    """Refuse a file or folder that belongs to another sweep."""
    if not isinstance(found, dict) or found.get("format") != FORMAT or not isinstance(found.get("identity"), dict):
        raise occupied(out, "exists and is not a sweep")
    theirs, mine = found["identity"], json.loads(json.dumps(identity))
    different = [key for key in mine | theirs if theirs.get(key) != mine.get(key)]
    if different:
        raise occupied(out, f"holds another sweep: {difference(different, _NAMES, theirs, mine)}")
