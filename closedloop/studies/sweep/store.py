"""The parts of a sweep on disk, and the table that is joined from them.

Beside ``sweep.parquet`` lies the folder ``sweep.parquet.parts`` with

    sweep.json           what the sweep is: nothing else may put parts here
    part-00000012.arrow  the rows of a part, with whole columns as lists, if any are kept

A file is written under another name, flushed to the disk and then renamed, which is atomic (`closedloop.base.files`).
Parts end in their name and a SHA-256 (`closedloop.record.save`): one that is damaged, or another's, is run again. A
lock on the folder, released when its process ends, keeps a second sweep out. Other files are kept.

The table is a Parquet file: typed columns, compressed, widely readable, also by row groups. Each page of values has
Parquet's own checksum. What stands outside of the pages, names and units, has none: a digest in the file's metadata
would be kept by a program that leaves rows out, and refuse what is as it should be. But a column's name is there more
than once.

Whole columns go into a NetCDF-4 file, as those of a single run do, so that MATLAB, xarray and h5py open both. Zarr
could be written in place, part by part, but is a folder of thousands of files that needs one more package to be read.
HDF5, which a kill during a write would corrupt, is written here only, from the parts, under another name until it is
complete.
"""

from __future__ import annotations

import json
import re
import stat
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import OutputError, ScenarioError
from closedloop.base.files import FolderLock, remove_unfinished, why_not_there, write_whole
from closedloop.record.columns.record import ALL_COLUMNS
from closedloop.record.save import OF_VARIABLE, difference, seal, unsealed, write_reserved
from closedloop.scenario.load import Variants, parse_scenario
from closedloop.scenario.scenario import families
from closedloop.scenario.user_module import import_law
from closedloop.simulation.batch.simulate_batch import in_blocks, run_variants, schema, table_of
from closedloop.simulation.batch.threads import Done, uninterrupted
from closedloop.simulation.batch.worker import Outcome, Worker
from closedloop.simulation.engines.law_source import law_digest
from closedloop.simulation.parts import Cache

if TYPE_CHECKING:
    import pyarrow as pa


def write_part(path: Path, content: memoryview) -> None:
    """Write a part's file whole, or not at all."""
    named = b"".join((content, path.name.encode()))
    write_whole(path, b"".join((named, seal(named))))


def read_part(path: Path) -> memoryview:
    """Return the content of a part's file; OSError or ValueError if there is none, or another, or damage."""
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


