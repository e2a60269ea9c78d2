"""Options that several commands share: --help SECTION and --explain KEY of a scenario, and how figures are drawn."""

import argparse
import json
import re
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, NoReturn

from closedloop.base.errors import ScenarioError, printable
from closedloop.command.border import Parser

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
