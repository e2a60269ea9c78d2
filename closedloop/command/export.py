"""The command ``closedloop export run.nc --to csv``."""

from pathlib import Path

from closedloop.base.errors import OutputError
from closedloop.base.files import what_was_written
from closedloop.command.border import DONE, Parser, as_command
from closedloop.figures.export.files import FORMATS as BY_ENDING
from closedloop.figures.export.files import write_rosbag2
from closedloop.figures.export.mjcf import write_mjcf
from closedloop.lab.animate import animate
from closedloop.lab.history import share
from closedloop.record.run import load_run
from closedloop.record.save import save_run

FORMATS = {ending.removeprefix("."): write for ending, write in BY_ENDING.items()} | {
    "h5": lambda run, path: [save_run(run, path)], "rosbag2": write_rosbag2, "mjcf": write_mjcf,
    "gif": lambda run, path: [animate(run, path)], "mp4": lambda run, path: [animate(run, path)],
    "html": lambda run, path: [share(run, path)],
}  # fmt: skip
# What follows the name of the run, where it is not the format's name as an ending.
ENDINGS = {"mjcf": ".xml", "rosbag2": "_rosbag2"}


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
        "--to", required=True, choices=tuple(FORMATS),
        help="csv, parquet: a table; mat: arrays for MATLAB; h5: HDF5; mcap, rosbag2: ROS 2 messages, as a file or a "
        "bag; mjcf: the scene, for MuJoCo; gif, mp4: a film; html: a page with the arm in space",
    )  # fmt: skip
    parser.add_argument("--out", metavar="FILE", help="the file (default: beside run.nc, under its name)")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    options = parser.parse_args(arguments)
    run = load_run(options.run)
    beside = Path(options.run).with_suffix("")
    out = Path(options.out or beside.with_name(beside.name + ENDINGS.get(options.to, f".{options.to}")))
    if out.exists() and not options.overwrite:
        raise OutputError(f"{out}: is there already; name another file with --out, or replace it with --overwrite")
    print(what_was_written(*FORMATS[options.to](run, out)))
    return DONE
