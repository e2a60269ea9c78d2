"""The options of commands that draw: the format of the figures, their width, and the size of their text."""

from __future__ import annotations

from argparse import Namespace
from contextlib import AbstractContextManager

from closedloop.base.errors import ScenarioError
from closedloop.command.border import Parser

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
