"""The table of a sweep: Parquet of values, NetCDF of columns, joined from its parts.

The table is a Parquet file: typed columns, compressed, widely readable, also by row groups. Each page of values has
Parquet's own checksum. What stands outside of the pages, names and units, has none: a digest in the file's metadata
would be kept by a program that leaves rows out, and refuse what is as it should be. But a column's name is there more
than once.

Whole columns of the runs go into a NetCDF-4 file, as those of a single run do, so that MATLAB, xarray and h5py open
both. Zarr could be written in place, part by part, but is a folder of thousands of files that needs one more
package to be read. HDF5, which a kill during a write would corrupt, is written here only, from the parts, under another
name until it is complete.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from closedloop.base.errors import OutputError
from closedloop.base.files import remove_unfinished, write_whole
from closedloop.record.columns.record import ALL_COLUMNS
from closedloop.record.save import OF_VARIABLE, write_reserved
from closedloop.simulation.batch.threads import Done, uninterrupted
from closedloop.studies.sweep.store import FORMAT, Store, check_identity, occupied, unwritable

if TYPE_CHECKING:
    import pyarrow as pa


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
    runs, rows = store.identity["runs"], 0
    widths: dict[str, tuple[int, ...]] = {}
    for part in range(parts):
        check()
        rows = max(rows, max(store.read(part)["rows"].to_pylist(), default=0))
        widths |= {name: data.shape[2:] for name, data in store.read_columns(part).items() if data.shape[1]}

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
            stop = first + len(table)
            if "time.step" in store.identity["axes"]:
                steps[first:stop] = table["time.step"].to_numpy()
            for name, data in store.read_columns(part).items():
                if name in widths and data.shape[1]:
                    out.variables[name][first:stop, : data.shape[1]] = data
            first = stop

    room = sum(runs * (8 * rows * int(np.prod(wide)) + OF_CHUNK) + OF_VARIABLE for wide in widths.values())
    texts = 4 * sum(map(len, attributes.values()))
    write_reserved(path, room + 8 * (runs + rows) + texts, write)


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
    description = json.dumps({"format": FORMAT, "identity": store.identity})
    attributes = {METADATA: description}
    kept = out.with_suffix(".nc") if store.identity["keep"] else None
    counts = _Counts(Counter(), Counter(), Counter())

    def write(done: Done) -> None:
        def write_table(file: BinaryIO) -> None:
            from pyarrow import parquet

            said = columns.with_metadata({METADATA: description})
            with parquet.ParquetWriter(file, said, write_page_checksum=True) as table:
                for rows in _rows(store, parts, done.check):
                    table.write_table(rows, row_group_size=2**30)
                    counts.add(rows)

        if kept is None and store.overwrite:
            # Another sweep left its whole columns beside the table that this one replaces.
            path = out.with_suffix(".nc")
            if path.is_file() and not path.is_symlink():
                found = _of_netcdf(path)
                if isinstance(found, dict) and found.get("format") == FORMAT:
                    path.unlink()
        if kept is not None:  # first: where the table is, all is there
            write_columns(kept, store, parts, attributes, step, done.check)
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


def _rows(store: Store, parts: int, check: Callable[[], None]) -> Iterator[pa.Table]:
    """Yield the rows of all parts, some at a time."""
    import pyarrow as pa

    waiting: list[pa.Table] = []
    for part in range(parts):
        check()
        waiting.append(store.read(part))
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
