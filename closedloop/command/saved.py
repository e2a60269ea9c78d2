"""A saved run: ``closedloop show run.nc`` prints its report, ``plot`` draws its figures, ``export`` writes it anew.

Nothing is simulated, and no module of a user is imported: a run with a law of one's own can be looked at anywhere.
"""

import json
from pathlib import Path
from typing import Any

from closedloop.base.errors import OutputError, RunFileError
from closedloop.base.files import made_folder, what_was_written
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


@as_command()
def export(words: list[str]) -> int:
    """Run the command line of ``closedloop export`` and return the exit status."""
    from closedloop.figures.export.files import FORMATS, write_rosbag2
    from closedloop.figures.export.mjcf import write_mjcf
    from closedloop.lab.animate import animate
    from closedloop.lab.history import share
    from closedloop.record.run import load_run
    from closedloop.record.save import save_run

    formats: dict[str, Any] = {ending.removeprefix("."): write for ending, write in FORMATS.items()} | {
        "h5": lambda run, path: [save_run(run, path)], "rosbag2": write_rosbag2, "mjcf": write_mjcf,
        "gif": lambda run, path: [animate(run, path)], "mp4": lambda run, path: [animate(run, path)],
        "html": lambda run, path: [share(run, path)],
    }  # fmt: skip
    endings = {"mjcf": ".xml", "rosbag2": "_rosbag2"}  # where the format's name is not the ending
    parser = Parser(
        prog="closedloop export",
        description="Write a run file in a format of other programs.",
        cure="such as: closedloop export out/wam_slide/run.nc --to csv",
    )
    parser.add_argument("run", help="a run.nc")
    parser.add_argument(
        "--to", required=True, choices=tuple(formats),
        help="csv, parquet: a table; mat: arrays for MATLAB; h5: HDF5; mcap, rosbag2: ROS 2 messages, as a file or a "
        "bag; mjcf: the scene, for MuJoCo; gif, mp4: a film; html: a page with the arm in space",
    )  # fmt: skip
    parser.add_argument("--out", metavar="FILE", help="the file (default: beside run.nc, under its name)")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    options = parser.parse_args(words)
    run = load_run(options.run)
    beside = Path(options.run).with_suffix("")
    out = Path(options.out or beside.with_name(beside.name + endings.get(options.to, f".{options.to}")))
    if out.exists() and not options.overwrite:
        raise OutputError(f"{out}: is there already; name another file with --out, or replace it with --overwrite")
    print(what_was_written(*formats[options.to](run, out)))
    return DONE


def _parser(name: str, what: str) -> Parser:
    parser = Parser(prog=f"closedloop {name}", description=what)
    parser.add_argument("run", metavar="RUN.nc", help="the file of a run, such as out/wam_slide/run.nc")
    return parser
