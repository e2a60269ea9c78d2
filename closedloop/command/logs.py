"""Logs: ``closedloop identify LOG --robot R`` finds parameters of a robot, ``compare LOG --scenario S`` sets one beside
a run, ``excite --robot R`` designs the motion of one that identifies parameters best.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the scenario's run stops before its end.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from closedloop.base.errors import ModelError, needs, printable
from closedloop.base.files import made_folder, what_was_written, write_whole
from closedloop.command.border import DONE, Parser, as_command, parsed, print_outcome

if TYPE_CHECKING:
    from robot_models import RobotModel

TERMS = ("viscous", "dry", "offset", "load", "stribeck", "drive_inertia")


@as_command()
def identify(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    options = _identify_parser().parse_args(words)
    import robot_models
    from closedloop.studies.identify import identify as study
    from closedloop.studies.identify.read import read_log
    from closedloop.studies.identify.written import report, write

    terms = [term.strip() for term in options.terms.split(",") if term.strip()]
    if unknown := [term for term in terms if term not in TERMS]:
        raise ModelError(f"--terms {options.terms}: {unknown[0]!r} is none of {', '.join(TERMS)}")
    gain = [_number(entry, "--gain") for entry in options.gain.split(",")] if options.gain else None
    normal = None if options.contact is None else [_number(entry, "--contact") for entry in options.contact.split(",")]
    folder = made_folder(options.out)
    robot = robot_models.load(options.robot)
    if gain is not None and len(gain) not in (1, robot.n):
        raise ModelError(f"--gain {options.gain}: {len(gain)} numbers: one, or {robot.n}, one for each joint")
    mapped = dict(options.columns)
    if normal is not None:
        return _contact(options, robot, mapped, normal, gain, folder)
    logs = [read_log(path, robot, columns=mapped, degrees=options.degrees, gain=gain) for path in options.logs]
    found = study.identify(
        logs, robot,
        friction=[term for term in terms if term not in ("drive_inertia", "stribeck")],
        drive_inertia="drive_inertia" in terms,
        stribeck_speed="fit" if "stribeck" in terms else None,
        coupled=options.coupled, cutoff=options.cutoff, slow=options.slow, held_out=options.held_out,
        method=options.method,
    )  # fmt: skip
    print("\n".join(map(printable, report(found))))
    paths = write(found, folder, f"closedloop identify {' '.join(options.logs)}")
    print("\n" + what_was_written(*paths, folder=folder))
    return DONE


def _contact(
    options: argparse.Namespace, robot: RobotModel, mapped: dict[str, str], normal: list[float],
    gain: list[float] | None, folder: Path,
) -> int:  # fmt: skip
    """Identify the contact of the tip with a plane, from one log."""
    from closedloop.figures.files import write_figure
    from closedloop.studies.comparison.recording import read_recording
    from closedloop.studies.identify.contact.identify_contact import contact_recording, identify_contact
    from closedloop.studies.identify.read import run_of

    if len(normal) != 3:
        raise ModelError(f"--contact {options.contact}: {len(normal)} numbers: three, the normal of the plane")
    if len(options.logs) > 1:
        raise ModelError(f"--contact: {len(options.logs)} logs: a contact is identified from one")
    path = Path(options.logs[0])
    run = run_of(path) if path.suffix.lower() == ".nc" and not mapped else None
    if run is not None:
        recording, out = contact_recording(run, str(path))
        normal = [float(x) for x in out]
    else:
        recording = read_recording(path, robot, columns=mapped, degrees=options.degrees, gain=gain)
    found = identify_contact(recording, robot, normal=normal, delay=options.delay, cutoff=options.cutoff)
    print("\n".join(map(printable, found.lines())))
    write_whole(folder / "contact.json", f"{json.dumps(found.summary(), indent=2, allow_nan=False)}\n".encode())
    write_figure(found.figure(), folder / "contact", (".png",))
    print("\n" + what_was_written("contact.json", "contact.png", folder=folder))
    return DONE


def _identify_parser() -> Parser:
    parser = Parser(
        prog="closedloop identify",
        description="Identify base inertial parameters, friction and drive inertia of a robot from a log: positions "
        "and torques of all joints over time, as CSV, Parquet, NetCDF, MCAP, rosbag2, or a run.nc. Every value has "
        "a 95 % interval; the report names what the log does not determine, with a motion that would.",
        cure="such as: closedloop identify log.csv --robot ur10",
    )
    parser.add_argument("logs", nargs="+", metavar="LOG", help="one log, or several that are fitted together")
    parser.add_argument(
        "--robot", required=True, metavar="NAME|FILE", help="its kinematics: a robot, a URDF or an MJCF"
    )
    table = {
        "--out DIR": "where results go (default: out/identify)",
        "--columns WHAT=NAME ...": "columns of time, q, v, torque, {} for the joint: torque='effort_{}'; or a list; "
        "repeat it for each",
        "--degrees": "angles of the log are in degrees",
        "--gain N,...": "factor of the torques, one or one for each joint; N m/A of currents, which need one",
        "--terms TERMS": f"of {', '.join(TERMS)}",
        "--coupled A,B ...": "two joints whose second motor turns with both, such as the wrist of a Staeubli TX",
        "--contact NX,NY,NZ": "find friction, stiffness, damping, restitution and the force sensor instead, of a tip "
        "on a plane with this normal (of a run.nc its own); the log has the force too: one column along the normal, or "
        "three",
        "--delay S": "delay of the force behind the motion, if known (--contact)",
        "--cutoff HZ": "cut-off of the low-pass filter (default: ten times the motion's)",
        "--slow SHARE": "share of a joint's top speed below which torques are not used",
        "--held-out SHARE": "share of the log that is kept to test the result",
    }
    parser.options(
        table, out="out/identify", columns=mapped, gain="", terms="viscous,dry,offset,drive_inertia", coupled=_pair,
        delay=float, cutoff=float, slow=0.01, held_out=0.25,
    )  # fmt: skip
    parser.add_argument("--method", choices=("ls", "iv"), default="ls", help="least squares, or instrumental variables")
    return parser


def mapped(word: str) -> tuple[str, str]:
    """Read WHAT=NAME."""
    what, _, name = word.partition("=")
    if not name:
        raise argparse.ArgumentTypeError(f"{word!r}: must be WHAT=NAME, such as torque='effort_{{}}'")
    return what, name


def _pair(word: str) -> tuple[str, str]:
    names = word.split(",")
    if len(names) != 2:
        raise argparse.ArgumentTypeError(f"{word!r}: must be two joints with a comma between")
    return names[0], names[1]


def _number(word: str, what: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ModelError(f"{what} {word!r}: must be a number") from None


@as_command()
def excite(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    options = _excite_parser().parse_args(words)
    from closedloop.studies.identify import excite as study

    needs("pandas")  # which writes the motion, once it has been found
    folder = made_folder(options.out)
    found = study.excite(
        options.robot, [name.strip() for name in options.target.split(",") if name.strip()],
        duration=options.duration, harmonics=options.harmonics, rate=options.rate,
        noise=_numbers(options.noise, "--noise"), acceleration=_numbers(options.acceleration, "--acceleration"),
        share=options.share, seed=options.seed,
    )  # fmt: skip
    print("\n".join(map(printable, found.lines())))
    write_whole(folder / "excitation.csv", found.to_pandas().to_csv(index=False).encode())
    write_whole(folder / "report.txt", ("\n".join(found.lines()) + "\n").encode())
    print("\n" + what_was_written("excitation.csv", "report.txt", folder=folder))
    return DONE


def _excite_parser() -> Parser:
    parser = Parser(
        prog="closedloop excite",
        description="Design a motion of all joints, within their limits and from rest to rest, from whose log "
        "parameters can be identified best, and print half of the 95 % interval of each base parameter.",
        cure="such as: closedloop excite --robot ur10 --for dry_shoulder_pan_joint",
    )
    parser.add_argument("--robot", required=True, metavar="NAME|FILE", help="a robot, a URDF or an MJCF")
    parser.add_argument("--for", dest="target", default="", metavar="P,...", help="base parameters (default: all)")
    table = {
        "--duration S": "duration of the motion, s (default: 10)",
        "--harmonics N": "harmonics of its Fourier series (default: 5)",
        "--rate HZ": "sampling rate of the log (default: 100)",
        "--noise N,...": "noise of the torques, N m, one or one for each joint (default: a hundredth of the effort "
        "limit)",
        "--acceleration A,...": "largest acceleration, rad/s², one or one for each joint (default: top speed in "
        "0.25 s)",
    }
    parser.options(table, duration=10.0, harmonics=5, rate=100.0)
    parser.add_argument("--share", type=float, default=0.9, help="share of the limits that is used (default: 0.9)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the initial motions of the search")
    parser.add_argument("--out", metavar="DIR", default="out/excite", help="where results go (default: out/excite)")
    return parser


def _numbers(text: str | None, what: str) -> list[float] | float | None:
    """Read numbers with commas between."""
    if text is None:
        return None
    try:
        read = [float(word) for word in text.split(",")]
    except ValueError:
        raise ModelError(f"{what} {text!r}: must be a number, or one for each joint with commas between") from None
    return read[0] if len(read) == 1 else read


@as_command()
def compare(words: list[str]) -> int:
    """Run the command line and return the exit status."""
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
