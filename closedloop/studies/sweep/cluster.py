"""The parts of a sweep on a Dask cluster: its scheduler sends them to workers, and again if a worker is lost.

A worker needs this package and, for a robot that is a file, that file at the same path. It receives plain text and
returns rows; it writes nothing. Parts are submitted as earlier ones return, so that a long sweep takes no more memory
than a short one, on either side.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from closedloop.base.errors import ClusterError, OutputError, ScenarioError
from closedloop.base.optional import missing_line
from closedloop.studies.sweep.store import Store, run_part_anywhere

if TYPE_CHECKING:
    from closedloop.studies.sweep.sweep import Sweep

# A scheduler that is there answers at once, s.
PATIENCE = 5.0
# Parts submitted for each thread of the cluster: one running and one waiting.
AHEAD = 2


def run_on_cluster(
    sweep: Sweep, store: Store, missing: Sequence[int], address: str, finished: Callable[[int], None],
    report: Callable[[], None],
) -> None:  # fmt: skip
    """Run the missing parts of a sweep and write them.

    Parameters
    ----------
    finished : callable
        Gets how many runs have come back.
    report : callable
        Shows how far it is.

    Raises
    ------
    ScenarioError
        If Dask is not installed, or there is no scheduler at this address.
    ClusterError
        If the cluster is lost on the way, or a part killed too many workers; what was written stays.
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
