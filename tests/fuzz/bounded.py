"""Cases judged one after the other in a process of their own, each within a bound on processor time and memory.

A case that uses more processor time than `MOST_SECONDS` ends its process (the kernel sends SIGPROF, for which nothing
is installed), whatever library it hangs in; so does one that sleeps for `LONGEST`. Another process then goes on.
"""

import multiprocessing
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

MOST_SECONDS = 10.0  # of processor time a case
LONGEST = 120.0  # of wall time a case, for one that sleeps; on a busy machine far more than MOST_SECONDS
MOST_MEMORY = 3 << 30  # bytes of address space beyond those of a process that has done the first case

Judge = Callable[[Any], tuple[str, str]]


def judged(
    cases: Sequence[Any],
    judge: Judge,
    faulty: str,
    first: Sequence[Any] = (),
    seconds: float = float("inf"),
    most: float = MOST_SECONDS,
) -> Iterator[tuple[Any, str, str, float]]:
    """Return (case, outcome, words, processor seconds) of each case, in order.

    Parameters
    ----------
    cases : sequence
    judge : callable
        Case -> (outcome, words); importable.
    faulty : str
        The outcome of a case that ends its process or has to be ended.
    first : sequence
        Cases that each process does before, without bounds: what they compile is no part of any case.
    seconds : float
        No further case is begun once the cases have used so much processor time.
    most : float
        The processor time that one case may use, s.
    """
    context = multiprocessing.get_context("spawn")
    used, at = 0.0, 0
    while at < len(cases) and used < seconds:
        ours, theirs = context.Pipe()
        worker = context.Process(target=_work, args=(theirs, judge, list(first), most), daemon=True)
        worker.start()
        theirs.close()
        try:
            ours.recv()
        except EOFError:
            worker.join()
            raise RuntimeError(f"the first cases are not clean by themselves: {worker.exitcode}") from None
        try:
            while at < len(cases) and used < seconds:
                began = time.monotonic()
                ours.send(cases[at])
                if not ours.poll(LONGEST):
                    raise TimeoutError
                outcome, words, spent = ours.recv()
                used += spent
                at += 1
                yield cases[at - 1], outcome, words, spent
        except (EOFError, ConnectionError, TimeoutError) as error:
            worker.kill()
            worker.join()
            if at >= len(cases):
                raise
            spent = time.monotonic() - began
            used += min(spent, most)
            at += 1
            why = "more processor time than allowed" if worker.exitcode == -signal.SIGPROF else f"{worker.exitcode}"
            why = f"more than {LONGEST:g} s, whatever it waited for" if isinstance(error, TimeoutError) else why
            yield cases[at - 1], faulty, f"ended its process: {why}", spent
        finally:
            ours.close()
            worker.kill()
            worker.join()


def _work(connection: Connection, judge: Judge, first: list[Any], most: float) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())  # what libraries say there is not in a case's words
    for case in first:
        outcome, words = judge(case)
        if outcome == "FAULTY":
            raise AssertionError(words)
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + MOST_MEMORY,) * 2)
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    connection.send("ready")
    while True:
        try:
            case = connection.recv()
        except EOFError:
            return
        began = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, most)
        outcome, words = judge(case)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        connection.send((outcome, words, time.process_time() - began))


def _address_space() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()
