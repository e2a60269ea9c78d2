"""A sweep: what it varies, its axes, a grid, draws; and how it is run, whole, resumed, or in parts on a cluster.

The scheduler of a Dask cluster sends parts to workers, and again if a worker is lost. A worker needs this package and,
for a robot that is a file, that file at the same path. It receives plain text and returns rows; it writes nothing.
Parts are submitted as earlier ones return, so that a long sweep takes no more memory than a short one, on either side.
"""

import asyncio
import itertools
import logging
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import number_at, number_of
from closedloop.base.errors import ClusterError, OutputError, ScenarioError, missing_line
from closedloop.record.columns.record import ALL_COLUMNS
from closedloop.record.save import identity_of, members
from closedloop.scenario.load import Variants, toml_value
from closedloop.scenario.messages import takes_whole_numbers
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import import_law
from closedloop.simulation.batch.simulate_batch import kept_columns, key_type, threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.batch.worker import Worker
from closedloop.simulation.engines.law_source import law_digest
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.parts import Cache
from closedloop.simulation.simulate import check_engine
from closedloop.studies.sweep import store
from closedloop.studies.sweep.store import Job, Joined
from robot_models.cached import cached_property

FORMS = "5:15:11 (from, to, how many), log:1e-4:1e-2:20, or 5,10,15"
# Values of one axis.
MOST_VALUES = 1_000_000_000
LARGEST_WHOLE = 2**53
_KEY = re.compile(r"[A-Za-z_][\w-]*(\.[^.=]+)+")


@dataclass(frozen=True)
class Axis:
    """A key and its values: those of a list, or a range."""

    key: str  # dotted key of the scenario
    spec: str  # how it was given
    values: tuple[Any, ...] = ()  # the values of a list; of a range none
    # low, high: ends of a range
    low: float = 0.0
    high: float = 0.0
    count: int = 0  # how many values a range has in a grid; 0 if that was not said
    log: bool = False  # whether a range is even in its logarithm
    whole: bool = False  # whether the key takes whole numbers only

    def __len__(self) -> int:
        """Return how many values it has in a grid."""
        return len(self.values) or self.count

    @property
    def kind(self) -> str:
        """Type of the key's column in the table, in Arrow's words."""
        return str(key_type(self.values)) if self.values else "int64" if self.whole else "double"

    def at(self, index: int) -> Any:
        """Return value `index` of a grid."""
        if self.values:
            return self.values[index]
        return self._between(index / (self.count - 1), exact_end=index == self.count - 1)

    def drawn(self, share: float) -> Any:
        """Return the value at `share`, from 0 to below 1, of the way along the axis."""
        if self.values:
            return self.values[int(share * len(self.values))]
        if self.whole:
            low, high = sorted((self.low, self.high))
            return int(low + math.floor(share * (high - low + 1)))
        return self._between(share)

    def _between(self, share: float, exact_end: bool = False) -> float | int:
        if share == 0.0 or exact_end:
            value = self.high if exact_end else self.low
        else:
            value = number_at(self.low, self.high, self.log, share)
        return round(value) if self.whole else value


def parse_axis(text: str, drawn: bool = False) -> Axis:
    """Read an axis from KEY=VALUES.

    `text`: ``law.force=5:15:11``, ``stabiliser.time_constant=log:1e-4:1e-2:20``,
        ``time.integrator=rk4,explicit_euler``.
    `drawn`: whether values are drawn from the range, so that how many there are need not be said.
    """
    if not text.isprintable():
        raise ScenarioError(f"--over {text}: has characters that cannot be printed")
    key, equals, spec = text.partition("=")
    key, spec = key.strip(), spec.strip()
    if not (equals and _KEY.fullmatch(key)):
        raise ScenarioError(f"--over {text}: must be KEY=VALUES with a key such as law.force; VALUES are {FORMS}")
    if not spec.strip(", "):
        raise ScenarioError(f"--over {text}: has no values; they are {FORMS}")
    parts = spec.split(":")
    log = parts[0] == "log"
    numbers = [number_of(part) for part in parts[log:]]
    if len(parts) > 1 and None not in numbers:
        return _range(text, key, spec, [x for x in numbers if x is not None], log, drawn)
    if log or (len(parts) in (3, 4) and not spec.startswith(("[", '"', "'"))):
        raise ScenarioError(f"--over {text}: not a range of numbers; it must look like {FORMS}")
    values, whole = _listed(spec, text), takes_whole_numbers(key)
    if not whole and all(type(value) in (int, float) for value in values):
        values = tuple(float(value) for value in values)
    if len({repr(value) for value in values}) < len(values):
        raise ScenarioError(f"--over {text}: the same value twice")
    return Axis(key, spec, values, whole=whole)


