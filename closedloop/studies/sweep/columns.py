"""Whole columns of a sweep as a NetCDF-4 file, on a disk that may be full: see `closedloop.record.unfailing`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from closedloop.record.columns.recorded import ALL_COLUMNS
from closedloop.record.unfailing import Unfailing

if TYPE_CHECKING:
    from closedloop.studies.sweep.store import Store


def write_columns(
    file: BinaryIO, store: Store, parts: int, attributes: dict[str, str], step: float, check: Callable[[], None]
) -> None:
    """Write the whole columns of all parts into a file.

    Parameters
    ----------
    file : binary file
        Open for reading and writing, empty.
    step : float
        Time between the rows of a run, s, where the runs do not say.
    check : callable
        Called between two parts; it may raise.
    """
    import h5netcdf

    runs, rows = store.identity["runs"], 0
    for part in range(parts):
        rows = max(rows, max(store.read(part)["rows"].to_pylist(), default=0))
    steady = Unfailing(file)
    with h5netcdf.File(steady, "w") as out:
        out.attrs.update(attributes)
        out.dimensions = {"run": runs, "time": rows, "axis": 3}
        if "time.step" in store.identity["axes"]:
            steps = out.create_variable("time_step", ("run",), "f8")
            steps.attrs["units"] = "s"
        else:
            out.create_variable("time", ("time",), data=step * np.arange(rows)).attrs["units"] = "s"
        first = 0
        for part in range(parts):
            check()
            table = store.read(part)
            stop = first + len(table)
            if "time.step" in store.identity["axes"]:
                steps[first:stop] = table["time.step"].to_numpy()
            for name, data in store.read_columns(part).items():
                if data.shape[1] == 0:  # no run of this part has a row
                    continue
                if name not in out.variables:
                    _create(out, name, rows, data.shape[2:])
                out.variables[name][first:stop, : data.shape[1]] = data
                steady.check()
            first = stop
    steady.check()


def _create(file: Any, name: str, rows: int, wide: tuple[int, ...]) -> None:
    column = ALL_COLUMNS[name]
    if wide and column.dims[1] not in file.dimensions:
        file.dimensions[column.dims[1]] = wide[0]
    variable = file.create_variable(
        name, ("run", *column.dims), "f8", fillvalue=np.nan, chunks=(1, max(rows, 1), *wide), fletcher32=True
    )  # fmt: skip
    variable.attrs["units"], variable.attrs["long_name"] = column.units, column.meaning
