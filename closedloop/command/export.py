"""The command ``closedloop export run.nc --to csv``."""

from __future__ import annotations

from pathlib import Path

from closedloop.base.errors import OutputError
from closedloop.base.files import what_was_written
from closedloop.command.border import DONE, Parser, as_command
from closedloop.figures.export.mjcf import write_mjcf
from closedloop.figures.export.tables import FORMATS as BY_ENDING
from closedloop.record.load import load_run

FORMATS = {ending.removeprefix("."): write for ending, write in BY_ENDING.items()} | {"mjcf": write_mjcf}
# Endings that are not the format's name.
ENDINGS = {"mjcf": "xml"}


@as_command()
def main(arguments: list[str]) -> int:
    """Write a run file in another format, and return the exit status."""
    parser = Parser(
        prog="closedloop export",
        description="Write a run file in a format of other programs.",
        cure="such as: closedloop export out/wam_slide/run.nc --to csv",
    )
    parser.add_argument("run", help="a run.nc")
    parser.add_argument(
        "--to",
        required=True,
        choices=tuple(FORMATS),
        help="csv, parquet: a table; mat: arrays for MATLAB; mcap: ROS 2 messages; mjcf: the scene, for MuJoCo",
    )
    parser.add_argument("--out", metavar="FILE", help="the file (default: beside run.nc, under its name)")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    options = parser.parse_args(arguments)
    run = load_run(options.run)
    out = Path(options.out) if options.out else Path(options.run).with_suffix(f".{ENDINGS.get(options.to, options.to)}")
    if out.exists() and not options.overwrite:
        raise OutputError(f"{out}: is there already; name another file with --out, or replace it with --overwrite")
    paths = FORMATS[options.to](run, out)
    print(what_was_written(*paths))
    return DONE
