"""A sweep: what it varies, run whole, resumed, or in parts on a cluster.

The scheduler of a Dask cluster sends parts to workers, and again if a worker is lost. A worker needs this package and,
for a robot that is a file, that file at the same path. It receives plain text and returns rows; it writes nothing.
Parts are submitted as earlier ones return, so that a long sweep takes no more memory than a short one, on either side.
"""

import asyncio
import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from closedloop.base.errors import ClusterError, OutputError, ScenarioError, missing_line
from closedloop.record.columns.record import ALL_COLUMNS
from closedloop.scenario.load import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import import_law
from closedloop.simulation.batch.simulate_batch import kept_columns, threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.batch.worker import Worker
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.law_source import law_digest
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.simulate import check_engine
from closedloop.studies.identity import identity_of, members
from closedloop.studies.sweep.design import GRID, LATIN, Design
from closedloop.studies.sweep.join import Joined, already_there, join
from closedloop.studies.sweep.store import (
    Job,
    OccupiedError,
    Store,
    columns_of,
    run_part,
    run_part_anywhere,
    tidy,
    worker_for,
)
from robot_models.cached import cached_property

# Runs in a part: enough that writing it costs little, few enough that a kill loses little and all cores have work to
# the end. It depends on the sweep only, so that the parts are the same whoever makes them.
MOST_IN_PART, PARTS = 256, 128


# Numbers of whole columns in a part, 32 MB.
MOST_KEPT = 4_000_000


@dataclass(frozen=True)
class Sweep:
    """A sweep: everything that its table depends on."""

    scenario: Scenario  # what the runs have in common
    design: Design  # the keys that change, and their values
    # full names of the columns to keep whole, see `closedloop.simulation.batch.simulate_batch.kept_columns`
    keep: tuple[str, ...] = ()
    engine: str = COMPILED  # see `closedloop.simulate`
    # law, law_digest: see `closedloop.studies.sweep.store.Job`
    law: str = ""
    law_digest: str = ""

    @classmethod
    def of(
        cls, scenario: Scenario, design: Design, keep: Iterable[str] = (), engine: str = COMPILED, law: str = ""
    ) -> "Sweep":
        """Return a sweep that can begin; `law` is MODULE:FUNCTION, imported here, or "" for the scenario's own.

        Raises ScenarioError or ModelError if a key is unknown, the engine does not cover the scenario, there is no such
            column to keep, or the robot is at fault.
        """
        own = import_law(law) if law else None
        sweep = cls(scenario, design, kept_columns(keep), engine, law, law_digest(own) if law else "")
        check_engine(Variants(scenario, design.keys).look(design), engine, own)
        for name in sweep.keep:
            if "joint" in ALL_COLUMNS[name].dims and any(key.startswith("robot.") for key in design.keys):
                raise ScenarioError(
                    f"keep: {name} has a number a joint, and the robot changes from run to run; keep other columns"
                )
        return sweep

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What the table depends on, as JSON has it."""
        design = self.design
        identity = identity_of(self.scenario, self._changes, self.engine)
        if design.kind == LATIN:
            identity["versions"]["scipy"] = version("scipy")
        return identity | {
            "design": design.kind,
            "axes": {axis.key: axis.spec for axis in design.axes},
            "runs": design.runs,
            "seed": design.seed if design.kind != GRID else None,
            "keep": list(self.keep),
            **({"law": self.law, "law_digest": self.law_digest} if self.law else {}),
        }

    @property
    def job(self) -> Job:
        """What a worker needs to run any part."""
        kinds = tuple(axis.kind for axis in self.design.axes)
        return Job(
            self.scenario.to_toml(), self.design.keys, kinds, self.engine, self.keep, self.design.runs, self._members,
            self.law, self.law_digest,
        )  # fmt: skip

    @cached_property
    def part_size(self) -> int:
        """Runs in a part."""
        size = min(MOST_IN_PART, math.ceil(self.design.runs / PARTS))
        if self.keep:
            rows = self.scenario.time.duration / self.scenario.time.step + 1.0
            size = min(size, max(1, int(MOST_KEPT / (rows * 3 * len(self.keep)))))
        return size

    @property
    def parts(self) -> int:
        """How many parts there are."""
        return math.ceil(self.design.runs / self.part_size)

    def runs_of(self, part: int) -> range:
        """Return the numbers of a part's runs."""
        first = part * self.part_size
        return range(first, min(first + self.part_size, self.design.runs))

    @cached_property
    def _changes(self) -> dict[str, Any]:
        """The values of the keys that change."""
        return {axis.key: axis.values for axis in self.design.axes}

    @cached_property
    def _members(self) -> tuple[tuple[str, str], ...]:
        return members(self.scenario, self._changes)


