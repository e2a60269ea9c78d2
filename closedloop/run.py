"""Simulate one scenario: ``closedloop run wam_slide``, or ``python -m closedloop.run wam_slide``.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the simulation could not go on (what ran
until then is saved, and the line says when and why); 4 the run ended, but its verdict is bad, with --strict; 130
interrupted by Ctrl-C, 143 by SIGTERM (what ran is saved).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from closedloop.command.border import DONE, NOT_GOOD, Parser, run_command
from closedloop.command.help import list_of_sections, scenario_parser
from closedloop.command.lists import list_of_scenarios, versions
from closedloop.command.user_module import import_law
from closedloop.errors import (
    ClosedLoopError,
    InterruptedRunError,
    OutputError,
    ScenarioError,
    SimulationError,
    lines_of,
    one_line,
)
from closedloop.interrupts import Terminated, word_for
from closedloop.scenario.load import load_scenario, parse_scenario
from closedloop.scenario.members import member_digests
from closedloop.scenario.overrides import split_overrides
from closedloop.scenario.scenario import Scenario

if TYPE_CHECKING:
    from closedloop.record.run import Run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return run_command("closedloop", _main, arguments)


def _main(arguments: list[str]) -> int:
    overrides, rest = split_overrides(arguments)
    if any(isinstance(value, str) and ":" in value for value in overrides.values()):
        from closedloop.command.user_module import name_members

        name_members(overrides.items())
    options = _parser().parse_args(rest)
    if options.version:
        print(versions())
        return DONE
    if options.list:
        print(list_of_scenarios())
        return DONE
    if options.scenario is None:
        raise ScenarioError(
            "command line: name a scenario, such as wam_slide, wam_touchdown or panda_slide; --list lists them"
        )
    try:
        scenario, model, earlier = _open(options.scenario, overrides)
    except ScenarioError as error:
        raise ScenarioError(*error.faults, *_fault_of_out(options.out)) from None
    law = import_law(options.law) if options.law else None
    if law is None and earlier is not None and earlier.law != "scenario":
        raise ScenarioError(
            f"{options.scenario}: was made with the law {earlier.law}, which a run file does not carry; "
            "add --law MODULE:FUNCTION"
        )

    from closedloop.command.results import Results
    from closedloop.engines.law_source import fresh, law_digest
    from closedloop.record.save import question
    from closedloop.simulation.prepare import load_model
    from closedloop.simulation.simulate import check_engine, simulate

    engine = options.engine or (earlier.engine if earlier else "pinocchio")
    check_engine(scenario, engine, law)
    model = load_model(scenario) if model is None else model
    digest = "" if law is None else law_digest(law)
    folder = Path(options.out) if options.out else Path("out") / scenario.name
    members = member_digests(scenario)
    inputs = question(scenario, model, options.law or "scenario", digest, engine, members)
    try:
        results = Results(folder, inputs, options.overwrite)
    except OutputError as error:
        if faults := _faults_of(scenario, model):
            raise ScenarioError(*faults, str(error)) from None
        raise
    if earlier is not None:
        _warn_of_other_texts(options.scenario, earlier, {options.law or "": digest, **members})
    if law is None:
        _warn_of_gains(scenario, model)
    failure: SimulationError | None = None
    try:
        with redirect_stdout(sys.stderr):  # what a law prints is no result
            run = simulate(scenario, law=fresh(law), model=model, progress=not options.json, engine=engine)
    except SimulationError as error:
        if error.run is None or (isinstance(error, InterruptedRunError) and len(error.run) == 0):
            raise
        run, failure = error.run, error
    if options.law:
        run = replace(run, law=options.law)
    paths = results.save(run, failure)
    if isinstance(failure, InterruptedRunError):
        where = f"what ran is in {folder}{os.sep}" if paths else f"{folder}{os.sep} holds more of this run already"
        raise InterruptedRunError(f"{failure}; {where}", failure.time, run) from failure.__cause__
    if not options.no_figures:
        paths += _draw(run, folder, failure, law, model)
    if options.json:
        print(json.dumps(run.summary(), indent=2, allow_nan=False))
    else:
        from closedloop.report import print_report

        print_report(run)
        steps = max(0, len(run) - 1)
        print(f"{steps} steps in {run.wall_seconds:.2g} s; wrote {folder}{os.sep}: {', '.join(p.name for p in paths)}")
    if failure:
        raise failure
    return NOT_GOOD if options.strict and not run.summary()["verdict"]["good"] else DONE


def _fault_of_out(out: str | None) -> list[str]:
    """Return why nothing can be written there, where the scenario is at fault already; nothing is made."""
    from closedloop.command.results import why_not_writable

    why = "" if out is None else why_not_writable(Path(out))
    return [why] if why else []


def _faults_of(scenario: Scenario, model: Any) -> tuple[str, ...]:
    """Return what is at fault with a scenario that has been read: it cannot be prepared."""
    from closedloop.jit.interpreted import not_compiled_first
    from closedloop.simulation.prepare import prepare

    try:
        with not_compiled_first():
            prepare(scenario, model)
    except ClosedLoopError as error:
        return lines_of(error)
    return ()


def _draw(run: Run, folder: Path, failure: SimulationError | None, law: Any, model: Any) -> list[Path]:
    from closedloop.figures import draw_figures, is_papers

    try:
        if failure or not is_papers(run):
            return draw_figures(run, folder)
        return draw_figures(run, folder, lambda: _without_stabiliser(run.scenario, law, model, run.engine))
    except KeyboardInterrupt as stop:
        said = f"{word_for(stop)} while drawing; run.nc and summary.json are in {folder}{os.sep}"
        raise type(stop)(said) if isinstance(stop, Terminated) else KeyboardInterrupt(said) from None


def _parser() -> Parser:
    parser = scenario_parser(
        "closedloop run",
        "SCENARIO",
        description="Simulate a robot arm whose tip is in contact with a surface.",
        epilog=list_of_sections()
        + "\n\nexit status: 0 done; 2 the input is at fault; 3 the simulation could not go on;\n"
        "4 a bad verdict, with --strict; 130 Ctrl-C, 143 SIGTERM. What ran is saved.",
        cure="a key of the scenario is set as --law.force 15; see --help",
    )  # fmt: skip
    add = parser.add_argument
    add("scenario", nargs="?", metavar="SCENARIO", help="a shipped name, a .toml file, or a run.nc to repeat")
    add("--version", action="store_true", help="print the versions that a run depends on")
    add("--list", action="store_true", help="list the shipped scenarios")
    add("--out", metavar="DIR", help="where results go (default: out/SCENARIO)")
    add("--overwrite", action="store_true", help="replace results of another run in that folder")
    add("--no-figures", action="store_true", help="write run.nc and summary.json only")
    add("--json", action="store_true", help="print the summary as JSON instead of tables")
    add("--strict", action="store_true", help="exit with status 4 if the run's verdict is bad")
    add("--engine", choices=("pinocchio", "compiled"), help="whose H, C, r, J (default pinocchio)")
    add("--law", metavar="MODULE:NAME", help="law(x) or law(t, q, v, terms) of your own as the law")
    return parser


def _open(name: str, overrides: dict[str, Any]) -> tuple[Scenario, Any, Run | None]:
    """Return the scenario, and the robot and the run if it came from a run file."""
    if not name.endswith(".nc"):
        return load_scenario(name, overrides), None, None
    from closedloop.record.load import load_run

    earlier = load_run(name)
    scenario = parse_scenario(earlier.scenario.to_toml(), where=name, overrides=overrides)
    changed = any(key.startswith("robot.") and key != "robot.tip" for key in overrides)
    return scenario, None if changed else earlier.model, earlier


def _warn_of_other_texts(file: str, earlier: Run, now: dict[str, str]) -> None:
    """Say which of the user's functions and classes, MODULE:NAME to digest, have another text than in a run file."""
    before = {earlier.law: earlier.law_digest, **earlier.member_digests}
    for name, digest in now.items():
        if digest != before.get(name, "") != "":
            print(f"closedloop: the text of {name} is not the one that {file} was made with", file=sys.stderr)


def _warn_of_gains(scenario: Scenario, model: Any) -> None:
    """Say before anything is simulated that the step cannot carry the gains; contact may, so it is no refusal."""
    from closedloop.scenario.arm import robot_of
    from closedloop.scenario.gains import gains_fault

    try:
        fault = gains_fault(scenario, robot_of(scenario, model))
    except ScenarioError:  # it cannot be prepared, and `simulate` says why
        return
    if fault:
        print(f"closedloop: warning: {one_line(fault)}", file=sys.stderr, flush=True)


def _without_stabiliser(scenario: Scenario, law: Any, model: Any, engine: str) -> Any:
    """Run the scenario without its stabiliser, for Fig. 7; None if it has none, or cannot do without."""
    from closedloop.engines.law_source import fresh
    from closedloop.simulation.simulate import simulate

    if scenario.stabiliser.kind == "none":
        return None
    plain = parse_scenario(scenario.to_toml(), where=scenario.name, overrides={"stabiliser.kind": "none"})
    try:
        with redirect_stdout(sys.stderr):
            return simulate(plain, law=fresh(law), model=model, engine=engine)
    except InterruptedRunError:
        raise
    except SimulationError:
        return None


if __name__ == "__main__":
    sys.exit(main())
