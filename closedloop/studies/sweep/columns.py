"""Whole columns of a sweep as a NetCDF-4 file, on a disk that may be full: see `closedloop.record.netcdf_file`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.record.columns.recorded import ALL_COLUMNS
from closedloop.record.netcdf_file import OF_VARIABLE, write_reserved

if TYPE_CHECKING:
    from closedloop.studies.sweep.store import Store

# Bytes that HDF5 takes beside the numbers of a run's column at most.
OF_CHUNK = 400


def write_columns(
    path: Path, store: Store, parts: int, attributes: dict[str, str], step: float, check: Callable[[], None]
) -> None:
    """Write the whole columns of all parts into a file.

    Parameters
    ----------
    step : float
        Time between the rows of a run, s, where the runs do not say.
    check : callable
        Called between two parts; it may raise.

    Raises
    ------
    OutputError
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


def _create(file: Any, name: str, rows: int, wide: tuple[int, ...]) -> None:
    column = ALL_COLUMNS[name]
    if wide and column.dims[1] not in file.dimensions:
        file.dimensions[column.dims[1]] = wide[0]
    variable = file.create_variable(
        name, ("run", *column.dims), "f8", fillvalue=np.nan, chunks=(1, max(rows, 1), *wide), fletcher32=True
    )  # fmt: skip
    variable.attrs["units"], variable.attrs["long_name"] = column.units, column.meaning