def run_sweep(
    sweep: Sweep, out: str | Path, *, workers: int | None = None, scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None, overwrite: bool = False,
) -> Joined:  # fmt: skip
    """Run what is not yet there of a sweep, and join its parts into the table.

    `out`: the table, a Parquet file; whole columns go into a NetCDF file of the same name beside it, parts into a
        folder until all are there.
    `workers`: threads; as many as there are cores if left out.
    `scheduler`: address of a Dask scheduler, ``tcp://host:port``, whose workers run the parts instead.
    `progress`: gets (runs done, runs in all).
    `overwrite`: whether a file there that is not this sweep's is replaced once this one is done; its parts go at once.
    Raises OutputError if `out` cannot be written, or is there already and not this sweep's.
    Raises ClusterError if the scheduler does not answer, or is lost on the way; what was done is kept.
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


# A scheduler that is there answers at once, s.
PATIENCE = 5.0
# Parts submitted for each thread of the cluster: one running and one waiting.
AHEAD = 2


def run_on_cluster(
    sweep: Sweep, store: Store, missing: Sequence[int], address: str, finished: Callable[[int], None],
    report: Callable[[], None],
) -> None:  # fmt: skip
    """Run the missing parts of a sweep and write them.

    `finished`: gets how many runs have come back.
    `report`: shows how far it is.
    Raises ScenarioError if Dask is not installed, or there is no scheduler at this address.
    Raises ClusterError if the cluster is lost on the way, or a part killed too many workers; what was written stays.
    """
    try:
        import distributed as dask_distributed

        distributed: Any = dask_distributed  # annotated in parts only
    except ImportError:
        raise ScenarioError(missing_line("--scheduler: a cluster needs", "Dask", "cluster")) from None
    client = _client(distributed, address)
    job, parts, numbers = sweep.job, iter(missing), dict[str, int]()
    try:

        def submit() -> Iterator[Any]:
            threads = sum(client.nthreads().values())  # workers come and go
            for part in itertools.islice(parts, max(AHEAD * threads - len(numbers), not numbers)):
                runs = sweep.runs_of(part)
                points = sweep.design[runs.start : runs.stop]
                future = client.submit(run_part_anywhere, job, runs.start, points, pure=False)
                numbers[future.key] = part
                yield future

        under_way = distributed.as_completed(list(submit()), loop=client.loop)
        for future in under_way:
            part = numbers.pop(future.key)
            store.write(part, *future.result())
            finished(len(sweep.runs_of(part)))
            future.release()
            report()
            under_way.update(list(submit()))
    except OutputError:
        raise
    except distributed.KilledWorker as error:
        raise ClusterError(f"--scheduler {address}: {error}; what was done is kept: the same command goes on") from None
    except (OSError, TimeoutError, distributed.CancelledError) as error:
        raise ClusterError(
            f"--scheduler {address}: the cluster was lost ({type(error).__name__}); what was done is kept: the same "
            "command goes on with it"
        ) from None
    finally:
        client.close(timeout=PATIENCE)


def _client(distributed: Any, address: str) -> Any:
    for name in ("distributed.core", "distributed.client", "distributed.comm", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong is said in one line
    try:
        # In a thread, for there may be a loop here already (a notebook). A client by itself would wait for ever for
        # something that listens and says nothing.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(asyncio.run, _shake_hands(distributed, address)).result()
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = str(error).splitlines()[0] if isinstance(error, ValueError) else f"no answer within {PATIENCE:g} s"
        raise ScenarioError(
            f"--scheduler {address}: {reason}; must be the address of a Dask scheduler, such as tcp://127.0.0.1:8786"
        ) from None
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except (OSError, TimeoutError):
        client.close(timeout=PATIENCE)
        raise ScenarioError(f"--scheduler {address}: has no workers; start some: dask worker {address}") from None
    return client


async def _shake_hands(distributed: Any, address: str) -> None:
    arguments = distributed.Security().get_connection_args("client")
    comm = await asyncio.wait_for(distributed.core.connect(address, timeout=PATIENCE, **arguments), PATIENCE)
    await comm.close()
