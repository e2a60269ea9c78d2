"""Compile everything that ships, at once: ``closedloop compile``, for images and clusters."""

from __future__ import annotations

import argparse
import logging
import signal
import time as clock
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from functools import partial
from multiprocessing import active_children, get_context

from closedloop.base.errors import ScenarioError
from closedloop.base.second_process import cores
from closedloop.command.border import DONE, Parser, as_command
from closedloop.command.pieces import Piece, pieces
from closedloop.jit.background import notices, seconds_of_name

MOST_WORKERS = 8  # more would wait for what is compiled one after the other


@as_command()
def main(arguments: list[str]) -> int:
    """Compile everything, with a line for each piece, and return the exit status."""
    from closedloop.jit.cache_folder import cache_folder, why_not_kept
    from closedloop.jit.kernel import jit_disabled

    parser = Parser(
        prog="closedloop compile",
        description="Compile everything that ships, so that no later run has to, and say where it\nis kept.",
        epilog="exit status: 0 done; 2 nothing can be kept, or NUMBA_DISABLE_JIT is set;\n130 interrupted",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help=f"processes (default: one for each core, at most {MOST_WORKERS})"
    )
    workers = parser.parse_args(arguments).workers
    if workers is not None and not 1 <= workers <= MOST_WORKERS:
        raise ScenarioError(f"--workers {workers}: must be at least 1, and at most {MOST_WORKERS}")
    if jit_disabled():
        raise ScenarioError("NUMBA_DISABLE_JIT is set: there is nothing to compile")
    if reason := why_not_kept():
        raise ScenarioError(f"compiled code cannot be kept: {reason}")
    began, processor_time, everything = clock.perf_counter(), 0.0, pieces()
    width = max(len(piece.what) for piece in everything)
    for what, wall, own in _compiled(everything, workers or min(cores(), MOST_WORKERS)):
        processor_time += own
        print(f"{what:{width}}  {wall:6.1f} s  ({own:.1f} s of processor time)", flush=True)
    wall = clock.perf_counter() - began
    print(f"{'together':{width}}  {wall:6.1f} s  ({processor_time:.1f} s of processor time); kept in {cache_folder()}")
    return DONE


def _compiled(everything: Sequence[Piece], workers: int) -> Iterator[tuple[str, float, float]]:
    """Compile everything in so many processes; yield what is done, and its time and processor time, s."""
    # What others come after is begun first, and then what takes longest.
    waiting = dict(enumerate(everything))
    order = sorted(waiting, key=lambda i: (not waiting[i].after, -seconds_of_name(waiting[i].kernel)))
    there: set[str] = set()
    running: dict[Future[tuple[float, float]], tuple[Piece, int]] = {}
    families: list[set[str]] = [set() for _ in range(workers)]  # of what each process has compiled
    with ExitStack() as stack:
        # Fresh processes: in a copy of this one the locks of libraries' threads could be taken.
        pools = [
            stack.enter_context(ProcessPoolExecutor(1, get_context("spawn"), _ignore_ctrl_c)) for _ in range(workers)
        ]
        try:
            while waiting or running:
                for at in set(range(workers)) - {at for _, at in running.values()}:
                    ready = [i for i in order if i in waiting and waiting[i].after in {"", *there}]
                    if ready:
                        i = min(ready, key=partial(_strangeness, waiting, families, at))
                        families[at].add(waiting[i].family)
                        running[pools[at].submit(_compile_piece, i)] = waiting.pop(i), at
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    piece, _ = running.pop(done)
                    there.add(piece.kernel)
                    yield piece.what, *done.result()
        except BrokenProcessPool:
            raise ScenarioError(
                "a process that compiles was ended from outside, perhaps as memory is short; try --workers 1"
            ) from None
        except BaseException:
            for process in active_children():
                process.terminate()
            raise


def _strangeness(waiting: dict[int, Piece], families: list[set[str]], at: int, i: int) -> int:
    """Return 0 for a piece that shares functions with what a process has compiled, 2 if another has such, else 1."""
    family = waiting[i].family
    return 0 if family in families[at] else 1 + any(family in each for each in families)


def _ignore_ctrl_c() -> None:
    """Leave Ctrl-C to the process that waits, which ends this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _compile_piece(i: int) -> tuple[float, float]:
    """Compile one of `pieces`, and return the time and the processor time, s, that it took."""
    notices.setLevel(logging.WARNING)  # a line for each piece says it already
    began, busy = clock.perf_counter(), clock.process_time()
    pieces()[i].compile()
    return clock.perf_counter() - began, clock.process_time() - busy
