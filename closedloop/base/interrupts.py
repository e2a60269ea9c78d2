"""Ctrl-C and SIGTERM: as exceptions, or deferred while something is being finished."""

import _signal  # type: ignore[import-not-found]  # what `signal` is made of
import gc
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

# Exit statuses, as a shell gives them to what such a signal ended.
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Terminated(KeyboardInterrupt):
    """SIGTERM: a user or a batch system ends the program."""


def leave_quietly() -> None:
    """Let Ctrl-C end this process at once and without a word, where it would print a traceback.

    For a command that has done nothing yet but to import, or that has done all; see `as_exceptions`.
    """
    here = threading.current_thread() is threading.main_thread()
    if here and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)


# Each Ctrl-C within `as_exceptions`: a library that is being imported may turn what is raised into something else.
_came: list[int] = []


def _raise(number: int, frame: FrameType | None) -> None:
    _came.append(number)
    if not _comes_again(number, frame):
        signal.default_int_handler(number, frame)


@contextmanager
def _handled(number: int, usual: Any, handler: Any) -> Iterator[None]:
    """Let a signal have another handler meanwhile, if it has the usual one."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(number) is not usual:
        yield
        return
    signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, usual)


@contextmanager
def as_exceptions() -> Iterator[list[int]]:
    """Let Ctrl-C raise KeyboardInterrupt again meanwhile, after `leave_quietly`; yield a list of those that came."""
    _came.clear()
    with _handled(signal.SIGINT, _leave, _raise):
        yield _came


def exit_status(interruption: BaseException) -> int:
    """Return the exit status for what Ctrl-C or SIGTERM raised, itself or as the cause."""
    causes = (interruption, interruption.__cause__)
    return TERMINATED if any(isinstance(error, Terminated) for error in causes) else INTERRUPTED


def word_for(interruption: BaseException) -> str:
    """Return what happened, in one word."""
    return "terminated" if exit_status(interruption) == TERMINATED else "interrupted"


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM raise `Terminated`, unless it has a handler already."""
    with _handled(signal.SIGTERM, signal.SIG_DFL, _terminate):
        yield


def _terminate(number: int, frame: FrameType | None) -> None:
    if not _comes_again(number, frame):
        raise Terminated


# How long a signal waits for a place where it can be answered, s, and how often it is tried: an import takes no longer,
# but for a user's module that works while it is imported.
PATIENCE, RETRY = 3.0, 0.05
_since: dict[int, float] = {}


def _comes_again(number: int, frame: FrameType | None) -> bool:
    """Whether a signal is sent again a little later, as what its handler raises now may be lost.

    Callbacks of Python's imports, and libraries that are being imported, drop what is raised in them.
    """
    now = time.monotonic()
    if not _cannot_raise(frame, "importlib") or now - _since.setdefault(number, now) > PATIENCE:
        _since.pop(number, None)
        return False
    again = threading.Timer(RETRY, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()
    return True


class held_back:  # a context, as those beside it
    """Let the first Ctrl-C or SIGTERM wait until the block is done, and then act; a second one does not wait.

    With `numbers`, those signals only. Each run has two such blocks: what the module `signal` is made of takes a sixth
    of its time.
    """

    __slots__ = ("_numbers", "_usual", "_waiting")

    def __init__(self, *numbers: signal.Signals) -> None:
        self._numbers = numbers or _SIGNALS
        self._waiting: tuple[int, FrameType | None] | None = None

    def _hold(self, number: int, frame: FrameType | None) -> None:
        if self._waiting is not None:
            self._usual[number](number, frame)
        self._waiting = self._waiting or (number, frame)

    def __enter__(self) -> None:
        self._usual: dict[int, Any] = {}
        if threading.get_ident() != threading.main_thread().ident:
            return  # exceptions of signals come in the main thread only
        for number in self._numbers:
            before = _signal.getsignal(number)
            if callable(before):  # not ignored, nor left to the system
                self._usual[number] = before
                _signal.signal(number, self._hold)

    def __exit__(self, *raised: object) -> None:
        for which, handler in self._usual.items():
            with suppress(ValueError, TypeError):
                _signal.signal(which, handler)
        if self._waiting is not None and raised[0] is None:
            self._usual[self._waiting[0]](*self._waiting)


# How long after a signal that could not be answered it is sent again, s.
AGAIN = 0.25


@contextmanager
def answered_where_it_can_be() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait while a compiler's library calls back, or an object is taken away.

    What a handler raises there Python prints and forgets, and the program goes on. The signal is sent again until it is
    answered, at the end of the block at the latest.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual: dict[int, Any] = {}
    waiting: dict[int, tuple[FrameType | None, threading.Timer]] = {}

    def answer(number: int, frame: FrameType | None) -> None:
        again = threading.Timer(AGAIN, os.kill, (os.getpid(), number))
        again.daemon = True
        waiting[number] = frame, again
        again.start()
        if not _cannot_raise(frame):
            usual[number](number, frame)

    for number in _SIGNALS:
        before = signal.getsignal(number)
        if callable(before):
            usual[number] = before
            signal.signal(number, answer)
    try:
        yield
    except KeyboardInterrupt:
        for _, again in waiting.values():
            again.cancel()
        waiting.clear()
        raise
    finally:
        for which, handler in usual.items():
            with suppress(ValueError, TypeError):
                signal.signal(which, handler)
        for _, again in waiting.values():
            again.cancel()
    for which, (frame, _) in waiting.items():
        usual[which](which, frame)


def _cannot_raise(frame: FrameType | None, *others: str) -> bool:
    """Whether no handler sees an exception raised in a frame, as a C library or the garbage collector called it.

    `others` are packages in whose calls it may be lost, beside those that do so always.
    """
    while frame is not None:
        module = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if module in ("llvmlite", "weakref", *others) or frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


@contextmanager
def compiler_at_work() -> Iterator[None]:
    """Let Ctrl-C wait until the block, which asks something of numba or LLVM, is done.

    A second Ctrl-C does not wait, nor does SIGTERM, after which nothing is compiled. No garbage is looked for
    meanwhile: a compiler's graphs are in use, and looking through them takes a tenth.

    Both take locks, numba for all of a compilation and LLVM for each call of its library. What a signal raises as one
    is taken or released would leave it taken, and the next thread that asks would wait for ever.
    """
    was = gc.isenabled()
    with answered_where_it_can_be(), held_back(signal.SIGINT):
        gc.disable()
        try:
            yield
        finally:
            if was:
                gc.enable()
