"""Compiling in a background process, while the run is interpreted.

The process has low priority, no terminal and no output, outlives the one that started it, and writes compiled code into
the cache's folder. There is at most one for each folder: it holds a lock on the folder's marker, inherited from the
process that started it and released when it ends. With ``CLOSEDLOOP_BACKGROUND_COMPILE=0`` there are no such processes:
code is compiled before it is run.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time as clock
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from closedloop.jit.cache_folder import MARKER, cache_folder, claim, why_not_kept
from closedloop.jit.kernel import jit_disabled, needs_compiling

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

VARIABLE = "CLOSEDLOOP_BACKGROUND_COMPILE"
# What is said about compiling, a line each: commands print it on standard error.
notices = logging.getLogger("closedloop.compiling")

NICE, LONGEST = 19, 900  # the priority: the lowest; s, after which the process is given up


class Long(NamedTuple):
    """What an entry kernel is that takes more than a few seconds to compile, and its processor time, about, s."""

    what: str
    seconds: float


# As `closedloop compile` prints them; the others are compiled in silence, in a second or two.
TAKES_LONG = {
    "proceed_at": Long("the step", 21.0),
    "run_in_lanes": Long("the step of eight runs at a time", 13.0),
    "contacts_in_step": Long("contacts of links", 15.0),
    "closed_loops": Long("loops and stops", 8.0),
    "proceed_at_dual8": Long("derivatives of the step", 22.0),
    "contacts_in_step_dual8": Long("derivatives of contacts of links", 17.0),
    "closed_loops_dual8": Long("derivatives of loops", 9.0),
    "walk": Long("the inverse kinematics of a path", 4.0),
    "along_path": Long("loops along a path", 5.0),
}
BRIEF = 1.5  # s, of the others
# How long `wait_until_done` waits at most, unless it is told otherwise, and between two looks, s.
PATIENCE, BETWEEN_LOOKS = 180.0, 0.1

# The first process started ends at once, so that nobody has to wait for the one that compiles. Linux shares a processor
# between sessions first, and the priority of a process counts in its own session only: the session's is lowered too.
_DETACHED = f"""
import os
if os.fork():
    os._exit(0)
os.nice({NICE})
try:
    with open("/proc/self/autogroup", "w") as group:
        group.write("{NICE}")
except OSError:
    pass
"""
_PROGRAM = f"""{_DETACHED}
import signal, sys
signal.alarm({LONGEST})
if sys.argv[1] not in sys.path:
    sys.path.insert(0, sys.argv[1])
