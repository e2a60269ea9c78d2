"""A part of a sweep: some runs one after the other, as rows of the table and, if kept, whole columns."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import families
from closedloop.scenario.user_module import import_law
from closedloop.simulation.batch.simulate_batch import in_blocks, run_variants
from closedloop.simulation.batch.table import schema, table_of
from closedloop.simulation.batch.worker import Outcome, Worker
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.law_source import law_digest

if TYPE_CHECKING:
    import pyarrow as pa


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

    return schema({key: pa.type_for_alias(kind) for key, kind in zip(job.keys, job.kinds, strict=True)})


def run_part(
    job: Job, first: int, points: Sequence[Sequence[Any]], worker: Worker, ran: Callable[[], None] = lambda: None
) -> tuple[pa.Table, dict[str, Array]]:
    """Run the runs from number `first` on, with these values of the keys.

    Returns
    -------
    table : pyarrow.Table
        A row for each run.
    columns : dict of str to (runs, rows) or (runs, rows, k) array
        The columns kept; after a run's last row NaN.
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
