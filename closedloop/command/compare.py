"""The command ``closedloop compare LOG --scenario S``: a log, or a saved run, over a scenario.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the scenario's run stops before its end.
"""

from closedloop.base.files import made_folder, what_was_written, write_whole
from closedloop.command.border import DONE, Parser, as_command, parsed, print_outcome


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
    table = {
        "--columns WHAT=NAME ...": "columns of time, q, torque ({} for the joint), force (one, or three with commas), "
        "speed; repeat it",
        "--degrees": "angles of the log are in degrees",
        "--gain N": "factor of the log's torques, N m/A of currents",
        "--shift S": "the instant of the log at which the run begins, s",
        "--cutoff HZ": "cut-off of the filters in the audit of the force",
        "--out DIR": "where comparison.json and comparison.svg go (default: nowhere)",
        "--json": "print the comparison as JSON",
    }
    parser.options(table, columns=mapped, gain=float, shift=float, cutoff=float)
    options, overrides = parsed(parser, words)
    folder = made_folder(options.out) if options.out else None

    from closedloop.simulation.prepare import load_model
    from closedloop.studies.comparison.compare import compare_log
    from closedloop.studies.comparison.recording import read_recording

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
