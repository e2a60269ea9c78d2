"""Running a sweep, or resuming one that was killed, up to its table."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from closedloop.base.errors import OutputError
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.batch.worker import Worker
from closedloop.simulation.cache import Cache
from closedloop.studies.sweep.join import Joined, already_there, join
from closedloop.studies.sweep.part import columns_of, run_part, worker_for
from closedloop.studies.sweep.store import OccupiedError, Store, tidy
from closedloop.studies.sweep.sweep import Sweep


def run_sweep(
    sweep: Sweep,
    out: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    overwrite: bool = False,
) -> Joined:
    """Run what is not yet there of a sweep, and join its parts into the table.

    Parameters
    ----------
    sweep : Sweep
    out : path
        The table, a Parquet file; whole columns go into a NetCDF file of the same name beside it, parts into a folder
        until all are there.
    workers : int, optional
        Threads; as many as there are cores if left out.
    scheduler : str, optional
        Address of a Dask scheduler, ``tcp://host:port``, whose workers run the parts instead.
    progress : callable, optional
        Gets (runs done, runs in all).
    overwrite : bool
        Whether a file there that is not this sweep's is replaced once this one is done; its parts go at once.

    Raises
    ------
    OutputError
        If `out` cannot be written, or is there already and not this sweep's.
    ClusterError
        If the scheduler does not answer, or is lost on the way; what was done is kept.
    """
    out = Path(out)
    threads = threads_for(sweep.engine, workers)
    there = _already_there(sweep, out, overwrite)
    if there is not None:
        tidy(sweep.identity, out)
        return there
    try:
        with Store(sweep.identity, out, overwrite) as store:
            there = _already_there(sweep, out, overwrite)  # since, by another process
            if there is not None:
                store.remove()
                return there
            missing = [part for part in range(sweep.parts) if not store.has(part, sweep.runs_of(part))]
            done = Done(sweep.design.runs - sum(len(sweep.runs_of(part)) for part in missing))

            def report() -> None:
                if progress is not None:
                    progress(done.count, sweep.design.runs)

            report()
            if missing and scheduler is not None:
                from closedloop.studies.sweep.cluster import run_on_cluster

                run_on_cluster(sweep, store, missing, scheduler, done.add, report)
            elif missing:
                job, shared = sweep.job, Cache()

                def one(worker: Worker, at: int) -> None:
                    runs = sweep.runs_of(missing[at])
                    points = sweep.design[runs.start : runs.stop]
                    store.write(missing[at], *run_part(job, runs.start, points, worker, done.add))

                side_by_side(one, len(missing), threads, lambda: worker_for(job, shared), report, done)
            return join(store, out, sweep.parts, columns_of(sweep.job), sweep.scenario.time.step)
    except KeyboardInterrupt:
        with suppress(OutputError):
            there = already_there(sweep.identity, out)
            if there is not None:  # it came too late: the table is whole
                tidy(sweep.identity, out)
                return there
        raise


def _already_there(sweep: Sweep, out: Path, overwrite: bool) -> Joined | None:
    try:
        return already_there(sweep.identity, out)
    except OccupiedError:
        if overwrite:
            return None
        raise
