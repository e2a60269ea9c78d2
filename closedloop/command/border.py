"""The outer part of all commands: arguments, exit status, and one line for any error, or for each fault of a scenario.

Exit status: 0 done; 2 the input is at fault, or the environment (a file, the output, memory); 3 the work could not be
finished; with --strict, 4 it ended, but the verdict of its numbers is bad, 5 that of its control alone; 130
interrupted by Ctrl-C, 143 by SIGTERM.

Errors of standard output and standard error stop no command. The reader of a pipe may have ended (``| head -1``), the
disk may be full, a stream may be closed, or its encoding may lack characters, which others then replace. Errors are
kept and reported afterwards; nothing raises, not even when Python ends.
"""

from __future__ import annotations

import argparse
import codecs
import errno
import io
import locale
import logging
import os
import select
import sys
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from typing import IO, Any, NoReturn

from closedloop.base.errors import ClosedLoopError, ClusterError, ScenarioError, SimulationError, lines_of, one_line
from closedloop.base.interrupts import INTERRUPTED, as_exceptions, exit_status, terminable, word_for
from closedloop.base.optional import not_installed
from closedloop.jit.numba_settings import sound_settings, why_no_settings


class Patient(io.RawIOBase):
    """A raw stream that accepts all writes; after the first failure it discards them.

    Attributes
    ----------
    failure : OSError or None
        The first error.
    """

    def __init__(self, inner: Any) -> None:
        super().__init__()
        self.inner = inner
        self.failure: OSError | None = None

    def writable(self) -> bool:
        """It can be written."""
        return True

    def fileno(self) -> int:
        """Return the descriptor."""
        return int(self.inner.fileno())

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return bool(self.inner.isatty())

    def write(self, data: Any, /) -> int:
        """Write, or know why not."""
        view = memoryview(data).cast("B")
        while self.failure is None:
            try:
                written = self.inner.write(view)
                if written is not None:
                    return int(written)
                select.select([], [self.inner], [])  # a pipe that does not wait, and is full
            except OSError as error:
                self.failure = error
            except ValueError as error:  # closed
                self.failure = OSError(errno.EBADF, str(error))
        return view.nbytes


@contextmanager
def patient_output() -> Iterator[list[Patient]]:
    """Let standard output and error be such streams meanwhile; yield that of the output, if it became one."""
    _fill_closed_descriptors()
    before = sys.stdout, sys.stderr
    out, made = _patient(sys.stdout)
    err, _ = _patient(sys.stderr)
    sys.stdout, sys.stderr = out, err
    try:
        yield made
    finally:
        with suppress(ValueError):  # someone closed it
            out.flush()
        with suppress(ValueError):
            err.flush()
        sys.stdout, sys.stderr = before


