"""A saved run: ``closedloop show run.nc`` prints its report, ``closedloop plot run.nc`` draws its figures.

Nothing is simulated, and no module of a user is imported: a run with a law of one's own can be looked at anywhere.
"""

import json
from pathlib import Path

from closedloop.base.errors import RunFileError
from closedloop.command.border import DONE, Parser, add_figure_options, as_command, drawn_as, formats_of


@as_command()
def show(words: list[str]) -> int:
    """Run the command line of ``closedloop show`` and return the exit status."""
    parser = _parser("show", "Print the report of a saved run: its verdict, the paper's assumptions and its errors.")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON instead of tables")
    from closedloop.record.run import load_run

    options = parser.parse_args(words)
    run = load_run(options.run)
    if options.json:
        print(json.dumps(run.summary(), indent=2, allow_nan=False))
    else:
        from closedloop.record.report import print_report

        print_report(run)
    return DONE


@as_command()
def plot(words: list[str]) -> int:
    """Run the command line of ``closedloop plot`` and return the exit status."""
    parser = _parser(
        "plot",
        "Draw the figures of a saved run. The figure that shows the same scenario "
        "without its stabiliser needs another run, and is drawn by `closedloop run` only.",
    )
    parser.add_argument("--out", metavar="DIR", help="where the figures go (default: the folder of the run)")
    parser.add_argument("--columns", metavar="LIST", help="draw these columns instead, a panel each, such as f,e")
    add_figure_options(parser)
    from closedloop.record.run import load_run

    options = parser.parse_args(words)
    formats, style = formats_of(options), drawn_as(options)
    run = load_run(options.run)
    if len(run) == 0:
        raise RunFileError(f"{options.run}: the run stopped before its first row: there is nothing to draw")
    from closedloop.base.files import made_folder, what_was_written
    from closedloop.figures import columns, draw_figures
    from closedloop.figures.files import write_figure

    folder = Path(options.run).parent if options.out is None else Path(options.out)
    with style:
        if options.columns is None:
            folder = made_folder(folder)
            paths = draw_figures(run, folder, formats=formats)
        else:
            names = [name.strip() for name in options.columns.split(",")]
            figure, folder = columns(run, names), made_folder(folder)
            paths = [write_figure(figure, folder / f"fig_{'_'.join(names)}", formats)]
    also = f", each also as {' and '.join(formats[1:])}" if formats[1:] else ""
    print(what_was_written(*paths, folder=folder) + also)
    return DONE


def _parser(name: str, what: str) -> Parser:
    parser = Parser(prog=f"closedloop {name}", description=what)
    parser.add_argument("run", metavar="RUN.nc", help="the file of a run, such as out/wam_slide/run.nc")
    return parser
