"""Compiling in a background process, while the run is interpreted.

A process has low priority, no terminal and no output, outlives the one that started it, and writes compiled code into
the cache's folder. In each folder there is at most one. It holds a lock on the folder's marker, inherited from the
process that started it and released when it ends.
With ``CLOSEDLOOP_BACKGROUND_COMPILE=0`` there are no such processes: code is compiled before it is run.
"""

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
from closedloop.jit.kernel import jit_disabled, needs_compiling, plain_numba

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

VARIABLE = "CLOSEDLOOP_BACKGROUND_COMPILE"
# What is said about compiling, a line each: commands print it on standard error.
notices = logging.getLogger("closedloop.compiling")

NICE = 10  # the priority: the run itself comes first
LONGEST = 900  # s, after which a process is given up


class Long(NamedTuple):
    """What an entry kernel is that takes more than a few seconds to compile, and its processor time, about, s."""

    what: str
    seconds: float


class Asked(NamedTuple):
    """What a process in the background compiles, in this order, and when it was started, s."""

    functions: Sequence[Callable[..., Any]]
    began: float


# As `closedloop compile` prints them; the others are compiled in silence, in a second or two.
TAKES_LONG = {
    "proceed_at": Long("the step", 16.0), "run_in_lanes": Long("the step of eight runs at a time", 13.0),
    "contacts_in_step": Long("contacts of links", 19.0), "closed_loops": Long("loops", 5.0),
    "proceed_at_dual8": Long("derivatives of the step", 22.0),
    "contacts_in_step_dual8": Long("derivatives of contacts of links", 17.0),
    "closed_loops_dual8": Long("derivatives of loops", 9.0), "walk": Long("the inverse kinematics of a path", 4.0),
    "along_path": Long("loops along a path", 3.0),
}  # fmt: skip
BRIEF = 1.5  # s, of the others
OF_A_CORE = 0.6  # what a process has of one while another interprets, with two
# How long `wait_until_done` waits at most, unless it is told otherwise, and between two looks, s.
PATIENCE, BETWEEN_LOOKS = 180.0, 0.1
# Who needs something now compiles it, if the process in the background has it later than in so many times that time.
WORTH_WAITING = 1.5
# And who waits does so for so many times what compiling takes by the numbers above, which are those of a quiet machine.
PATIENT = 4.0

# The first process started ends at once, so that nobody has to wait for the one that compiles. Linux shares a processor
# between sessions first, and the priority of a process counts in its own session only: the session's is lowered too.
_DETACHED = """
import os, sys
if os.fork():
    os._exit(0)
os.nice(int(sys.argv[1]))
try:
    with open("/proc/self/autogroup", "w") as group:
        group.write(sys.argv[1])
except OSError:
    pass
"""
_PROGRAM = f"""{_DETACHED}
import signal
signal.alarm({LONGEST})
if sys.argv[2] not in sys.path:
    sys.path.insert(0, sys.argv[2])
from closedloop.command.compile_all import compile_these
compile_these(sys.argv[3:])
"""

_lock = threading.Lock()
_asked: list[Asked] = []  # of this process
_waited_for: set[str] = set()  # names of what this process has waited for
_said: set[str] = set()  # of what sort a line has been said already
_BEHIND, _WAITING, _HERE = "in the background", "waiting", "here"


def refused() -> str:
    """Return why no process may compile in the background; "" if one may."""
    if os.environ.get(VARIABLE, "").strip().lower() in ("0", "no", "off", "false"):
        return f"{VARIABLE} refuses it"
    if jit_disabled() or plain_numba():
        return "NUMBA_DISABLE_JIT or CLOSEDLOOP_PLAIN_NUMBA is set"
    if fcntl is None or not hasattr(os, "fork"):
        return "this system has no locks that end with their process"
    if not Path(sys.executable or "").name.startswith("python"):
        return "Python is part of another program"
    return ""


# Whether another process sees to it, such as the one that this is a copy of.
left_to_another = False


