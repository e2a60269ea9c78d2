"""Many runs of one scenario at once, on all cores.

    table = cl.simulate_batch(cl.load_scenario("wam_slide"), {"law.force": [5.0, 10.0, 15.0]})
    table.to_pandas()[["law.force", "min_contact_force"]]

Each thread has a `Worker` and takes the next block of runs when it has finished one. The compiled engine releases the
interpreter's lock while it steps, so threads run in parallel and share memory.

The table has a row for each run, with the changed keys, the outcome, and the values of its summary. It is Arrow's,
because Parquet files, pandas, polars and DuckDB all take that as it is, units travel with the columns, and a value that
does not exist is empty, not NaN.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, needs
from closedloop.base.progress import reporting
from closedloop.base.second_process import cores
from closedloop.jit.simd8 import WIDE
from closedloop.loop.events.table import KINDS
from closedloop.loop.step.record_row import ARM_RECORDED, RECORDED
from closedloop.record.columns.record import SYMBOLS
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES, NAMES, WIDTH
from closedloop.scenario.load import Variants
from closedloop.scenario.scenario import Scenario, families
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.batch.worker import Outcome, Worker, failed
from closedloop.simulation.engines.lanes import FEWEST, uses_lanes
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.parts import Cache
from closedloop.simulation.simulate import check_engine
from robot_models import RobotModel

if TYPE_CHECKING:
    import pyarrow as pa


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
    told = {
        "status": "done; stopped: the values are those until then; refused: nothing ran; failed: an unexpected error",
        "verdict": "good, or what is wrong with the numbers, see closedloop.record.report.verdict; empty if refused "
        "or failed",
        "control_verdict": "good, or what is wrong with the control (closedloop.record.report.control_verdict); empty "
        "if nothing ran",
        "reason": "why it was stopped, was refused or failed",
    }
    fields += [field(name, text, "", meaning) for name, meaning in told.items()]
    fields += [
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
    columns: pa.Schema, first: int, points: Sequence[Sequence[Any]], outcomes: Sequence[Outcome],
    keep: Sequence[str] = (),
) -> pa.Table:  # fmt: skip
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
    told = ("status", "verdict", "control", "reason", "rows", "end_time")
    data += [[getattr(outcome, name) for outcome in outcomes] for name in told]
    data += list(measures.T)
    data += _by_joint([outcome.values[WIDTH:].reshape(len(JOINT_MEASURES), -1) for outcome in outcomes])
    arrays: list[Any] = [
        values.cast(field.type) if isinstance(values, pa.Array) else pa.array(values, field.type, from_pandas=True)
        for values, field in zip(data, columns, strict=False)
    ]
    arrays += [
        pa.chunked_array([_whole_column(outcome.columns.get(name), columns.field(name).type) for outcome in outcomes])
        for name in keep
    ]
    return pa.table(arrays, schema=columns)


def _by_joint(values: Sequence[Array]) -> list[pa.Array]:
    """Return each of `JOINT_MEASURES`, of runs with (measures, n) values: lists of a number for each joint."""
    import pyarrow as pa

    ends = pa.array(np.cumsum([0, *(own.shape[1] for own in values)]), pa.int32())  # n = 0 if nothing ran
    flat = [pa.array(row, pa.float64(), from_pandas=True) for row in np.concatenate(values, axis=1)]
    return [pa.ListArray.from_arrays(ends, each) for each in flat]


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


MOST_THREADS = 1000
# Keys in which the runs of one set of lanes may differ; see `closedloop.simulation.engines.lanes.Kind`.
OF_ANY_KIND = (
    "law.force", "law.kp", "law.kd", "law.pd_start", "stabiliser.time_constant", "stabiliser.damping_ratio", "start.",
    "reference.", "force_profile.", "surface.", "surface_motion.", "friction.", "compliance.", "impact.",
)  # fmt: skip
# But for these.
OF_A_KIND = ("surface.contact", *(f"{part}.kind" for part in ("surface", "surface_motion", "friction", "compliance")))


@arguments_checked(changes="a list with one value for each run, by its key: {'law.force': [5.0, 10.0]}")
def simulate_batch(
    scenario: Scenario, changes: Mapping[str, Sequence[Any]], *, grid: bool = False, keep: Iterable[str] = (),
    engine: str = COMPILED, workers: int | None = None, model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False, law: Law | None = None,
) -> pa.Table:  # fmt: skip
    """Simulate a scenario many times with some keys changed, and return a table of the runs.

    Parameters
    ----------
    scenario : Scenario
        What the runs have in common.
    changes : mapping of str to sequence
        Dotted keys, as `load_scenario` takes them, and for each a value per run: run i has the i-th of every key.
    grid : bool
        Whether every value of a key goes with every value of the others instead; the last key changes fastest.
    keep : iterable of str
        Columns of the runs to keep whole, as lists: "f" or "contact_force", "e" or "closure_error", "q", "torque" ...
    engine : "compiled" or "pinocchio"
        See `simulate`. Pinocchio takes any integrator, and one core.
    workers : int, optional
        Threads; as many as there are cores if left out. The table is the same, to the last bit, for any number.
    model : RobotModel, optional
        The robot to use instead of loading the one that the scenario names.
    progress : bool or callable
        True draws a bar on standard error; a callable gets (runs done, runs in all).
    law : callable, optional
        A user's law in place of the scenario's, see `simulate`; the compiled engine takes one that numba has compiled.

    Returns
    -------
    pyarrow.Table
        A row for each run, in order: its number, the changed keys, ``status`` ("done", "stopped", "refused", "failed":
        an unforeseen error) with its ``reason``, the values of `Run.summary` (empty where there is none), the
        events, when each of the paper's assumptions failed, and the kept columns. Units and meanings are the fields'
        metadata. A run that fails is a row like any other.

    Raises
    ------
    ScenarioError
        If a key is unknown, lengths differ, the engine does not cover the scenario, or no run could be read.
    """
    needs("pyarrow")
    if not changes:
        raise ScenarioError("changes: name at least one key and its values, such as {'law.force': [5.0, 10.0]}")
    keys = tuple(changes)
    points = _points(changes, grid)
    columns = kept_columns(keep)
    variants = Variants(scenario, keys)
    check_engine(variants.look(points), engine, law)
    threads, shared = threads_for(engine, workers), Cache()
    blocks = in_blocks(variants, points, engine, len(points), threads, lanes=law is None)
    outcomes: list[Outcome | None] = [None] * len(points)
    done = Done()

    def one(worker: Worker, at: int) -> None:
        some = run_variants(worker, variants, [points[i] for i in blocks[at]], engine, done.add)
        for i, outcome in zip(blocks[at], some, strict=True):
            outcomes[i] = outcome

    with reporting(progress, scenario.name, len(points)) as report:
        side_by_side(
            one, len(blocks), threads, lambda: Worker(engine, columns, model, len(points), shared, law),
            lambda: report(done.count, len(points)), done,
        )  # fmt: skip
    kinds = {key: key_type([point[k] for point in points]) for k, key in enumerate(keys)}
    return table_of(schema(kinds, columns, scenario), 0, points, [x for x in outcomes if x is not None], columns)


def in_blocks(
    variants: Variants, points: Sequence[Sequence[Any]], engine: str, runs: int, threads: int = 1, *, lanes: bool = True
) -> list[list[int]]:
    """Return the numbers of all points: in blocks of those that may share SIMD lanes, the others one by one.

    `threads`: how many threads take blocks; each should get some.
    `lanes`: whether lanes may be used: they have no law of a user's.
    """
    tells_kinds = [at for at, key in enumerate(variants.keys) if not key.startswith(OF_ANY_KIND) or key in OF_A_KIND]
    kinds: dict[tuple[str, ...], list[int]] = {}
    for i, point in enumerate(points):
        kinds.setdefault(tuple(repr(point[at]) for at in tells_kinds), []).append(i)
    width = max(FEWEST, min(WIDE, -(-len(points) // threads)))
    blocks = []
    for members in kinds.values():
        alone = not lanes or len(members) < FEWEST
        each = 1 if alone or not _use_lanes(variants, [points[i] for i in members[:WIDE]], engine, runs) else width
        blocks += [members[first : first + each] for first in range(0, len(members), each)]
    return blocks


def _use_lanes(variants: Variants, points: Sequence[Sequence[Any]], engine: str, runs: int) -> bool:
    """Whether the runs with these values, of one kind, use lanes: decided by the first that can be read."""
    for values in points:
        try:
            return uses_lanes(variants.scenario(values), engine, runs)
        except Exception:  # reported in its own row
            continue
    return False


def run_variants(
    worker: Worker, variants: Variants, points: Sequence[Sequence[Any]], engine: str, ran: Callable[[], None]
) -> list[Outcome]:
    """Run the variants with these values, a block of `in_blocks`; one that cannot even be read says why.

    `ran` is called after each.
    """
    outcomes: list[Outcome | None] = []
    scenarios = []
    for values in points:
        try:
            scenario = variants.scenario(values)
            check_engine(scenario, engine, worker.law)
            scenarios.append(scenario)
            outcomes.append(None)
        except Exception as error:  # the border of a row: see `failed`
            outcomes.append(failed(error))
            ran()
    came_to = iter(worker.run_all(scenarios, ran))
    return [next(came_to) if outcome is None else outcome for outcome in outcomes]


def threads_for(engine: str, workers: int | None) -> int:
    """Return how many threads to use: one for Pinocchio, which Python drives, else one a core, unless told."""
    if workers is not None and not 1 <= workers <= MOST_THREADS:
        raise ScenarioError(f"workers = {workers}: must be at least 1, and at most {MOST_THREADS}")
    if engine != COMPILED:
        return 1
    return workers or cores()


def _points(changes: Mapping[str, Sequence[Any]], grid: bool) -> list[tuple[Any, ...]]:
    values: list[list[Any]] = []
    for key, given in changes.items():
        try:
            listed = given.tolist() if hasattr(given, "tolist") else None if isinstance(given, str) else list(given)
        except TypeError:
            listed = None
        if isinstance(listed, list) and (family := families().get(key)):
            listed = [family.named(value, key) for value in listed]
        if not isinstance(listed, list):
            raise ScenarioError(f"changes[{key!r}] = {given!r}: must be a list with one value for each run")
        if not listed:
            raise ScenarioError(f"changes[{key!r}]: is empty; give one value for each run")
        values.append(listed)
    if grid:
        return list(itertools.product(*values))
    lengths = {key: len(listed) for key, listed in zip(changes, values, strict=True)}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise ScenarioError(
            f"changes: {said} values: give each as many, one for each run, or combine them all: grid=True"
        )
    return list(zip(*values, strict=True))
