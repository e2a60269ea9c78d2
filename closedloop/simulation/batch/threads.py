"""Threads that share work, and that an interruption can end.

Python handles signals (Ctrl-C) in the main thread only. So the main thread only waits here: no library call, such as
writing a file, is interrupted, and Ctrl-C is handled at once.
"""

import itertools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

from closedloop.base.interrupts import held_back

T = TypeVar("T")

# Threads have so long to end when one of them has failed or the main thread is interrupted, s: a run that takes longer
# is left behind, and what it comes to is dropped.
GRACE = 5.0
# Threads with other names, as those of a lab, end with the interpreter.
NAME = "closedloop-runs"


class Ended(BaseException):
    """Raised in a thread whose work is no longer needed. Not an `Exception`, so that no run catches it."""


class Done:
    """The count of runs done, to which threads add, and the flag that tells them to end."""

    def __init__(self, count: int = 0) -> None:
        self.count, self._lock, self._ended = count, threading.Lock(), threading.Event()

    def add(self, runs: int = 1) -> None:
        """Add to the count."""
        self.check()
        with self._lock:
            self.count += runs

    def end(self) -> None:
        """Let every thread end that adds to the count from now on."""
        self._ended.set()

    def check(self) -> None:
        """Raise `Ended` if no more runs are needed."""
        if self._ended.is_set():
            raise Ended


def side_by_side(
    one: Callable[[T, int], None], count: int, threads: int, own: Callable[[], T], report: Callable[[], None],
    done: Done,
) -> None:  # fmt: skip
    """Call ``one(own(), i)`` for every i below `count`, in threads with an own each; the first error ends it all.

    `report` is called before, now and then, and after; `done` is told to end whatever happens, and what `one` adds to
    it ends its thread then.
    """
    numbers, lock = itertools.count(), threading.Lock()

    def mine() -> Iterator[int]:
        while True:
            done.check()
            with lock:
                i = next(numbers)
            if i >= count:
                return
            yield i

    def work() -> None:
        done.check()
        mine_alone = own()
        for i in mine():
            one(mine_alone, i)

    report()
    pool, running = ThreadPoolExecutor(min(threads, count), NAME), set[Future[None]]()
    try:
        with held_back():  # what has begun is known, and can be ended
            running.update(pool.submit(work) for _ in range(min(threads, count)))
        while running:
            over, running = wait(running, timeout=0.1, return_when=FIRST_COMPLETED)
            for future in over:
                future.result()
            report()
    finally:
        _end(pool, running, done)
    report()


def uninterrupted(work: Callable[[Done], T]) -> T:
    """Return ``work(done)``, done in a thread of its own, which no signal interrupts.

    An interruption makes ``done.check()`` raise there, and is raised here once that has ended it.
    """
    pool, done, running = ThreadPoolExecutor(1, NAME), Done(), set[Future[T]]()
    try:
        with held_back():  # as above
            running.add(future := pool.submit(work, done))
        while not future.done():
            wait(running, timeout=0.1)
        return future.result()
    finally:
        _end(pool, running, done)


def still_at_work() -> bool:
    """Whether an abandoned thread is still running: the interpreter would wait for it before it ends."""
    return any(thread.name.startswith(NAME) for thread in threading.enumerate())


def _end(pool: ThreadPoolExecutor, running: set[Future[T]], done: Done) -> None:
    done.end()
    pool.shutdown(wait=False)
    if not wait(running, timeout=GRACE).not_done:
        pool.shutdown()  # no thread is left that a second process would not have