def _fill_closed_descriptors() -> None:
    """Open what was closed (``>&-``) on the null device: else the next file that is opened gets what is printed."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _patient(stream: Any) -> tuple[IO[str], list[Patient]]:
    """Return a stream in place of this one; itself where it is no file, as in a test or a notebook."""
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8"), []
    inner = getattr(stream, "buffer", None)
    inner = getattr(inner, "raw", inner)
    if not (isinstance(stream, io.TextIOWrapper) and isinstance(inner, io.RawIOBase)):
        return stream, []
    with suppress(OSError):
        stream.flush()
    raw = Patient(inner)
    text = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=HANDLER,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
    return text, [raw]


HANDLER = "closedloop.command.border"
ALIKE = {
    "−": "-", "–": "-", "—": "-", "…": "...", "×": "x", "·": "*", "≤": "<=", "≥": ">=", "≈": "~", "→": "->", "←": "<-",
    "∞": "inf", "√": "sqrt", "∂": "d", "°": " deg", "•": "*", "‘": "'", "’": "'", "“": '"', "”": '"', "„": '"',
    "µ": "u", "✓": "ok", "✗": "X", "\u0307": "'", "\u0308": "''", "█": "#",
}  # fmt: skip


def plain(character: str) -> str:
    """Return ASCII for one character."""
    if character.isascii():
        return character
    if character in ALIKE:
        return ALIKE[character]
    name = unicodedata.name(character, "")
    if name.startswith("GREEK SMALL LETTER ") and name.count(" ") == 3:
        return name.rpartition(" ")[2].lower()
    if name.startswith("GREEK CAPITAL LETTER ") and name.count(" ") == 3:
        return name.rpartition(" ")[2].capitalize()
    if name.startswith("BOX DRAWINGS"):
        horizontal, vertical = "HORIZONTAL" in name, "VERTICAL" in name
        return "-" if horizontal and not vertical else "|" if vertical and not horizontal else "+"
    parts = unicodedata.normalize("NFKD", character)
    if parts == character:
        return character.encode("ascii", "backslashreplace").decode("ascii")
    dotted = "'" if "\u0307" in parts else ""  # a derivative in time
    return "".join(plain(part) for part in parts if not unicodedata.combining(part)) + dotted


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(plain, error.object[error.start : error.end])), error.end


codecs.register_error(HANDLER, _replace)


DONE, BAD_INPUT, STOPPED, NOT_GOOD, NOT_CONTROLLED = 0, 2, 3, 4, 5


class Left(Exception):
    """The parser, its argument, has done everything, such as --help."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors `run_command` turns into a line and a status.

    Parameters
    ----------
    cure : str
        What to say at the end of a refusal.
    """

    def __init__(self, *, cure: str = "see --help", **settings: object) -> None:
        super().__init__(**settings, allow_abbrev=False)  # type: ignore[arg-type]
        self._cure = cure

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        raise ScenarioError(f"command line: {message}; {self._cure}")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Leave after --help."""
        raise Left(self)


def as_command(
    name: str = "closedloop", stopped: tuple[type[ClosedLoopError], ...] = (SimulationError, ClusterError)
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
    name: str,
    main: Callable[[list[str]], int],
    arguments: Sequence[str] | None = None,
    *,
    stopped: tuple[type[ClosedLoopError], ...] = (SimulationError, ClusterError),
) -> int:
    """Run a command and return its exit status, with all exceptions and output errors handled.

    Parameters
    ----------
    name : str
        What its lines on standard error begin with.
    main : callable
        Takes the words of the command line and returns the status.
    arguments : sequence of str, optional
        The words; those of the process if left out.
    stopped : tuple of types
        Errors with the status 3.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    with patient_output() as output, _quiet_libraries(), sound_settings(), _notices():
        status, lines = _run(main, words, stopped)
        sys.stdout.flush()
        failure = next((raw.failure for raw in output), None)
        # A reader who has gone has seen what he wanted; on Windows that is EINVAL.
        if failure is not None and not (isinstance(failure, BrokenPipeError) or failure.errno == errno.EINVAL):
            lines = lines or (f"standard output: cannot be written: {failure.strerror}",)
            status = status or BAD_INPUT
        for said in lines:
            print(f"{name}: {one_line(said)}", file=sys.stderr)
    return status


def _run(
    main: Callable[[list[str]], int], words: list[str], stopped: tuple[type[ClosedLoopError], ...]
) -> tuple[int, tuple[str, ...]]:
    """Return the exit status, and what to say on standard error, a line for each fault of the input."""
    came: list[int] = []
    try:
        with as_exceptions() as came, terminable():
            if reason := why_no_settings():
                return BAD_INPUT, (reason,)
            return main(words), ()
    except Left:
        return DONE, ()
    except KeyboardInterrupt as stop:  # an interrupted run is a ClosedLoopError too
        return exit_status(stop), (str(stop) or word_for(stop),)
    except ClosedLoopError as error:
        return STOPPED if isinstance(error, stopped) else BAD_INPUT, lines_of(error)
    except MemoryError:
        return BAD_INPUT, ("out of memory: ask for fewer steps, runs or columns",)
    except OSError as error:  # a file or a folder that the package or a library of it needs
        where = "" if error.filename is None else f"{os.fspath(error.filename)!r}: "
        return BAD_INPUT, (f"{where}{error.strerror or error}",)
    except SystemExit as leaving:  # our own parsers raise Left
        return BAD_INPUT, (f"something that was run, such as a law, called sys.exit({leaving.code!r})",)
    except Exception as error:
        if line := not_installed(error):
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
