"""The command ``closedloop compare LOG --scenario S``: a log, or a saved run, over a scenario.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the scenario's run stops before its end.
"""

from closedloop.base.files import made_folder, what_was_written, write_whole
from closedloop.command.border import DONE, Parser, as_command
from closedloop.command.shared_options import parsed, print_outcome


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.command.identify import mapped
    from closedloop.scenario.load import load_scenario

    parser = Parser(
        prog="closedloop compare",
        description="Compare a log of a robot, or a saved run, with a scenario. The log is aligned in time. The output "
        "has the differences of joints, torques and contact force, what explains them, and whether the log's force is "
        "consistent with its own motion and torques. --SECTION.KEY VALUE changes the scenario.",
        cure="such as: closedloop compare log.csv --scenario wam_slide",
    )
    parser.add_argument(
        "log", metavar="LOG", help=".csv, .parquet, .nc, .mcap, rosbag2, or a run.nc; force or speed alone will do"
    )
    parser.add_argument("--scenario", required=True, help="a scenario that ships, or a .toml")
    parser.add_argument(
        "--columns", action="append", default=[], type=mapped, metavar="WHAT=NAME",
        help="columns of time, q, torque ({} for the joint), force (one, or three with commas), speed; repeat it",
    )  # fmt: skip
    parser.add_argument("--degrees", action="store_true", help="angles of the log are in degrees")
    parser.add_argument("--gain", type=float, default=1.0, metavar="N", help="factor of the log's torques")
    parser.add_argument("--shift", type=float, metavar="S", help="the instant of the log at which the run begins, s")
    parser.add_argument("--cutoff", type=float, metavar="HZ", help="cut-off of the filters in the audit of the force")
    parser.add_argument("--out", metavar="DIR", help="where comparison.json and comparison.svg go (default: nowhere)")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")
    options, overrides = parsed(parser, words)
    folder = made_folder(options.out) if options.out else None

    from closedloop.simulation.prepare import load_model
    from closedloop.studies.comparison.recording import read_recording
    from closedloop.studies.comparison.with_log import compare_log

    scenario = load_scenario(options.scenario, overrides)
    robot = load_model(scenario)
    recording = read_recording(
        options.log, robot, columns=dict(options.columns), degrees=options.degrees, gain=options.gain
    )
    found = compare_log(recording, scenario, shift=options.shift, cutoff=options.cutoff)
    report = print_outcome(found, options.json)
    if folder is not None:
        from closedloop.figures.files import write_figure

        write_whole(folder / "comparison.json", f"{report}\n".encode())
        write_figure(found.figure(), folder / "comparison", (".svg",))
        if not options.json:
            print(what_was_written("comparison.json", "comparison.svg", folder=folder))
    return DONE
