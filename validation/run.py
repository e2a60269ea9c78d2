"""The command line of the harness: ``python -m validation.run``.

Exit status: 0 everything compared is within its tolerance; 1 something is not, or a planted fault went unseen; 2 the
input is at fault (one line on standard error).
"""

import argparse
import importlib
import sys
import time
from pathlib import Path
from typing import Any

from closedloop.base.errors import OutputError
from closedloop.base.files import write_whole
from closedloop.command.border import Parser, as_command
from robot_models import ClosedLoopError, ModelError

PASSED, FAILED, BAD_INPUT = 0, 1, 2


class InputError(ClosedLoopError, ValueError):
    """An argument is at fault."""


@as_command("validation", stopped=())
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    options = _parser().parse_args(words)
    for name in ("states", "seed", "state"):
        value = getattr(options, name)
        if value is not None and value < (1 if name == "states" else 0):
            raise InputError(f"--{name} {value}: must be {'at least 1' if name == 'states' else 'zero or more'}")
    files = {kind: Path(path) for kind in ("json", "html", "markdown") if (path := getattr(options, kind))}
    for kind, path in files.items():
        if not path.parent.is_dir() or path.is_dir():
            raise InputError(f"--{kind} {path}: cannot be written: name a file in a folder that exists")
    began = time.perf_counter()
    report = _plant(options) if options.plant else _compare(options)
    report.command = f"python -m validation.run {' '.join(words)}".strip()
    report.details = options.details
    report.show()
    print(f"{time.perf_counter() - began:.1f} s")
    for kind, path in files.items():
        text = {"json": report.to_json, "html": report.to_html, "markdown": report.to_markdown}[kind]()
        try:
            write_whole(path, f"{text}\n".encode(errors="backslashreplace"))
        except OutputError as error:
            raise InputError(f"--{kind} {error}") from None
    return PASSED if report.passed else FAILED


def _parser() -> Parser:
    parser = Parser(
        prog="python -m validation.run",
        description="Compare every quantity of the simulator with engines that share nothing with it.",
        epilog="exit status: 0 all within tolerance; 1 something is not, or a fault was not detected; 2 bad input",
    )
    parser.add_argument(
        "--robot", help="only this robot: a name in the report, any that robot_models loads, random:SEED, or a file"
    )
    parser.add_argument("--tip", help="frame to compare at (default: the robot's own)")
    parser.add_argument("--states", type=int, help="states a robot (default 1000, or 50 with --quick)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the states (default 0)")
    parser.add_argument("--state", type=int, help="only this state of the seed, with --robot")
    parser.add_argument("--quick", action="store_true", help="few states and no slide: some seconds")
    parser.add_argument("--details", action="store_true", help="print a line for each quantity of each engine")
    parser.add_argument("--plant", action="store_true", help="plant faults and show which comparison detects each")
    parser.add_argument("--engine", metavar="MODULE:CLASS", help="compare this engine too (see CONTRIBUTING.md)")
    parser.add_argument("--json", metavar="FILE", help="write every value")
    parser.add_argument("--html", metavar="FILE", help="write the tables as a page")
    parser.add_argument("--markdown", metavar="FILE", help="write the tables for a paper's appendix")
    return parser


def _compare(options: argparse.Namespace) -> Any:
    from validation.comparison import compare
    from validation.report import Report
    from validation.suite import check_robot_identities, compare_with_truth, load_robot, run_suite

    states = options.states or (50 if options.quick else 1000)
    engines = [_engine(options.engine)] if options.engine else []
    if options.robot is None:
        if options.state is not None or options.tip is not None:
            raise InputError("--state and --tip need --robot: they belong to one robot")
        return run_suite(states=states, seed=options.seed, quick=options.quick, engines=engines, say=say)
    model = load_robot(options.robot)
    report = Report()
    if options.state is not None:
        found = compare(
            model, options.tip, states=[options.state], seed=options.seed, engines=engines, label=options.robot
        )
        report.comparisons.append(found)
        return report
    report.comparisons += compare_with_truth(model, options.tip, states, options.seed, engines, options.robot)
    report.sections.append(check_robot_identities(model, report.comparisons[0].tip, 2, options.seed))
    return report


def _plant(options: argparse.Namespace) -> Any:
    from validation.bodies import plant_on_bodies
    from validation.contacts import plant_on_contacts
    from validation.loops.compare import plant_on_loops
    from validation.plant import plant_all, plant_runs
    from validation.report import Report
    from validation.suite import faults_section, load_robot
    from validation.surfaces.answers import plant_on_surfaces

    say("planting faults")
    catches = plant_all(load_robot(options.robot or "wam4"), options.tip, seed=options.seed)
    sections = [faults_section(options.robot or "wam4", catches)]
    if options.robot is None:
        sections.append(faults_section("free bodies", plant_all(load_robot("free bodies"), seed=options.seed)))
        sections.append(faults_section("wam_slide, run by the compiled engine", plant_runs()))
        sections.append(faults_section("panda on curved, moving and soft surfaces", plant_on_surfaces()))
        sections.append(faults_section("mechanisms with loops", plant_on_loops()))
        sections.append(faults_section("several contacts", plant_on_contacts()))
        sections.append(faults_section("runs of free bodies, and of what rolls", plant_on_bodies()))
    return Report(sections=sections)


def _engine(name: str) -> Any:
    """Import a user's engine class, which must be asked for by name on the command line."""
    from closedloop.scenario.user_module import importing
    from validation.engines import Engine

    wanted = "MODULE:CLASS of a subclass of validation.engines.Engine"
    with importing("--engine", name, wanted) as (module, class_name):
        found = getattr(importlib.import_module(module), class_name, None)
    if not (isinstance(found, type) and issubclass(found, Engine)):
        raise InputError(f"--engine {name}: must be {wanted}")
    return found


def say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\033[2K{text} ...", end="\r", file=sys.stderr, flush=True)


__all__ = ["InputError", "ModelError", "main"]

if __name__ == "__main__":
    sys.exit(main())
