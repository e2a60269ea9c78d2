"""A saved run: ``closedloop show run.nc`` prints its report, ``closedloop plot run.nc`` draws its figures.

Nothing is simulated, and no module of a user is imported: a run with a law of one's own can be looked at anywhere.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from closedloop.base.errors import OutputError, RunFileError
from closedloop.command.border import DONE, Parser, run_command

if TYPE_CHECKING:
    from closedloop.record.run import Run


def show(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of ``closedloop show`` and return the exit status."""
    return run_command("closedloop", _show, arguments)


def plot(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of ``closedloop plot`` and return the exit status."""
    return run_command("closedloop", _plot, arguments)


def _show(words: list[str]) -> int:
    parser = _parser("show", "Print the report of a saved run: its verdict, the paper's assumptions and its errors.")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON instead of tables")
    options = parser.parse_args(words)
    run = _load(options.run)
    if options.json:
        print(json.dumps(run.summary(), indent=2, allow_nan=False))
    else:
        from closedloop.record.report import print_report

        print_report(run)
    return DONE


def _plot(words: list[str]) -> int:
    parser = _parser(
        "plot",
        "Draw the figures of a saved run, as PNG and SVG. The figure that shows the same scenario "
        "without its stabiliser needs another run, and is drawn by `closedloop run` only.",
    )
    parser.add_argument("--out", metavar="DIR", help="where the figures go (default: the folder of the run)")
    options = parser.parse_args(words)
    run = _load(options.run)
    if len(run) == 0:
        raise RunFileError(f"{options.run}: the run stopped before its first row: there is nothing to draw")
    folder = Path(options.run).parent if options.out is None else Path(options.out)
    _make(folder)
    from closedloop.base.files import what_was_written
    from closedloop.figures import draw_figures

    paths = draw_figures(run, folder)
    print(what_was_written(*paths, folder=folder))
    return DONE


def _parser(name: str, what: str) -> Parser:
    parser = Parser(prog=f"closedloop {name}", description=what)
    parser.add_argument("run", metavar="RUN.nc", help="the file of a run, such as out/wam_slide/run.nc")
    return parser


def _load(path: str) -> Run:
    from closedloop.record.load import load_run

    return load_run(path)


def _make(folder: Path) -> None:
    from closedloop.base.files import probe_folder, reason_of

    try:
        probe_folder(folder)
    except (OSError, ValueError) as error:
        raise OutputError(f"--out {str(folder)!r}: cannot be written: {reason_of(error)}") from None