def start(functions: Sequence[Callable[..., Any]], quietly: bool = False) -> None:
    """Start a process that compiles entry kernels in this order, unless one is running or these were requested before.

    A line says so where that takes long, unless `quietly`.
    """
    with _lock:
        asked = [each for one in _asked for each in one.functions]
        new = [function for function in functions if function not in asked]
        if not new or left_to_another or refused():
            return
        names = [function.__name__ for function in new]
        what = f"compiling {_named(names)}"
        if reason := why_not_kept():
            _say(_BEHIND, f"{what} would take longer than this run, and cannot be kept: {reason}")
            return
        loud = not quietly and not TAKES_LONG.keys().isdisjoint(names)
        lock = _take_lock()
        if lock is None:
            if loud:
                _say(_BEHIND, f"{what} in another process; this run is interpreted meanwhile")
            return
        try:
            _spawn(names, lock)
        except (OSError, subprocess.SubprocessError) as error:  # no process or memory is left
            _say(_BEHIND, f"{what} in the background is not possible: {error}; it is interpreted")
            return
        finally:
            os.close(lock)
        _asked.append(Asked(new, clock.monotonic()))
        if loud:
            said = f"{what} in the background, once for this installation; this run is interpreted meanwhile"
            _say(_BEHIND, said)


def make_ready(*functions: Callable[..., Any]) -> None:
    """Announce what is about to be compiled here, if anything; wait if a background process has it sooner.

    Each function is waited for once, and no longer than four times what compiling it takes on a quiet machine: the
    other process may be stopped.
    """
    missing = list(filter(needs_compiling, functions))
    names = [function.__name__ for function in missing]
    long = not TAKES_LONG.keys().isdisjoint(names)
    new = [function for function in missing if function.__name__ not in _waited_for]
    soon = bool(new) and seconds_left(missing) < WORTH_WAITING * seconds_of(missing)
    if soon and not refused() and not why_not_kept() and _at_work():
        _waited_for.update(names)
        if long:
            _say(_WAITING, f"compiling {_named(names)}: waiting for the process that does it in the background ...")
        if wait_until_done(missing, PATIENT * seconds_of(new)):
            return
    if long:
        _say(f"{_HERE}: {_named(names)}", compiling_notice(names))


def wait_until_done(functions: Sequence[Callable[..., Any]] = (), patience: float = PATIENCE) -> bool:
    """Wait for the process in the background, if there is one, so many seconds at most, or until these are there.

    Returns whether there were any functions, and they are.
    """
    until = clock.monotonic() + patience
    while True:
        missing = list(filter(needs_compiling, functions))
        done = bool(functions) and not missing
        if done or clock.monotonic() > until or not _at_work():
            return done
        clock.sleep(BETWEEN_LOOKS)


def takes_long(function: Callable[..., Any]) -> bool:
    """Whether an entry kernel takes more than a few seconds to compile."""
    return function.__name__ in TAKES_LONG


def seconds_to_compile(functions: Iterable[Callable[..., Any]]) -> float:
    """Return the processor time, about, s, of compiling those of these entry kernels that are not compiled yet."""
    return seconds_of(filter(needs_compiling, functions))


def seconds_left(functions: Iterable[Callable[..., Any]]) -> float:
    """Return how long, about, s, it takes until these entry kernels are compiled in the background, if one waits.

    Who waits leaves it a core. Until now it has had part of one.
    """
    missing, times = list(filter(needs_compiling, functions)), [0.0]
    for asked, began in _asked:
        wanted = [place for place, function in enumerate(asked) if function in missing]
        if wanted:
            times.append(seconds_of(asked[: wanted[-1] + 1]) - OF_A_CORE * (clock.monotonic() - began))
            missing = [function for function in missing if function not in asked]
    return max(seconds_of(missing), *times)


def seconds_of(functions: Iterable[Callable[..., Any]]) -> float:
    """Return the processor time, about, s, of compiling entry kernels."""
    return sum(seconds_of_name(function.__name__) for function in functions)


def seconds_of_name(name: str) -> float:
    """Return the processor time, about, s, of compiling the entry kernel of a name."""
    return TAKES_LONG[name].seconds if name in TAKES_LONG else BRIEF


def compiling_notice(names: Sequence[str] = ()) -> str:
    """Return the line for a user who is about to wait for the compiler of these kernels."""
    reason = why_not_kept()
    how_often = "once for this installation" if not reason else f"each time, as it cannot be kept: {reason}"
    seconds = sum(map(seconds_of_name, names or TAKES_LONG))
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
        [sys.executable, *flags, "-c", _PROGRAM, str(NICE), home, *names],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=os.sep,
        env=environment, start_new_session=True, pass_fds=[lock], check=True, timeout=30.0,
    )  # fmt: skip


def _take_lock() -> int | None:
    """Return the folder's marker, opened and locked; None if a process that compiles has it."""
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
