"""From the parts of a sweep to its table, in order of the runs, part by part.

The table is a Parquet file: typed columns, compressed, read by everything, in pieces if need be. Whole columns of the
runs go into a NetCDF-4 file, as those of a single run do (`closedloop.runfile`), so that MATLAB, xarray and h5py open
both alike. Zarr could be written in place, part by part, but is a folder of thousands of files that needs one more
package to be read; and HDF5, which a kill in the middle of writing would spoil, is written here only, from parts that
are safe, under another name until it is whole.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.errors import OutputError
from closedloop.record import COLUMNS
from closedloop.sweep.store import FORMAT, Store, check_identity, unwritable, whole

if TYPE_CHECKING:
    import pyarrow as pa

METADATA = "closedloop_sweep"
# Rows of the table that are compressed together.
ROWS_TOGETHER = 8192


@dataclass(frozen=True)
class Joined:
    """A sweep that is done.

    Attributes
    ----------
    table : Path
        The Parquet file.
    columns : Path or None
        The NetCDF file of whole columns.
    counts : mapping of str to int
        How many runs have each status.
    verdicts : mapping of str to int
        How many runs have each verdict.
    """

    table: Path
    columns: Path | None
    counts: dict[str, int]
    verdicts: dict[str, int]


def already_there(identity: dict[str, Any], out: Path) -> Joined | None:
    """Return the sweep if `out` holds it already, None if nothing is there.

    Raises
    ------
    OutputError
        If something else is there, or could not be put there.
    """
    import pyarrow as pa
    from pyarrow import parquet

    if out.suffix != ".parquet":
        raise OutputError(f"--out {out}: must end in .parquet")
    kept = out.with_suffix(".nc") if identity["keep"] else None
    try:
        if not out.exists():
            if kept is not None and kept.exists():
                check_identity(_of_netcdf(kept), identity, kept)
            return None
        try:
            if out.is_dir():
                raise ValueError("a folder")
            found = json.loads((parquet.read_schema(out).metadata or {})[METADATA.encode()])
        except (pa.ArrowInvalid, ValueError, KeyError):
            found = None
    except OSError as error:
        raise unwritable(out, error) from None
    check_identity(found, identity, out)
    if kept is not None and not kept.exists():
        raise OutputError(f"--out {out}: is done, but {kept} is gone; remove the table to run it again")
    store = Store(identity, out)
    if store.folder.exists():  # killed after the last file was there
        store.remove()
    table = parquet.read_table(out, columns=["status", "verdict"])
    return Joined(out, kept, *(Counter(table[name].to_pylist()) for name in ("status", "verdict")))


def join(store: Store, out: Path, parts: int, columns: pa.Schema, step: float) -> Joined:
    """Make the table of the parts, and remove them.

    Parameters
    ----------
    store : Store
        All parts are there.
    out : Path
        The table.
    parts : int
        How many parts there are.
    columns : pyarrow.Schema
        The table's columns.
    step : float
        Time between the rows of a run, s, where the runs do not say.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    description = json.dumps({"format": FORMAT, "identity": store.identity})
    counts: Counter[str] = Counter()
    verdicts: Counter[str] = Counter()

    def write_table(path: Path) -> None:
        counts.clear()
        verdicts.clear()
        with parquet.ParquetWriter(path, columns.with_metadata({METADATA: description})) as writer:
            waiting: list[pa.Table] = []
            for part in range(parts):
                waiting.append(store.read(part))
                counts.update(waiting[-1]["status"].to_pylist())
                verdicts.update(waiting[-1]["verdict"].to_pylist())
                if part == parts - 1 or sum(map(len, waiting)) >= ROWS_TOGETHER:
                    writer.write_table(pa.concat_tables(waiting).replace_schema_metadata(), row_group_size=2**30)
                    waiting = []

    kept = out.with_suffix(".nc") if store.identity["keep"] else None
    try:
        if kept is not None:  # first: where the table is, all is there
            whole(kept, lambda path: _write_columns(path, store, parts, description, step))
        whole(out, write_table)
    except OSError as error:
        raise unwritable(out, error) from None
    store.remove()
    return Joined(out, kept, counts, verdicts)


def _write_columns(path: Path, store: Store, parts: int, description: str, step: float) -> None:
    import h5netcdf

    runs, rows = store.identity["runs"], 0
    for part in range(parts):
        rows = max(rows, max(store.read(part)["rows"].to_pylist(), default=0))
    with h5netcdf.File(path, "w") as file:
        file.attrs[METADATA] = description
        file.dimensions = {"run": runs, "time": rows, "axis": 3}
        if "time.step" in store.identity["axes"]:
            steps = file.create_variable("time_step", ("run",), "f8")
            steps.attrs["units"] = "s"
        else:
            file.create_variable("time", ("time",), data=step * np.arange(rows)).attrs["units"] = "s"
        first = 0
        for part in range(parts):
            table = store.read(part)
            stop = first + len(table)
            if "time.step" in store.identity["axes"]:
                steps[first:stop] = table["time.step"].to_numpy()
            with np.load(store.columns_of(part), allow_pickle=False) as whole_columns:
                for name in whole_columns.files:
                    data = whole_columns[name]
                    if data.shape[1] == 0:  # no run of this part has a row
                        continue
                    if name not in file.variables:
                        _create(file, name, rows, data.shape[2:])
                    file.variables[name][first:stop, : data.shape[1]] = data
            first = stop


def _create(file: Any, name: str, rows: int, wide: tuple[int, ...]) -> None:
    column = COLUMNS[name]
    if wide and column.dims[1] not in file.dimensions:
        file.dimensions[column.dims[1]] = wide[0]
    variable = file.create_variable(
        name, ("run", *column.dims), "f8", fillvalue=np.nan, chunks=(1, max(rows, 1), *wide)
    )  # fmt: skip
    variable.attrs["units"], variable.attrs["long_name"] = column.units, column.meaning


def _of_netcdf(path: Path) -> Any:
    import h5netcdf

    try:
        with h5netcdf.File(path, "r") as file:
            return json.loads(file.attrs[METADATA])
    except (OSError, ValueError, KeyError, TypeError):
        return None
