"""A run as a table: CSV and Parquet, a column for each number of a row, its unit in the header; MATLAB's arrays.

Events are written beside it, or into it, likewise.
"""

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import OutputError, needs
from closedloop.base.files import write_whole
from closedloop.figures.export.mcap_file import write_mcap
from closedloop.loop.events.table import EVENT_COLUMNS, KINDS
from closedloop.record.columns.derived import DERIVED
from closedloop.record.frame import part_labels
from closedloop.record.run import Run, units_by_kind
from closedloop.scenario.tables import labels_of


def save(run: Run, path: str | Path) -> list[Path]:
    """Write a run in the format that the path's ending names, and return what was written; see `Run.save`."""
    path = Path(path)
    if path.suffix not in FORMATS:
        raise OutputError(
            f"{path}: must end in .nc, .h5, {', '.join(FORMATS)}: the ending says in which format it is written"
        )
    return FORMATS[path.suffix](run, path)


def write_csv(run: Run, path: str | Path) -> list[Path]:
    """Write a run as CSV, and its events, if it has any, beside it with ``_events`` in the name; return the paths.

    Numbers have as many digits as tell them apart from all others, so they are read back to the bit. Headers are
    ``q J1 [rad]``, ``position x [m]`` ...; what has no unit has none. Reactions
    of loop joints are last, ``reaction pin: force along x [N]`` ..., in the axes of the second of its frames.
    """
    return _write_tables(run, Path(path), _csv)


def write_parquet(run: Run, path: str | Path) -> list[Path]:
    """Write a run as Parquet, with the headers of `write_csv`, and its events beside it; return the paths."""
    return _write_tables(run, Path(path), _parquet)


def write_mat(run: Run, path: str | Path) -> list[Path]:
    """Write a run for MATLAB (version 5), and return its path in a list.

    Each column is an array of its name, (N, 1) or (N, k); the struct ``units`` has the unit of each, ``events`` the
    columns of the events.
    """
    from scipy.io import savemat

    names = [*run.specs, *DERIVED]
    values: dict[str, Any] = {name: np.asarray(getattr(run, name)) for name in names if name not in EVENT_COLUMNS}
    values["units"] = {name: run.units(name) for name in names}
    values["events"] = {name: np.asarray(getattr(run, name)) for name in EVENT_COLUMNS}
    file = io.BytesIO()
    savemat(file, values, long_field_names=True, do_compression=True, oned_as="column")
    return [write_whole(path, file.getvalue())]


def _write_tables(run: Run, path: Path, encoded: Callable[[Mapping[str, NDArray[Any]]], bytes]) -> list[Path]:
    """Write the rows of a run, and its events, if it has any, beside it; return the paths."""
    rows = [*(name for name in run.specs if name not in EVENT_COLUMNS), *DERIVED]
    whole = {k: v for name in rows for k, v in _flat(run, name).items()} | _reactions(run)
    written = [write_whole(path, encoded(whole))]
    if run.events:
        columns = {k: v for name in EVENT_COLUMNS for k, v in _flat(run, name).items()}
        columns["event_kind"] = np.array([KINDS[int(kind)] for kind in run.event_kind])
        written.append(write_whole(path.with_name(f"{path.stem}_events{path.suffix}"), encoded(columns)))
    return written


def _flat(run: Run, name: str) -> dict[str, NDArray[Any]]:
    """Return a column of a run as columns of single numbers, by their headers."""
    values, dims = getattr(run, name), (run.specs.get(name) or DERIVED[name]).dims
    if len(dims) == 1:
        return {_header(name, run.units(name)): values}
    known = part_labels(run.model.joint_names, run.model.coordinate_names, labels_of(run.scenario.contact or ()))
    entries = known.get(dims[1]) or tuple(map(str, range(1, values.shape[1] + 1)))
    found, (first, _, other) = {}, run.units(name).partition(" | ")  # of a turn and a slide, or of a force and a moment
    for k, entry in enumerate(entries):
        second = run.model.joint_types[k] == "prismatic" if dims[1] == "joint" else entry.startswith("m")
        unit = units_by_kind("rad", run.model.coordinate_types[k]) if dims[1] == "coordinate" else first
        unit = other if other and second else unit
        found[_header(f"{name} {entry}", unit)] = values[:, k]
    return found


def _reactions(run: Run) -> dict[str, NDArray[Any]]:
    """Return what the loop joints of a mechanism carried, a column for each part, by their headers."""
    found = run.loops
    if found is None:
        return {}
    parts = zip(found.labels, found.units, found.reactions.T, strict=True)
    return {_header(f"reaction {label}", unit): values for label, unit, values in parts}


def _header(name: str, unit: str) -> str:
    return name if unit in ("", "1") else f"{name} [{unit}]"


def _csv(columns: Mapping[str, NDArray[Any]]) -> bytes:
    needs("pyarrow")
    import pyarrow as pa
    from pyarrow import csv

    text = io.BytesIO()
    csv.write_csv(pa.table(dict(columns)), text)
    return text.getvalue()


def _parquet(columns: Mapping[str, NDArray[Any]]) -> bytes:
    needs("pyarrow")
    import pyarrow as pa
    from pyarrow import parquet

    content = io.BytesIO()
    parquet.write_table(pa.table(dict(columns)), content)
    return content.getvalue()


# By the ending of the path; `closedloop export` has them too.
FORMATS: dict[str, Callable[[Run, str | Path], list[Path]]] = {
    ".csv": write_csv, ".mat": write_mat, ".mcap": write_mcap, ".parquet": write_parquet,
}  # fmt: skip
