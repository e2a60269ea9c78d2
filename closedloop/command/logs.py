"""Gains and logs: the commands of the studies.

``closedloop analyse wam_hybrid_friction --at 3`` has the margins of the force loop and its limits, ``closedloop tune
wam_slide --vary law.kd=5:200 --minimise rms_force_error`` finds the best by an optimiser. ``identify LOG --robot R``
finds parameters of a robot, ``compare LOG --scenario S`` sets a log beside a run, ``excite --robot R`` designs the
motion of one that identifies parameters best.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the run stops before its end, or before the
instant, there is no linear loop at it, or no point that was tried meets the constraints.
"""

from __future__ import annotations

import argparse
import json
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from closedloop.base.arrays import plain
from closedloop.base.errors import ClosedLoopError, ModelError, ScenarioError, needs, printable
from closedloop.base.files import made_folder, what_was_written, write_whole
from closedloop.command import border
from closedloop.command.border import DONE, Parser, as_command, parsed, print_outcome

if TYPE_CHECKING:
    from closedloop.studies.analysis.stability import Range, Stability
    from robot_models import RobotModel


# Values of a range that does not say how many, and where whole runs are tried beside a boundary.
POINTS, TRIED = 60, (0.25, 0.5, 0.75)


@border.as_command()
def analyse(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.scenario.load import load_scenario

    parser = border.Parser(
        prog="closedloop analyse",
        description="Linearise the force loop about its motion: margins, poles, and where it becomes unstable.",
        cure="such as: closedloop analyse wam_hybrid_friction --at 3",
    )
    parser.add_argument("scenario", help="a scenario that ships, or a .toml; --SECTION.KEY VALUE changes it")
    table = {
        "--at T": "the instant, s (default: half of the duration)",
        "--out DIR": "where figures and analysis.json go (default: none are written)",
        "--json": "print analysis.json instead",
        "--vary KEY=RANGE ...": "a key and its range, such as compliance.stiffness=log:1e2:1e7 or "
        "law.force_integral=0:80:40: the limits in it are solved for; given twice, the boundary over both",
        "--no-runs": "do not try whole runs beside the limits",
    }
    parser.options(table, at=float)
    border.add_figure_options(parser)
    options, overrides = border.parsed(parser, words)
    border.formats_of(options)
    style = border.drawn_as(options)
    if len(options.vary) > 2:
        raise ScenarioError("command line: --vary: at most two keys, one that is solved for and one along it")
    ranges = [_range(text) for text in options.vary]
    folder = made_folder(options.out) if options.out else None

    from closedloop.studies.analysis.here import refuse_outside
    from closedloop.studies.analysis.stability import Stability

    scenario = load_scenario(options.scenario, overrides)
    if options.at is not None:
        refuse_outside(scenario, options.at, "command line: --at")
    study = Stability(scenario, options.at)
    with style:
        _analyse(study, ranges, folder, options)
    return border.DONE


def _analyse(study: Stability, ranges: list[tuple[Range, int]], folder: Path | None, options: Namespace) -> None:
    """Print what is asked of a force loop, and write it into a folder, if there is one."""
    from closedloop.studies.analysis.page import page_of

    page = page_of(study, limits=not ranges)
    lines, found, drawn = _varied(study, ranges, not options.no_runs, folder is not None) if ranges else ([], {}, [])
    report = page.as_dict() | found
    if options.json:
        print(json.dumps(report, indent=2, allow_nan=False))
    else:
        print("\n".join([*page.lines(), *lines]))
    if folder is not None:
        from closedloop.figures.files import write_figure
        from closedloop.studies.analysis.page import draw_page

        paths = [write_whole(folder / "analysis.json", (json.dumps(report, indent=2) + "\n").encode())]
        paths += draw_page(page, folder, border.formats_of(options))
        paths += [write_figure(figure, folder / name, border.formats_of(options)) for name, figure in drawn]
        if not options.json:
            print(what_was_written(*paths))


def _range(text: str) -> tuple[Range, int]:
    """Read KEY=RANGE, and how many values it has."""
    from closedloop.studies.analysis.stability import Range
    from closedloop.studies.sweep.sweep import parse_range

    axis = parse_range(text, "log:1e2:1e7 or 0:80")
    return Range(axis.key, axis.low, axis.high, axis.log), axis.count or POINTS


def _varied(
    study: Stability, ranges: list[tuple[Range, int]], runs: bool, draw: bool
) -> tuple[list[str], dict[str, Any], list[tuple[str, Any]]]:
    """Return lines, values for JSON and figures of the limits over one key, or the boundary over two."""
    from closedloop.studies.analysis.page import locus, stability_map, trial_line

    over, count = ranges[-1]
    drawn: list[tuple[str, Any]] = []
    if len(ranges) == 1:
        limits, refused = study.limits(over)
        lines = ["", f"{over.key} from {over.low:g} to {over.high:g}:"]
        for limit in limits:
            side = "above" if limit.upwards else "below"
            lines.append(f"  unstable {side} {limit.value:.5g}, at {limit.pole.frequency:.4g} Hz ({limit.pole.part})")
        if not limits:
            lines.append(f"  no limit: the loop is {'stable' if study.base.stable else 'unstable'} there")
        if refused:
            lines.append(f"  beyond that refused: {refused}")
        trials = [trial for limit in limits for trial in study.try_beside(limit)] if runs else []
        if draw:
            drawn = [("analysis_locus", locus(_loops(study, over, count), over, limits, study.scenario))]
        found: dict[str, Any] = {"vary": [over.key], "limits": {over.key: [limit.as_dict() for limit in limits]}}
    else:
        along, points = ranges[0]
        boundary = study.boundary(over, along, points)
        lines = ["", f"{along.key:>24}  {over.key}: limit"]
        shown = boundary[:: max(1, len(boundary) // 12)]
        for value, limit in shown:
            side = "above" if limit.upwards else "below"
            lines.append(f"{value:>24.6g}  unstable {side} {limit.value:.6g} ({limit.pole.frequency:.3g} Hz)")
        if not boundary:
            lines.append("  no limit in these ranges")
        chosen = [boundary[int(share * (len(boundary) - 1))] for share in TRIED] if boundary and runs else []
        trials = [trial for value, limit in chosen for trial in study.try_beside(limit, {along.key: value})]
        if draw:
            here = _here(study, along, over)
            drawn = [("analysis_map", stability_map(boundary, over, along, here, trials, study.scenario))]
        found = {
            "vary": [along.key, over.key],
            "boundary": [{along.key: value} | limit.as_dict() for value, limit in boundary],
        }  # fmt: skip
    found["trials"] = plain([asdict(trial) for trial in trials])
    if trials:
        lines += ["", f"beside it, from t = {study.base.time:g} s on:", *map(trial_line, trials)]
    return lines, found, drawn


def _loops(study: Stability, over: Range, count: int) -> list[tuple[float, Any]]:
    """Return loops along a range; values that are refused are left out."""
    found = []
    for k in range(count):
        value = over.at(k / (count - 1))
        try:
            found.append((value, study.loop({over.key: value})))
        except ClosedLoopError:
            continue
    return found


def _here(study: Stability, *ranges: Range) -> tuple[float, float] | None:
    """Return the scenario's own values of two keys, if they are numbers."""
    values = []
    for each in ranges:
        section, _, name = each.key.partition(".")
        value = getattr(getattr(study.scenario, section, None), name, None)
        if not isinstance(value, int | float):
            return None
        values.append(float(value))
    return values[0], values[1]


@border.as_command()
def tune(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.scenario.load import load_scenario
    from closedloop.studies.sweep.sweep import parse_axis, parse_range

    options, overrides = border.parsed(_parser(), words)
    if not options.vary:
        raise ScenarioError("command line: name what varies, such as --vary law.kd=5:200")
    scenario = load_scenario(options.scenario, overrides)
    ranges = [parse_range(text, "5:200 or log:1:1000") for text in options.vary]
    folder = made_folder(options.out) if options.out else None
    from closedloop.studies.tune import tune as study

    found = {}
    for text in options.minimise or ["rms_force_error"]:
        weight, times, name = text.rpartition("*")
        try:
            found[name.strip()] = float(weight) if times else 1.0
        except ValueError:
            raise ScenarioError(
                f"--minimise {text}: must be a value, or WEIGHT*VALUE, such as 0.1*max_tip_speed"
            ) from None
    over = {axis.key: [axis.at(i) for i in range(len(axis))] for axis in map(parse_axis, options.over)}
    tuning = study.tune(
        scenario, {axis.key: (axis.low, axis.high) for axis in ranges}, found, options.subject_to,
        over=over, robust=options.robust, log=[axis.key for axis in ranges if axis.log],
        starts=options.starts, seed=options.seed, kept=folder / "runs.jsonl" if folder else None, progress=True,
    )  # fmt: skip
    report = border.print_outcome(tuning, options.json)
    if folder is not None:
        from closedloop.figures.files import write_figure

        head = "# " + "\n# ".join(tuning.lines()[:1]) + "\n"
        paths = [
            write_whole(folder / "tuned.toml", (head + tuning.scenario.to_toml()).encode()),
            write_whole(folder / "tune.json", (report + "\n").encode()),
            write_figure(tuning.figure(), folder / "tune"),
        ]
        if not options.json:
            print(what_was_written(*paths))
    return border.DONE if tuning.feasible else border.STOPPED


def _parser() -> border.Parser:
    parser = border.Parser(
        prog="closedloop tune",
        description="Find the gains, or other numbers of a scenario, that minimise a value of its runs.",
        cure="such as: closedloop tune wam_slide --vary law.kd=5:200 --minimise rms_force_error",
    )
    parser.add_argument("scenario", help="a scenario that ships, or a .toml; --SECTION.KEY VALUE changes it")
    vary = "what varies and its range, such as law.kd=5:200, law.kp[1]=log:100:3000; of a list each entry by itself"
    parser.options({"--vary KEY=LOW:HIGH ...": vary})
    parser.add_argument(
        "--minimise", "--minimize", action="append", default=[], metavar="[WEIGHT*]NAME",
        help="a value of the summary (default: rms_force_error); given several times, the weighted sum",
    )  # fmt: skip
    many = "minimise the worst or the mean of all variations"
    parser.add_argument("--robust", choices=("worst", "mean"), default="worst", help=many)
    table = {
        "--subject-to NAME<=NUMBER ...": "a constraint, such as 'peak_contact_force<=12' or 'modulus_margin@3>=0.5'",
        "--over KEY=VALUES ...": "variations under which constraints hold, such as friction.coefficient=0.2,0.4,0.6",
        "--starts N": "searches from different points (4)",
        "--seed N": "seed of these points (0)",
        "--out DIR": "where tuned.toml, tune.json and a figure go; an interrupted tuning continues from its runs.jsonl",
        "--json": "print the report as JSON",
    }
    parser.options(table, starts=4, seed=0)
    return parser


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
    gain, normal = _numbers(options.gain or None, "--gain"), _numbers(options.contact, "--contact")
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


def _numbers(text: str | None, what: str) -> list[float] | None:
    """Read numbers with commas between."""
    try:
        return [float(word) for word in text.split(",")] if text is not None else None
    except ValueError:
        raise ModelError(f"{what} {text!r}: must be a number, or several with commas between") from None


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
