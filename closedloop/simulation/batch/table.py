"""The table of a batch: a row for each run, with the changed keys, the outcome, and the values of its summary.

It is Arrow's, because Parquet files, pandas, polars and DuckDB all take that as it is, units travel with the columns,
and a value that does not exist is empty, not NaN.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.loop.events.table import KINDS
from closedloop.loop.step.record_row import ARM_RECORDED, RECORDED
from closedloop.record.columns.record import SYMBOLS
from closedloop.record.report.measured import WIDTH
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES, NAMES
from closedloop.simulation.batch.worker import Outcome

if TYPE_CHECKING:
    import pyarrow as pa

    from closedloop.scenario.scenario import Scenario


def kept_columns(names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns' full names."""
    full = tuple(dict.fromkeys(SYMBOLS.get(name, name) for name in names))
    for name in full:
        if name not in RECORDED and name not in ARM_RECORDED:
            short = ", ".join(f"{a} ({b})" for a, b in SYMBOLS.items())
            raise ScenarioError(
                f"keep: no column {name!r}; there are {short}, {', '.join(sorted({*RECORDED, *ARM_RECORDED}))}"
            )
    return full


def key_type(values: Sequence[Any]) -> pa.DataType:
    """Return the type of a column of these values; values that have no common one are written as JSON."""
    import pyarrow as pa

    kinds = {type(value.item() if isinstance(value, np.generic) else value) for value in values}
    if kinds <= {bool}:
        return pa.bool_()
    if kinds <= {int} and all(abs(value) < 2**63 for value in values):
        return pa.int64()
    if kinds <= {int, float}:
        return pa.float64()
    return pa.string()


def schema(types: Mapping[str, pa.DataType], keep: Sequence[str] = (), of: Scenario | None = None) -> pa.Schema:
    """Return the columns of a table of runs of variants of a scenario, with units and meaning as metadata.

    The columns are ``run``, its number; the changed keys; ``status``, ``verdict``, ``control_verdict``,
    ``reason``, ``rows``, ``end_time``;
    the values of `closedloop.record.report.measures`; the number of events of each kind; when each assumption of the
    paper first failed; the values of the joints, each a list with a number for each joint; and the columns that were
    kept, each a list of numbers.
    """
    import pyarrow as pa

    from closedloop.record.columns.record import ALL_COLUMNS
    from closedloop.scenario.messages import key_description, key_unit

    def field(name: str, kind: pa.DataType, units: str, meaning: str) -> pa.Field:
        return pa.field(name, kind, metadata={"units": units, "meaning": meaning})

    number, text, whole = pa.float64(), pa.string(), pa.int64()
    fields = [field("run", whole, "1", "number of the run, from 0")]
    for key, kind in types.items():
        picked = f"{key.partition('.')[0]}.kind" in types  # then runs differ in what the key is
        fields.append(field(key, kind, key_unit(key, None if picked else of), key_description(key)))
    fields += [
        field(
            "status",
            text,
            "",
            "done; stopped: the values are those until then; refused: nothing ran; failed: an unexpected error",
        ),
        field(
            "verdict",
            text,
            "",
            "good, or what is wrong with the numbers, see closedloop.record.report.verdict; empty if refused or failed",
        ),
        field(
            "control_verdict",
            text,
            "",
            "good, or what is wrong with the control (closedloop.record.report.control_verdict); empty if nothing ran",
        ),
        field("reason", text, "", "why it was stopped, was refused or failed"),
        field("rows", whole, "1", "rows of the run's record"),
        field("end_time", number, "s", "instant of the last row"),
    ]
    fields += [field(name, number, measure.units, measure.meaning) for name, measure in MEASURES.items()]
    fields += [field(f"{kind}_events", whole, "1", f"number of events: {kind}") for kind in KINDS.values()]
    fields += [
        field(f"{name}_failed_at", number, "s", f"when the assumption {name} first failed; empty if it held")
        for name in NAMES
    ]
    by_joint = pa.list_(pa.field("element", number))  # as Parquet calls it
    fields += [field(name, by_joint, m.units, f"{m.meaning}, by joint") for name, m in JOINT_MEASURES.items()]
    for name in keep:
        wide = len(ALL_COLUMNS[name].dims) == 2
        kind = pa.list_(pa.list_(number) if wide else number)
        fields.append(field(name, kind, ALL_COLUMNS[name].units, ALL_COLUMNS[name].meaning))
    return pa.schema(fields)


def table_of(
    columns: pa.Schema,
    first: int,
    points: Sequence[Sequence[Any]],
    outcomes: Sequence[Outcome],
    keep: Sequence[str] = (),
) -> pa.Table:
    """Return the rows of the runs from number `first` on: `points` are the values of the keys."""
    import pyarrow as pa

    count = len(points)
    measures = np.array([outcome.values[:WIDTH] for outcome in outcomes]).reshape(count, -1)
    data: list[Any] = [np.arange(first, first + count)]
    for k in range(len(points[0])):
        values = [point[k] for point in points]
        if columns.field(1 + k).type == pa.string():
            values = [value if isinstance(value, str) else json.dumps(value, default=str) for value in values]
        data.append(values)
    data += [
        [outcome.status for outcome in outcomes],
        [outcome.verdict for outcome in outcomes],
        [outcome.control for outcome in outcomes],
        [outcome.reason for outcome in outcomes],
        [outcome.rows for outcome in outcomes],
        [outcome.end_time for outcome in outcomes],
    ]
    data += list(measures.T)
    data += [_by_joint([outcome.values[WIDTH:] for outcome in outcomes], m) for m in range(len(JOINT_MEASURES))]
    arrays: list[Any] = [
        values.cast(field.type) if isinstance(values, pa.Array) else pa.array(values, field.type, from_pandas=True)
        for values, field in zip(data, columns, strict=False)
    ]
    arrays += [
        pa.chunked_array([_whole_column(outcome.columns.get(name), columns.field(name).type) for outcome in outcomes])
        for name in keep
    ]
    return pa.table(arrays, schema=columns)


def _by_joint(values: Sequence[Array], which: int) -> pa.Array:
    """Return one of `JOINT_MEASURES` of each run, as a list of a number for each joint, empty if nothing ran."""
    import pyarrow as pa

    parts = [own.reshape(len(JOINT_MEASURES), -1)[which] for own in values]
    ends = np.cumsum([0, *(part.size for part in parts)])
    flat = pa.array(np.concatenate([np.empty(0), *parts]), pa.float64(), from_pandas=True)
    return pa.ListArray.from_arrays(pa.array(ends, pa.int32()), flat)


def _whole_column(column: Array | None, kind: pa.DataType) -> pa.Array:
    """Return a run's whole column, (N,) or (N, k), as one list of Arrow's about the same memory: nothing is copied."""
    import pyarrow as pa

    if column is None:
        return pa.nulls(1, kind)
    values = pa.array(column.ravel(), pa.float64(), from_pandas=True)
    if column.ndim == 2:
        count, wide = column.shape
        values = pa.ListArray.from_arrays(pa.array(wide * np.arange(count + 1, dtype=np.int32)), values)
    return pa.ListArray.from_arrays(pa.array([0, len(column)], pa.int32()), values).cast(kind)


def one_number(value: Any) -> float:
    """Return a cell of a table as a number: of one for each joint the largest in size, NaN where there is none."""
    if value is None or (isinstance(value, list) and (not value or any(each is None for each in value))):
        return math.nan
    return float(max(map(abs, value)) if isinstance(value, list) else value)
