"""The outer part of all commands: arguments, exit status, and one line for any error, or for each fault of a scenario.

Options that several commands share are here too: --help SECTION and --explain KEY of a scenario, and how figures are
drawn.

Exit status: 0 done; 2 the input is at fault, or the environment (a file, the output, memory); 3 the work could not be
finished; with --strict, 4 it ended, but the verdict of its numbers is bad, 5 that of its control alone; 130
interrupted by Ctrl-C, 143 by SIGTERM.

A character that the encoding of standard output lacks is printed as its code. Who reads it may end before the command
(``| head -1``).
"""

import argparse
import io
import json
import locale
import logging
import os
import re
import signal
import sys
import textwrap
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import wraps
from typing import Any, NoReturn

from closedloop.base import errors
from closedloop.base.errors import ScenarioError, printable
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


# Column at which an option's meaning begins, so that most take one line.
COLUMN = 26


class OneScreen(argparse.RawDescriptionHelpFormatter):
    """Help whose options stand on a line each."""

    def __init__(self, prog: str, **settings: Any) -> None:
        super().__init__(prog, **{"max_help_position": COLUMN} | settings)


class _OfScenarios(Parser):
    """A parser that says which key is meant by an option that there is not, such as --dt."""

    def error(self, message: str) -> NoReturn:
        """Refuse the arguments."""
        from closedloop.scenario.messages import elsewhere

        word = re.search(r"unrecognized arguments:.*?--([^\s=.]+)", message)
        if word and (meant := elsewhere(word[1])):
            raise ScenarioError(f"command line: {message}; did you mean --{meant}?")
        super().error(message)


def scenario_parser(prog: str, rest: str, **settings: Any) -> Parser:
    """Return a parser whose help lists the sections of a scenario and explains each, and each of its keys.

    `prog`, `rest`: how the command is called, and what follows its options in the usage.
    `**settings`: see `closedloop.command.border.Parser`.
    """
    parser = _OfScenarios(
        prog=prog, usage=f"{prog} {rest} [options] [--SECTION.KEY VALUE ...]", formatter_class=OneScreen,
        add_help=False, **settings,
    )  # fmt: skip
    parser.add_argument(
        "-h", "--help", nargs="?", metavar="SECTION", action=_Tell, help="show this, or the keys of a section, and stop"
    )
    parser.add_argument("--explain", metavar="KEY", action=_Tell, help="explain a key, such as law.kp, and stop")
    return parser


def list_of_sections(names_only: bool = False) -> str:
    """Return how keys are given and explained, and the sections of a scenario, a line each or their names only."""
    from closedloop.scenario.messages import sections

    if names_only:
        names = textwrap.fill(", ".join(sections()), 78, initial_indent="  ", subsequent_indent="  ")
        return (
            "Every other key can be set for all runs, with a value as in TOML: --law.kp 900.\n"
            "--help law lists the keys of a section, --explain law.kp explains one. Sections:\n"
        ) + names
    return "Each key is an option, with a value as in TOML: --law.force 15. Sections:\n" + "\n".join(
        f"  {name:{COLUMN - 4}}{what}" for name, what in sections().items()
    )


class _Tell(argparse.Action):
    """Print what a section or a key is, or the help of the command if none is named, and leave."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:  # fmt: skip
        if values is None:
            parser.print_help()
        else:
            from closedloop.scenario.messages import explain_key

            try:
                print(explain_key(str(values).removeprefix("--")))
            except ScenarioError as error:
                raise ScenarioError(f"command line: {self.option_strings[-1]}: {error}") from None
        parser.exit()


def parsed(parser: Parser, words: list[str]) -> tuple[Namespace, dict[str, Any]]:
    """Return a command's options, and the overrides among its words, whose users' classes are known from then on."""
    from closedloop.scenario.load import split_overrides
    from closedloop.scenario.user_module import name_members

    overrides, rest = split_overrides(words)
    options = parser.parse_args(rest)
    name_members(overrides.items())
    return options, overrides


def print_outcome(found: Any, as_json: bool) -> str:
    """Print the lines of a study's outcome, or its JSON, and return the latter."""
    report = json.dumps(found.as_dict(), indent=2, allow_nan=False)
    print(report if as_json else "\n".join(map(printable, found.lines())))
    return report


FORMATS = ("png", "svg", "pdf")
# Widths, inches, and sizes of text, points, that a figure can have.
WIDTHS, FONTS = (1.5, 40.0), (3.0, 40.0)


def add_figure_options(parser: Parser, formats: bool = True) -> None:
    """Add the options to a command's parser, that of the format only if it is not said by a file's ending."""
    if formats:
        parser.add_argument(
            "--format", metavar="LIST", default="png,svg", help="png, svg, pdf, or several: pdf,png (default: png,svg)"
        )
    parser.add_argument("--width", type=float, metavar="INCHES", help="width of the figures (default: 7.2)")
    parser.add_argument("--font", type=float, metavar="POINTS", help="size of their text (default: 10)")


def formats_of(options: Namespace) -> tuple[str, ...]:
    """Return the endings of the files, such as (".pdf",)."""
    found = [word.strip().removeprefix(".").lower() for word in options.format.split(",")]
    unknown = [word for word in found if word not in FORMATS]
    if unknown:
        raise ScenarioError(f"--format {options.format}: {unknown[0]!r} is none of {', '.join(FORMATS)}")
    return tuple(f".{word}" for word in dict.fromkeys(found))


def drawn_as(options: Namespace) -> AbstractContextManager[None]:
    """Return the style in which the figures are drawn."""
    for name, unit, (low, high) in (("width", "inches", WIDTHS), ("font", "points", FONTS)):
        value = getattr(options, name)
        if value is not None and not low <= value <= high:
            raise ScenarioError(f"--{name} {value:g}: must be from {low:g} to {high:g} {unit}")
    from closedloop.figures.style import styled

    return styled(width=options.width, font=options.font)
