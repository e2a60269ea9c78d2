"""Work in a second process, while this one goes on: for what one command does on two cores.

The second process is a copy of this one (`fork`), so that it has all that was imported and read. Where there is no such
thing, or other threads are running, whose locks the copy would keep, the work is done here when its result is wanted.
"""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Generic, TypeVar

T = TypeVar("T")


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def possible() -> bool:
    """Whether a second process can be begun, and has a core of its own."""
    alone = threading.current_thread() is threading.main_thread() and threading.active_count() == 1
    daemon = multiprocessing.current_process().daemon  # which may have no children
    return sys.platform == "linux" and alone and not daemon and cores() > 1


class Beside(Generic[T]):
    """Work that is begun now in a second process, if that is possible.

    `work`: its result is pickled. What it prints and logs is dropped, and if it raises anything it is done again here.
    """

    def __init__(self, work: Callable[[], T]) -> None:
        self._work, self._process = work, None  # type: Callable[[], T], Any
        if possible():
            context = multiprocessing.get_context("fork")
            self._receive, send = context.Pipe(duplex=False)
            process = context.Process(target=_do, args=(work, send), daemon=True)
            with suppress(OSError), warnings.catch_warnings():  # no process or memory is left
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads: numpy's survive a fork
                process.start()
                self._process = process
            send.close()

    def result(self) -> T:
        """Wait for the result and return it."""
        if self._process is not None:
            try:
                done, answer = self._receive.recv()
            except (EOFError, OSError):  # it was killed
                done, answer = False, None
            self.stop()
            if done:
                return answer
        return self._work()

    def stop(self) -> None:
        """End the process: its result is not wanted any more."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._receive.close()
            self._process = None


def _do(work: Callable[[], Any], send: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all: the first process decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    logging.disable()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    sys.stdout = sys.stderr = open(nowhere, "w")  # noqa: SIM115  (a notebook has streams of its own)
    try:
        answer = True, work()
    except BaseException:
        answer = False, None
    send.send(answer)