def parse_range(text: str, such: str) -> Axis:
    """Read what varies within a range of real numbers, KEY=LOW:HIGH or KEY=log:LOW:HIGH; its ends in order."""
    try:
        axis = parse_axis(text, drawn=True)
    except ScenarioError as error:
        raise ScenarioError(str(error).replace("--over", "--vary", 1)) from None
    if axis.values or axis.whole:
        raise ScenarioError(f"--vary {text}: must be a range of real numbers, such as {axis.key}={such}")
    low, high = sorted((axis.low, axis.high))
    return replace(axis, low=low, high=high)


def _range(text: str, key: str, spec: str, numbers: list[float], log: bool, drawn: bool) -> Axis:
    if len(numbers) == 2 and not drawn:
        raise ScenarioError(
            f"--over {text}: how many values? such as {spec}:11; or draw from the range with --random or --latin"
        )
    if len(numbers) not in (2, 3):
        raise ScenarioError(f"--over {text}: a range has two ends and how many values it has, such as 5:15:11")
    low, high = numbers[:2]
    count = numbers[2] if len(numbers) == 3 else 0.0
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ScenarioError(f"--over {text}: both ends must be finite")
    if not math.isfinite(high - low):
        raise ScenarioError(f"--over {text}: is wider than a double can hold, 1.8e308")
    if low == high:
        raise ScenarioError(
            f"--over {text}: is empty: it ends where it begins; a single value is written {key}={low:g}"
        )
    if len(numbers) == 3 and not (2 <= count <= MOST_VALUES and count == math.floor(count)):
        raise ScenarioError(
            f"--over {text}: {spec.rpartition(':')[2]} values: must be a whole number from 2 on, up to {MOST_VALUES}"
        )
    if log and not (low > 0.0 and high > 0.0):
        raise ScenarioError(f"--over {text}: both ends of a logarithmic range must be above 0")
    if log and not 0.0 < high / low < math.inf:
        raise ScenarioError(f"--over {text}: is wider than a double can hold: the ratio of its ends is beyond 1e308")
    whole = takes_whole_numbers(key)
    axis = Axis(key, spec, (), low, high, int(count), log, whole)
    if whole and max(abs(low), abs(high)) > LARGEST_WHOLE:
        raise ScenarioError(f"--over {text}: whole numbers of a range may go to 2^53, which a double holds exactly")
    if whole and (log or low % 1 or high % 1 or (not drawn and (high - low) / (count - 1) % 1)):
        raise ScenarioError(f"--over {text}: {key} takes whole numbers only; name them, such as {key}=0,1,2")
    return axis


def _listed(spec: str, text: str) -> tuple[Any, ...]:
    """Read a list: as TOML where it is that, else word by word, so that names need no quotes."""
    try:
        found = tomllib.loads(f"values = [{spec}]")
        if len(found) == 1:
            return tuple(found["values"])
    except (ValueError, RecursionError):
        pass
    words = [word.strip() for word in spec.split(",")]
    if any(words) and not all(words[:-1]):  # one comma more at the end is none
        raise ScenarioError(f"--over {text}: has a comma too many: a value is missing")
    return tuple(toml_value(word) for word in words if word)


GRID, RANDOM, LATIN = "grid", "random", "latin"

# Random numbers are drawn in blocks, each with a generator of its own: run i needs its block, and no other.
BLOCK = 1024
MOST_RUNS = 100_000_000
# A Latin hypercube is a permutation of all runs on each axis, and is held whole.
MOST_LATIN = 1_000_000