from closedloop.command.pieces import compile_these
compile_these(sys.argv[2:])
"""

_lock = threading.Lock()
_asked: set[str] = set()  # names of what this process has had compiled in the background
_waited_for: set[str] = set()  # names of what this process has waited for
_said: set[str] = set()  # of what sort a line has been said already
_BEHIND, _WAITING, _HERE = "in the background", "waiting", "here"


def refused() -> str:
    """Return why no process may compile in the background; "" if one may."""
    if os.environ.get(VARIABLE, "").strip().lower() in ("0", "no", "off", "false"):
        return f"{VARIABLE} refuses it"
    if jit_disabled():
        return "NUMBA_DISABLE_JIT is set"
    if fcntl is None or not hasattr(os, "fork"):
        return "this system has no locks that end with their process"
    if not Path(sys.executable or "").name.startswith("python"):
        return "Python is part of another program"
    return ""


# Whether another process sees to it, such as the one that this is a copy of.
left_to_another = False


def start(functions: Sequence[Callable[..., Any]], quietly: bool = False) -> None:
    """Start a process that compiles entry kernels, unless one is running or these were requested before.

    A line says so where that takes long, unless `quietly`.
    """
    with _lock:
        names = [function.__name__ for function in functions if function.__name__ not in _asked]
        if not names or left_to_another or refused():
            return
        if reason := why_not_kept():
            _say(_BEHIND, f"compiling {_named(names)} would take longer than this run, and cannot be kept: {reason}")
            return
        lock = _take_lock()
        loud = not quietly and not TAKES_LONG.keys().isdisjoint(names)
        if lock is None:
            if loud:
                _say(_BEHIND, f"compiling {_named(names)} in another process; this run is interpreted meanwhile")
            return
        try:
            _spawn(names, lock)
        except (OSError, subprocess.SubprocessError) as error:  # no process or memory is left
            _say(_BEHIND, f"compiling {_named(names)} in the background is not possible: {error}; it is interpreted")
            return
        finally:
            os.close(lock)
        _asked.update(names)
        if loud:
            _say(
                _BEHIND,
                f"compiling {_named(names)} in the background, once for this installation; this run is interpreted "
                "meanwhile",
            )


def make_ready(*functions: Callable[..., Any]) -> None:
    """Announce what is about to be compiled here, if anything; wait if a background process is compiling it.

    Each function is waited for once, and no longer than compiling it takes: the other process may be stopped, or get
    no processor on a busy machine, as its priority is the lowest.
    """
    missing = [function for function in functions if needs_compiling(function)]
    if not missing:
        return
    new = {function.__name__ for function in missing} - _waited_for
    if new and not refused() and not why_not_kept() and _at_work():
        _waited_for.update(new)
        if not TAKES_LONG.keys().isdisjoint(f.__name__ for f in missing):
            what = _named([function.__name__ for function in missing])
            _say(_WAITING, f"compiling {what}: waiting for the process that does it in the background ...")
        if wait_until_done(missing, seconds_of(new)):
            return
        missing = [function for function in missing if needs_compiling(function)]
    names = [function.__name__ for function in missing]
    if not TAKES_LONG.keys().isdisjoint(names):
        _say(f"{_HERE}: {_named(names)}", compiling_notice(names))


def wait_until_done(functions: Sequence[Callable[..., Any]] = (), patience: float = PATIENCE) -> bool:
    """Wait for the process in the background, if there is one, so many seconds at most, or until these are compiled.

    Returns
    -------
    bool
        Whether there were any functions, and they are.
    """
    until = clock.monotonic() + patience
    while True:
        done = bool(functions) and not any(needs_compiling(function) for function in functions)
        if done or clock.monotonic() > until or not _at_work():
            return done
        clock.sleep(BETWEEN_LOOKS)


def takes_long(function: Callable[..., Any]) -> bool:
    """Whether an entry kernel takes more than a few seconds to compile."""
    return function.__name__ in TAKES_LONG


def seconds_to_compile(functions: Sequence[Callable[..., Any]]) -> float:
    """Return the processor time, about, s, of compiling those of these entry kernels that are not compiled yet."""
    return seconds_of(function.__name__ for function in functions if needs_compiling(function))


def seconds_of(names: Iterable[str]) -> float:
    """Return the processor time, about, s, of compiling the entry kernels of these names."""
    return sum(TAKES_LONG[name].seconds if name in TAKES_LONG else BRIEF for name in names)


def compiling_notice(names: Sequence[str] = ()) -> str:
    """Return the line for a user who is about to wait for the compiler of these kernels."""
    reason = why_not_kept()
    how_often = "once for this installation" if not reason else f"each time, as it cannot be kept: {reason}"
    seconds = seconds_of(names or TAKES_LONG)
    how_long = "some ten seconds" if seconds < 20.0 else "half a minute" if seconds < 45.0 else "a minute or two"
    return f"compiling {_named(names)} ({how_often}, {how_long}) ..."


def _named(names: Sequence[str]) -> str:
    """Return in words what of these kernels takes longest."""
    return next((long.what for name, long in TAKES_LONG.items() if name in names), "the step")


def _say(sort: str, line: str) -> None:
    """Say a line, one of each sort in a process: what else another one compiles is the same to who waits."""
    if sort not in _said:
        _said.add(sort)
        notices.info(line)


def _spawn(names: Sequence[str], lock: int) -> None:
    home = str(Path(__file__).resolve().parents[2])
    flags = ["-P", *(["-O"] * sys.flags.optimize), *(["-I"] if sys.flags.isolated else [])]
    environment = os.environ | {VARIABLE: "0"}
    if os.environ.get("NUMBA_CACHE_DIR"):  # which may be relative to the current folder
        environment["NUMBA_CACHE_DIR"] = str(cache_folder().parent)
    subprocess.run(
        [sys.executable, *flags, "-c", _PROGRAM, home, *names],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=os.sep,
        env=environment, start_new_session=True, pass_fds=[lock], check=True, timeout=30.0,
    )  # fmt: skip


def _take_lock() -> int | None:
    """Return the open file of the marker, locked; None if a process that compiles has it."""
    claim(cache_folder())
    lock = os.open(cache_folder() / MARKER, os.O_RDWR)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        return None
    return lock


def _at_work() -> bool:
    """Whether a process compiles into the folder."""
    try:
        lock = _take_lock()
    except OSError:
        return False
    if lock is not None:
        os.close(lock)
    return lock is None