def columns_of(job: Job, keep: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of the table, or of a part, which has whole columns too."""
    import pyarrow as pa

    types = {key: pa.type_for_alias(kind) for key, kind in zip(job.keys, job.kinds, strict=True)}
    return schema(types, keep, _variants(job).base)


def run_part(
    job: Job, first: int, points: Sequence[Sequence[Any]], worker: Worker, ran: Callable[[], None] = lambda: None
) -> pa.Table:
    """Run the runs from number `first` on, with these values of the keys; return a table with a row for each run."""
    came_to: dict[int, Outcome] = {}
    for block in in_blocks(_variants(job), points, job.engine, job.runs, lanes=not job.law):
        some = run_variants(worker, _variants(job), [points[i] for i in block], job.engine, ran)
        came_to |= dict(zip(block, some, strict=True))
    outcomes = [came_to[i] for i in range(len(points))]
    return table_of(columns_of(job, job.keep), first, points, outcomes, job.keep)


def worker_for(job: Job, shared: Cache | None = None) -> Worker:
    """Return a worker for a thread; `shared` is the cache that it shares with others."""
    return Worker(job.engine, job.keep, runs=job.runs, shared=shared, law=law_of(job.law, job.law_digest))


_here = threading.local()


def run_part_anywhere(job: Job, first: int, points: Sequence[Sequence[Any]]) -> pa.Table:
    """Do `run_part` with a `Worker` that this thread keeps from part to part: the task sent to a cluster."""
    if getattr(_here, "job", None) != job:
        _here.job, _here.worker = job, worker_for(job)
    return run_part(job, first, points, _here.worker)


FORMAT = "closedloop sweep 2"
DESCRIPTION = "sweep.json"
# What is written here, and so may be removed again; earlier versions had archives, and a file that they locked.
_PART = re.compile(r"part-\d{8,}\.(arrow|npz)|lock")


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
                there = [path for path in self.folder.iterdir() if not path.name.endswith(".unfinished")]
                if there and not description.is_file():
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

    def _close(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def file_of(self, part: int) -> Path:
        """Return where a part is."""
        return self.folder / f"part-{part:08}.arrow"

    def has(self, part: int, runs: range) -> bool:
        """Return whether a part is there as it was written, with these runs."""
        import pyarrow as pa

        if not self.file_of(part).is_file():
            return False
        try:
            rows = self.read(part)
            return set(self.identity["keep"]) <= set(rows.column_names) and rows["run"].to_pylist() == list(runs)
        except (OSError, ValueError, KeyError, pa.ArrowException):
            return False  # as of a disk that lost its power

    def read(self, part: int) -> pa.Table:
        """Return the rows of a part."""
        import pyarrow as pa

        return pa.ipc.open_file(pa.BufferReader(read_part(self.file_of(part)))).read_all()

    def write(self, part: int, rows: pa.Table) -> None:
        """Write a part, serialised in memory first, so that no library has to handle a full disk."""
        import pyarrow as pa

        table = pa.BufferOutputStream()
        with pa.ipc.new_file(table, rows.schema) as writer:
            writer.write_table(rows.combine_chunks())
        try:
            write_part(self.file_of(part), memoryview(table.getvalue()))
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
    if told := difference(found["identity"], json.loads(json.dumps(identity))):
        raise occupied(out, f"holds another sweep: {told}")


METADATA = "closedloop_sweep"


def pieces(path: Path) -> Iterator[pa.Table]:
    """Yield the rows of a table's file, some at a time; files without checksums, as others write them, are read too.

    Raises ValueError or KeyError or pyarrow.ArrowException if it is no Parquet file, or is damaged.
    Raises OSError if it cannot be read; without a number if it is damaged.
    """
    from pyarrow import parquet

    # Arrow would open names that are text only.
    with path.open("rb") as opened, parquet.ParquetFile(opened, page_checksum_verification=True) as file:
        yield file.schema_arrow.empty_table()
        columns = [file.schema.column(i).path for i in range(len(file.schema))]
        for group in range(file.num_row_groups):
            there = file.metadata.row_group(group)
            if [there.column(i).path_in_schema for i in range(there.num_columns)] != columns:
                raise ValueError("the names of its columns differ")
            yield file.read_row_group(group)


@contextmanager
def unreadable_is_none() -> Iterator[None]:
    """Pass over what Arrow says of a file that is none of its own, or damaged; not over what the system says."""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, ValueError, KeyError, RecursionError):
        pass
    except OSError as error:
        if error.errno is not None:
            raise


# Bytes that HDF5 takes beside the numbers of a run's column at most.
OF_CHUNK = 400


def write_columns(
    path: Path, store: Store, parts: int, attributes: dict[str, str], step: float, check: Callable[[], None]
) -> None:
    """Write the whole columns of all parts into a file.

    `step`: time between the rows of a run, s, where the runs do not say.
    `check`: called between two parts; it may raise.
    Raises OutputError.
    """
    runs, rows, keep = store.identity["runs"], 0, store.identity["keep"]
    widths: dict[str, tuple[int, ...]] = {}
    for part in range(parts):
        check()
        table = store.read(part)
        rows = max(rows, max(table["rows"].to_pylist(), default=0))
        widths |= {name: each.shape[1:] for name in keep for each in map(_whole, table[name]) if each.size}

    def write(out: Any) -> None:
        out.attrs.update(attributes)
        out.dimensions = {"run": runs, "time": rows, "axis": 3}
        if "time.step" in store.identity["axes"]:
            steps = out.create_variable("time_step", ("run",), "f8")
            steps.attrs["units"] = "s"
        else:
            out.create_variable("time", ("time",), data=step * np.arange(rows)).attrs["units"] = "s"
        for name, wide in widths.items():
            _create(out, name, rows, wide)
        first = 0
        for part in range(parts):
            check()
            table = store.read(part)
            if "time.step" in store.identity["axes"]:
                steps[first : first + len(table)] = table["time.step"].to_numpy()
            for name in widths:
                for run, each in enumerate(map(_whole, table[name]), first):
                    if each.size:
                        out.variables[name][run, : len(each)] = each
            first += len(table)

    room = sum(runs * (8 * rows * int(np.prod(wide)) + OF_CHUNK) + OF_VARIABLE for wide in widths.values())
    texts = 4 * sum(map(len, attributes.values()))
    write_reserved(path, room + 8 * (runs + rows) + texts, write)


def _whole(cell: Any) -> Array:
    """Return the whole column of a run, (rows,) or (rows, k), of its list in a table; (0,) where nothing ran."""
    import pyarrow as pa

    values = cell.values
    if values is None:
        return np.zeros(0)
    wide = pa.types.is_list(values.type)
    numbers: Array = (values.flatten() if wide else values).to_numpy(zero_copy_only=False)
    return numbers.reshape(len(values), -1) if wide else numbers


# The columns that judge a run's numbers and its control, where the table has them, and what they say of a good one.
VERDICT, CONTROL, GOOD = "verdict", "control_verdict", "good"
# Rows of the table that are compressed together.
ROWS_TOGETHER = 8192


@dataclass(frozen=True)
class Joined:
    """A sweep that is done."""

    table: Path  # the Parquet file
    columns: Path | None  # the NetCDF file of whole columns
    counts: dict[str, int]  # how many runs have each status
    verdicts: dict[str, int]  # how many runs have each verdict that is not good
    controls: dict[str, int]  # the same of the verdict of the control


def _create(file: Any, name: str, rows: int, wide: tuple[int, ...]) -> None:
    column = ALL_COLUMNS[name]
    if wide and column.dims[1] not in file.dimensions:
        file.dimensions[column.dims[1]] = wide[0]
    variable = file.create_variable(
        name, ("run", *column.dims), "f8", fillvalue=np.nan, chunks=(1, max(rows, 1), *wide), fletcher32=True
    )  # fmt: skip
    variable.attrs["units"], variable.attrs["long_name"] = column.units, column.meaning


def already_there(identity: dict[str, Any], out: Path) -> Joined | None:
    """Return the sweep if `out` holds it already, None if nothing is there."""
    if out.suffix != ".parquet":
        raise OutputError(f"--out {out}: must end in .parquet")
    if out.exists() and not out.is_file():  # a folder, or a pipe, which would be waited for
        raise OutputError(f"--out {out}: exists and is not a sweep, but a folder or a device; name another file")
    kept = out.with_suffix(".nc") if identity["keep"] else None
    try:
        if not out.exists():
            if kept is not None and kept.exists():
                check_identity(_of_netcdf(kept), identity, kept)
            return None
        found = counted = None
        with unreadable_is_none():
            from pyarrow import parquet

            with out.open("rb") as opened:
                said: bytes = (parquet.read_schema(opened).metadata or {})[METADATA.encode()]
            found = json.loads(said.decode())
            counted = _Counts(Counter(), Counter(), Counter())
            for rows in pieces(out):
                counted.add(rows)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise unwritable(out, error) from None
    check_identity(found, identity, out)
    if counted is None:
        raise occupied(out, "is damaged")
    if kept is not None and not kept.exists():
        raise OutputError(f"--out {out}: is done, but {kept} is gone; remove the table to run it again")
    return Joined(out, kept, *map(dict, counted))


def join(store: Store, out: Path, parts: int, columns: pa.Schema, step: float) -> Joined:
    """Make the table of the parts, and remove them.

    `out`: the table.
    `step`: time between the rows of a run, s, where the runs do not say.
    Raises OutputError if a file cannot be written; the parts stay.
    """
    description = {METADATA: json.dumps({"format": FORMAT, "identity": store.identity})}
    kept = out.with_suffix(".nc") if store.identity["keep"] else None
    counts = _Counts(Counter(), Counter(), Counter())

    def write(done: Done) -> None:
        def write_table(file: BinaryIO) -> None:
            from pyarrow import parquet

            with parquet.ParquetWriter(file, columns.with_metadata(description), write_page_checksum=True) as table:
                for rows in _rows(store, parts, columns.names, done.check):
                    table.write_table(rows, row_group_size=2**30)
                    counts.add(rows)

        if kept is None and store.overwrite:
            # Another sweep left its whole columns beside the table that this one replaces.
            path = out.with_suffix(".nc")
            found = _of_netcdf(path) if path.is_file() and not path.is_symlink() else None
            if isinstance(found, dict) and found.get("format") == FORMAT:
                path.unlink()
        if kept is not None:  # first: where the table is, all is there
            write_columns(kept, store, parts, description, step, done.check)
        write_whole(out, write_table)

    remove_unfinished(out.parent)  # of a process that was killed while it joined
    try:
        uninterrupted(write)
    except OSError as error:
        raise OutputError(
            f"--out {out}: {error}; what was done is kept: once there is room, the same command goes on"
        ) from None
    store.remove()
    return Joined(out, kept, *map(dict, counts))


def _rows(store: Store, parts: int, names: Sequence[str], check: Callable[[], None]) -> Iterator[pa.Table]:
    """Yield the rows of all parts, some at a time, without whole columns."""
    import pyarrow as pa

    waiting: list[pa.Table] = []
    for part in range(parts):
        check()
        waiting.append(store.read(part).select(names))
        if part == parts - 1 or sum(map(len, waiting)) >= ROWS_TOGETHER:
            yield pa.concat_tables(waiting).replace_schema_metadata()
            waiting = []


class _Counts(NamedTuple):
    """How many runs have each status, and each verdict of either kind that is not good."""

    statuses: Counter[str]
    verdicts: Counter[str]
    controls: Counter[str]

    def add(self, rows: pa.Table) -> None:
        """Count the runs of some rows too."""
        self.statuses.update(rows["status"].to_pylist())
        for count, name in ((self.verdicts, VERDICT), (self.controls, CONTROL)):
            said = rows[name].to_pylist() if name in rows.column_names else ()
            count.update(word for word in said if word is not None and word.partition(";")[0] != GOOD)


def _of_netcdf(path: Path) -> Any:
    import h5netcdf

    try:
        with h5netcdf.File(path, "r") as file:
            return json.loads(file.attrs[METADATA])
    except (OSError, ValueError, KeyError, TypeError):
        return None