class Design(Sequence[tuple[Any, ...]]):
    """The values of the axes' keys for every run.

    `kind`: every value with every other, the last axis fastest; independent draws, even along each axis; or draws of
        which each axis has exactly one in each of `count` equal intervals (McKay, Beckman and Conover 1979).
    `count`: number of draws.
    `seed`: of the draws.
    """

    def __init__(self, axes: Sequence[Axis], kind: str = GRID, count: int = 0, seed: int = 0) -> None:
        if not axes:
            raise ScenarioError("--over: name at least one key and its values, such as --over law.force=5:15:11")
        keys = [axis.key for axis in axes]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise ScenarioError(f"--over {twice[0]}: comes twice")
        if kind == GRID:
            count = math.prod(len(axis) for axis in axes)
        elif count < 1:
            raise ScenarioError(f"--{kind} {count}: must be at least 1")
        if seed < 0:
            raise ScenarioError(f"--seed {seed}: must be 0 or above")
        most = MOST_LATIN if kind == LATIN else MOST_RUNS
        if count > most:
            raise ScenarioError(f"{count} runs: a {kind} sweep may have {most}; take fewer values")
        self.axes, self.kind, self.runs, self.seed = tuple(axes), kind, count, seed
        self._block = lru_cache(maxsize=4)(self._draw)

    @property
    def keys(self) -> tuple[str, ...]:
        """The changed keys."""
        return tuple(axis.key for axis in self.axes)

    def __len__(self) -> int:
        return self.runs

    @overload
    def __getitem__(self, at: int) -> tuple[Any, ...]: ...
    @overload
    def __getitem__(self, at: slice) -> list[tuple[Any, ...]]: ...
    def __getitem__(self, at: int | slice) -> tuple[Any, ...] | list[tuple[Any, ...]]:
        if isinstance(at, slice):
            return [self[i] for i in range(*at.indices(self.runs))]
        if not 0 <= at < self.runs:
            raise IndexError(at)
        if self.kind == GRID:
            places = []
            for axis in reversed(self.axes):
                at, place = divmod(at, len(axis))
                places.append(place)
            return tuple(axis.at(place) for axis, place in zip(self.axes, reversed(places), strict=True))
        shares = self._latin[at] if self.kind == LATIN else self._block(at // BLOCK)[at % BLOCK]
        return tuple(axis.drawn(share) for axis, share in zip(self.axes, shares.tolist(), strict=True))

    def _draw(self, block: int) -> NDArray[np.float64]:
        return np.random.default_rng([self.seed, block]).random((BLOCK, len(self.axes)))

    @cached_property
    def _latin(self) -> NDArray[np.float64]:
        from scipy.stats import qmc

        # Its numbers are from (0, 1]: the end belongs to the last value.
        generator = np.random.default_rng(self.seed)
        drawn = qmc.LatinHypercube(len(self.axes), rng=generator).random(self.runs)
        return np.asarray(np.minimum(drawn, math.nextafter(1.0, 0.0)))


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
            self.scenario.to_toml(), self.design.keys, kinds, self.engine, self.keep, self.design.runs,
            members(self.scenario, self._changes), self.law, self.law_digest,
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
        store.tidy(sweep.identity, out)
        return there
    try:
        with store.Store(sweep.identity, out, overwrite) as kept:
            there = _already_there(sweep, out, overwrite)  # since, by another process
            if there is not None:
                kept.remove()
                return there
            missing = [part for part in range(sweep.parts) if not kept.has(part, sweep.runs_of(part))]
            done = Done(sweep.design.runs - sum(len(sweep.runs_of(part)) for part in missing))

            def report() -> None:
                if progress is not None:
                    progress(done.count, sweep.design.runs)

            report()
            if missing and scheduler is not None:
                run_on_cluster(sweep, kept, missing, scheduler, done.add, report)
            elif missing:
                job, shared = sweep.job, Cache()

                def one(worker: Worker, at: int) -> None:
                    runs = sweep.runs_of(missing[at])
                    points = sweep.design[runs.start : runs.stop]
                    kept.write(missing[at], store.run_part(job, runs.start, points, worker, done.add))

                side_by_side(one, len(missing), threads, lambda: store.worker_for(job, shared), report, done)
            return store.join(kept, out, sweep.parts, store.columns_of(sweep.job), sweep.scenario.time.step)
    except KeyboardInterrupt:
        with suppress(OutputError):
            there = store.already_there(sweep.identity, out)
            if there is not None:  # it came too late: the table is whole
                store.tidy(sweep.identity, out)
                return there
        raise


def _already_there(sweep: Sweep, out: Path, overwrite: bool) -> Joined | None:
    try:
        return store.already_there(sweep.identity, out)
    except store.OccupiedError:
        if overwrite:
            return None
        raise


# A scheduler that is there answers at once, s.
PATIENCE = 5.0
# Parts submitted for each thread of the cluster: one running and one waiting.
AHEAD = 2


def run_on_cluster(
    sweep: Sweep, kept: store.Store, missing: Sequence[int], address: str, finished: Callable[[int], None],
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
                future = client.submit(store.run_part_anywhere, job, runs.start, points, pure=False)
                numbers[future.key] = part
                yield future

        under_way = distributed.as_completed(list(submit()), loop=client.loop)
        for future in under_way:
            part = numbers.pop(future.key)
            kept.write(part, future.result())
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
