"""The outer part of all commands: arguments, exit status, and one line for any error, or for each fault of a scenario.

Exit status: 0 done; 2 the input is at fault, or the environment (a file, the output, memory); 3 the work could not be
finished; with --strict, 4 it ended, but the verdict of its numbers is bad, 5 that of its control alone; 130
interrupted by Ctrl-C, 143 by SIGTERM.

A character that the encoding of standard output lacks is printed as its code. Who reads it may end before the command
(``| head -1``).
"""

import argparse
import io
import locale
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from typing import Any, NoReturn

from closedloop.base import errors
from closedloop.base.interrupts import INTERRUPTED, as_exceptions, exit_status, terminable, word_for

DONE, BAD_INPUT, STOPPED, NOT_GOOD, NOT_CONTROLLED = 0, 2, 3, 4, 5


class Left(Exception):
    """The parser, its argument, has done everything, such as --help."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors `run_command` turns into a line and a status.

    `cure`: what to say at the end of a refusal.
    """

    def __init__(self, *, cure: str = "see --help", **settings: object) -> None:
        super().__init__(**settings, allow_abbrev=False)  # type: ignore[arg-type]
        self._cure = cure

    def options(self, table: Mapping[str, str], **values: Any) -> None:
        """Add options, each as it is typed and with its help: `--json`, `--out DIR`, `--over KEY=VALUES ...` to repeat.

        `values`: by the name of an option its default, or the type of what is given where there is no default.
        """
        for typed, text in table.items():
            name, *value = typed.split(" ")
            usual = values.get(name[2:].replace("-", "_"))
            kind = usual if isinstance(usual, type) or callable(usual) else str if usual is None else type(usual)
            usual = None if kind is usual else usual
            if not value:
                self.add_argument(name, action="store_true", help=text)
            elif value[1:]:
                self.add_argument(name, action="append", default=[], metavar=value[0], type=kind, help=text)
            else:
                self.add_argument(name, metavar=value[0], type=kind, default=usual, help=text)

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise errors.ScenarioError(f"command line: {message}; {self._cure}")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Leave after --help."""
        raise Left(self)


def as_command(
    name: str = "closedloop",
    stopped: tuple[type[errors.ClosedLoopError], ...] = (errors.SimulationError, errors.ClusterError),
) -> Callable[[Callable[[list[str]], int]], Callable[..., int]]:
    """Return a decorator that makes a command of a function of words, which are the process's if left out.

    See `run_command`.
    """

    def of(main: Callable[[list[str]], int]) -> Callable[..., int]:
        @wraps(main)
        def run(arguments: Sequence[str] | None = None) -> int:
            return run_command(name, main, arguments, stopped=stopped)

        return run

    return of


def run_command(
    name: str, main: Callable[[list[str]], int], arguments: Sequence[str] | None = None, *,
    stopped: tuple[type[errors.ClosedLoopError], ...] = (errors.SimulationError, errors.ClusterError),
) -> int:  # fmt: skip
    """Run a command and return its exit status, with all exceptions and output errors handled.

    `name`: what its lines on standard error begin with.
    `main`: takes the words of the command line and returns the status.
    `arguments`: the words; those of the process if left out.
    `stopped`: errors with the status 3.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    with _quiet_libraries(), _notices():
        status, lines = _run(main, words, stopped)
        if (failure := _failure_of_output()) and status in (DONE, BAD_INPUT):
            lines, status = (failure,), BAD_INPUT
        with suppress(OSError):
            for said in lines:
                print(f"{name}: {errors.one_line(said)}", file=sys.stderr)
    return status


def _failure_of_output() -> str:
    """Write what was printed, and return why it cannot be; "" also for a reader who has gone, and has seen enough."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
        return ""
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python would try again as it ends
        return "" if isinstance(error, BrokenPipeError) else f"standard output: cannot be written: {error.strerror}"


def _run(
    main: Callable[[list[str]], int], words: list[str], stopped: tuple[type[errors.ClosedLoopError], ...]
) -> tuple[int, tuple[str, ...]]:
    """Return the exit status, and what to say on standard error, a line for each fault of the input."""
    came: list[int] = []
    try:
        with as_exceptions() as came, terminable():
            return main(words), ()
    except Left:
        return DONE, ()
    except KeyboardInterrupt as stop:  # an interrupted run is a ClosedLoopError too
        return exit_status(stop), (str(stop) or word_for(stop),)
    except errors.ClosedLoopError as error:
        return STOPPED if isinstance(error, stopped) else BAD_INPUT, errors.lines_of(error)
    except BrokenPipeError:  # as of a program that is ended by it
        return 128 + signal.SIGPIPE, ()
    except MemoryError:
        return BAD_INPUT, ("out of memory: ask for fewer steps, runs or columns",)
    except OSError as error:  # a file or a folder that the package or a library of it needs
        where = "" if error.filename is None else f"{os.fspath(error.filename)!r}: "
        return BAD_INPUT, (f"{where}{error.strerror or error}",)
    except SystemExit as leaving:  # our own parsers raise Left
        return BAD_INPUT, (f"something that was run, such as a law, called sys.exit({leaving.code!r})",)
    except Exception as error:
        if line := errors.not_installed(error):
            return BAD_INPUT, (line,)
        if came:  # within a library that was being imported, which made an ImportError of it, for example
            return INTERRUPTED, ("interrupted",)
        raise


class _Notices(logging.Handler):
    """Prints what is said about compiling on standard error, whatever that is by then."""

    def emit(self, record: logging.LogRecord) -> None:
        print(record.getMessage(), file=sys.stderr, flush=True)


@contextmanager
def _notices() -> Iterator[None]:
    """Print the package's notices, which it logs, while the command runs."""
    logger, handler = logging.getLogger("closedloop.compiling"), _Notices()
    level, propagate = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate


@contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Keep libraries from stopping a command: figures are drawn into files only, without a screen; warnings of
    libraries are no errors, even with PYTHONWARNINGS; and a library that reads its own files in the locale's encoding
    (Drake) can do so where that is ASCII.
    """
    log, backend = logging.getLogger("matplotlib"), os.environ.get("MPLBACKEND")
    level, characters = log.level, locale.setlocale(locale.LC_CTYPE)
    if locale.getpreferredencoding(False).upper() in ("ASCII", "US-ASCII", "ANSI_X3.4-1968", "646"):
        with suppress(locale.Error):
            locale.setlocale(locale.LC_CTYPE, "C.UTF-8")
    log.setLevel(logging.ERROR)  # that it found no folder for its settings
    os.environ["MPLBACKEND"] = "agg"
    try:
        with warnings.catch_warnings():
            if any(option.startswith("e") for option in sys.warnoptions):
                warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
        locale.setlocale(locale.LC_CTYPE, characters)
        if backend is None:
            del os.environ["MPLBACKEND"]
        else:
            os.environ["MPLBACKEND"] = backend
