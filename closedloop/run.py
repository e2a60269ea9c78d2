"""Simulate one scenario: ``closedloop run wam_slide``, or ``python -m closedloop.run wam_slide``.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the simulation could not go on (what ran
until then is saved, and the line says when and why); with --strict, 4 the run ended, but the verdict of its
numbers is bad, 5 that of its control alone; 130 interrupted by Ctrl-C, 143 by SIGTERM (what ran is saved).

It simulates the run, the same at half the step, and for Fig. 7 the same without its stabiliser. No warning that it
prints before them stops it.
"""

from __future__ import annotations

import json
import os
import sys
from argparse import BooleanOptionalAction, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from closedloop.base import errors
from closedloop.base.files import what_was_written
from closedloop.base.interrupts import Terminated, word_for
from closedloop.base.second_process import Beside
from closedloop.command.border import (
    DONE,
    NOT_CONTROLLED,
    NOT_GOOD,
    Parser,
    as_command,
    list_of_sections,
    scenario_parser,
)
from closedloop.command.lists import list_of_scenarios, versions
from closedloop.scenario.load import load_scenario, parse_scenario, split_overrides
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import import_function, import_law, member_digests

if TYPE_CHECKING:
    from closedloop.record.run import Run


class Job(NamedTuple):
    """What is to be simulated, with which law and engine, and where the results go.

    `law` is None for the scenario's own, `law_name` what the record calls it; `earlier` is the run that is repeated;
    `columns` are functions of the run by the names of the columns that they add.
    """

    scenario: Scenario
    model: Any
    law: Any
    law_name: str
    digest: str
    members: dict[str, str]
    engine: str
    folder: Path
    earlier: Run | None
    columns: dict[str, Any]


def simulated(job: Job, progress: bool) -> tuple[Run, errors.SimulationError | None]:
    """Return the run, or what there is of one that could not go on, and why it could not."""
    from closedloop.simulation.engines.law_source import fresh
    from closedloop.simulation.simulate import simulate

    asked = {"model": job.model, "progress": progress, "engine": job.engine, "record": job.columns}
    try:
        with redirect_stdout(sys.stderr):  # what a law prints is no result
            return simulate(job.scenario, law=fresh(job.law), **asked), None
    except errors.SimulationError as error:
        if error.run is None or (isinstance(error, errors.InterruptedRunError) and len(error.run) == 0):
            raise
        return error.run, error


def halved(
    job: Job, run: Run, failure: errors.SimulationError | None, progress: bool
) -> tuple[Run, errors.SimulationError | None]:
    """Return the run with its comparison with one at half the step, and its failure.

    There is none if it was interrupted, or if it cannot be run at half the step.
    """
    if isinstance(failure, errors.InterruptedRunError):
        return run, failure
    from closedloop.simulation.simulate import beside_half

    try:
        with redirect_stdout(sys.stderr):
            return beside_half(run, law=job.law, model=job.model, progress=progress), failure
    except errors.InterruptedRunError as error:
        return run, error
    except errors.ScenarioError:  # it cannot be run at half the step: the run itself stands
        return run, failure


@contextmanager
def without_stabiliser(job: Job, wanted: bool) -> Iterator[Callable[[], Any] | None]:
    """Yield what gives the same scenario without its stabiliser, for Fig. 7; None where there is no such figure.

    A run takes seconds while its loop is not compiled yet: the two are then simulated side by side.
    """
    if not wanted or job.scenario.stabiliser.kind == "none":
        yield None
        return
    from closedloop.figures import closure_error, images_of, is_papers
    from closedloop.jit import background
    from closedloop.jit.interim import at_hand
    from closedloop.simulation.engines.loops import loop_for

    if not is_papers(job.scenario.name):
        yield None
        return
    plain = job.scenario.replace({"stabiliser.kind": "none"})

    def again() -> Run | None:
        try:
            run, failure = simulated(job._replace(scenario=plain), progress=False)
        except errors.InterruptedRunError:
            raise
        except errors.SimulationError:
            return None
        if isinstance(failure, errors.InterruptedRunError):
            raise failure
        return None if failure else run

    def drawn() -> Any:
        background.left_to_another = True
        run = again()
        return run and images_of(closure_error, run)

    if at_hand(loop_for(job.engine)):
        yield again
        return
    beside = Beside(drawn)
    try:
        yield beside.result
    finally:
        beside.stop()


def warn_of_other_texts(file: str, earlier: Run, now: dict[str, str]) -> None:
    """Say which of the user's functions and classes, MODULE:NAME to digest, have another text than in a run file."""
    before = {earlier.law: earlier.law_digest, **earlier.member_digests}
    for name, digest in now.items():
        if digest != before.get(name, "") != "":
            said = f"closedloop: the text of {name} is not the one that {file} was made with"
            print(errors.printable(said), file=sys.stderr)


def warn_of_no_surface(scenario: Scenario) -> None:
    """Say which sections and which force are about the tip's contact, where there is no surface for it."""
    if scenario.has_surface:
        return
    force = getattr(scenario.law, "force", 0.0)
    if force and not scenario.contact:
        said = f"law.force = {force:g}: there is no [surface], so the tip presses on nothing; add one, or leave it out"
        print(f"closedloop: warning: {said}", file=sys.stderr)
    idle = [name for name in ("friction", "compliance", "surface_motion") if getattr(scenario, name).kind != "none"]
    if idle:
        named = " and ".join(f"[{name}]" for name in idle)
        print(f"closedloop: warning: {named}: there is no [surface], so nothing acts at the tip", file=sys.stderr)


def warn_of_hulls(scenario: Scenario, model: Any) -> None:
    """Say which collision meshes are not convex, so that their hulls touch."""
    from closedloop.scenario.arm import hulls_taken

    try:
        lines = hulls_taken(scenario, model)
    except errors.ClosedLoopError:  # it cannot be prepared, and `simulate` says why
        return
    for line in lines:
        print(f"closedloop: warning: {errors.one_line(line)}", file=sys.stderr, flush=True)


def warn_of_gains(scenario: Scenario, model: Any) -> None:
    """Say before anything is simulated that the step does not carry or resolve the gains; contact may: no refusal."""
    from closedloop.scenario.arm import robot_of
    from closedloop.scenario.modes import gains_fault, unresolved_feedback

    try:
        robot = robot_of(scenario, model)
        fault = gains_fault(scenario, robot)
        faults = [fault] if fault else unresolved_feedback(scenario, robot)
    except errors.ScenarioError:  # it cannot be prepared, and `simulate` says why
        return
    for fault in faults:
        print(f"closedloop: warning: {errors.one_line(fault)}", file=sys.stderr, flush=True)


# What --record says before the joint of a wrench, and before the name of a contact.
WRENCH, CONTACT = "wrench", "contact"

if TYPE_CHECKING:
    from closedloop.command.results import Results
    from closedloop.record.run import Run


@as_command()
def main(arguments: list[str]) -> int:
    """Run the command line and return the exit status."""
    overrides, rest = split_overrides(arguments)
    if any(isinstance(value, str) and ":" in value for value in overrides.values()):
        from closedloop.scenario.user_module import name_members

        name_members(overrides.items())
    options = _parser().parse_args(rest)
    if options.version:
        print(versions())
        return DONE
    if options.list:
        print(list_of_scenarios())
        return DONE
    if options.scenario is None:
        raise errors.ScenarioError(
            "command line: name a scenario, such as wam_slide, wam_touchdown or panda_slide; --list lists them"
        )
    return _run(options, overrides)


def _run(options: Namespace, overrides: dict[str, Any]) -> int:
    """Simulate what the command line asks for, save, draw and report it, and return the exit status."""
    job = _job(options, overrides)
    with _results(job, options) as results:
        return _run_into(results, job._replace(folder=results.folder), options)


def _run_into(results: Results, job: Job, options: Namespace) -> int:
    if job.earlier is not None:
        warn_of_other_texts(options.scenario, job.earlier, {options.law or "": job.digest, **job.members})
    if job.law is None:
        warn_of_gains(job.scenario, job.model)
        warn_of_no_surface(job.scenario)
    with without_stabiliser(job, not options.no_figures) as unstabilised:
        run, failure = simulated(job, progress=not options.json)
        if options.halve or (options.halve is None and not failure):
            run, failure = halved(job, run, failure, progress=not options.json)
        if options.law:
            run = replace(run, law=options.law)
        paths = results.save(run, failure)
        if isinstance(failure, errors.InterruptedRunError):
            said = f"what ran is in {job.folder}{os.sep}"
            said = said if paths else f"{job.folder}{os.sep} holds more of this run already"
            raise errors.InterruptedRunError(f"{failure}; {said}", failure.time, run) from failure.__cause__
        if not options.no_figures:
            paths += _draw(run, job.folder, None if failure else unstabilised)
    if options.json:
        print(json.dumps(run.summary(), indent=2, allow_nan=False))
        if results.not_first:  # standard output is for the summary
            said = f"closedloop: wrote {job.folder}{os.sep}; {results.not_first}"
            print(errors.printable(said), file=sys.stderr)
    else:
        from closedloop.record.report import print_report

        print_report(run, comparison=bool(options.halve))
        beside = results.not_first and errors.printable(f"; {results.not_first}")
        wrote = what_was_written(*paths, folder=job.folder) + beside
        print(f"{max(0, len(run) - 1)} steps in {run.wall_seconds:.2g} s; {wrote}")
    if failure:
        raise failure
    facts = run.summary()
    if options.strict and not facts["verdict"]["good"]:
        return NOT_GOOD
    return NOT_CONTROLLED if options.strict and not facts["control_verdict"]["good"] else DONE


def _job(options: Namespace, overrides: dict[str, Any]) -> Job:
    try:
        scenario, model, earlier = _open(options.scenario, overrides)
    except errors.ScenarioError as error:
        from closedloop.command.results import why_not_writable

        why = why_not_writable(Path(options.out)) if options.out else ""  # of both faults at once; nothing is made
        raise errors.ScenarioError(*error.faults, *filter(None, [why])) from None
    law = import_law(options.law) if options.law else None
    if law is None and earlier is not None and earlier.law != "scenario":
        raise errors.ScenarioError(
            f"{options.scenario}: was made with the law {earlier.law}, which a run file does not carry; "
            "add --law MODULE:FUNCTION"
        )

    from closedloop.scenario.arm import with_collision_shapes
    from closedloop.simulation.engines.law_source import law_digest
    from closedloop.simulation.prepare import load_model
    from closedloop.simulation.simulate import check_engine

    engine = options.engine or (earlier.engine if earlier else "pinocchio")
    check_engine(scenario, engine, law)
    if options.halve:
        _refuse_to_halve(scenario)
    model = load_model(scenario) if model is None else model
    warn_of_hulls(scenario, model)
    return Job(
        scenario=with_collision_shapes(scenario, model),
        model=model,
        law=law,
        law_name=options.law or "scenario",
        digest="" if law is None else law_digest(law),
        members=member_digests(scenario),
        engine=engine,
        folder=Path(options.out) if options.out else Path("out") / scenario.name,
        earlier=earlier,
        columns=_columns(options.record, model),
    )


def _columns(names: list[str], model: Any) -> dict[str, Any]:
    """Return the functions that --record names, by the names of their columns: one's own, and wrenches at joints."""
    columns: dict[str, Any] = {}
    for name in names:
        kind, _, joint = name.partition(":")
        own = kind not in (WRENCH, CONTACT)
        column = name.rpartition(":")[2] if own else "".join(x if x.isalnum() else "_" for x in name)[:60]
        if column in columns:
            raise errors.ScenarioError(f"--record {name}: there is a column {column!r} already: use another name")
        if own:
            columns[column] = import_function("--record", name, "my_columns:spring_power")
        else:
            columns[column] = _wrench(joint, model) if kind == WRENCH else _contact(joint)
    return columns


def _contact(name: str) -> Any:
    """Return what works out the wrench of a contact, with its centre of pressure, and its unit."""

    def contact(run: Run) -> Any:
        return run.contact_wrench(name)

    contact.__doc__ = f"force, moment and centre of pressure of {name}, axes of the base"
    return contact, "N | N m | m"


def _wrench(word: str, model: Any) -> Any:
    """Return what works out the wrench JOINT[@FRAME], and its unit."""
    from closedloop.record.columns.derived import check_joint

    joint, _, given = word.partition("@")
    frame = given or "joint"
    check_joint(model, joint, frame)

    def wrench(run: Run) -> Any:
        return run.joint_wrench(joint, frame)

    wrench.__doc__ = f"force and moment of the inner on the outer side of {joint}, axes of {frame}"
    return wrench, "N | N m"


def _refuse_to_halve(scenario: Scenario) -> None:
    """Say why a scenario cannot be run at half its step, before it is run at all."""
    from closedloop.loop.step.record_row import Row
    from closedloop.simulation.simulate import half_step
    from closedloop.simulation.time_step import steps_and_hold

    try:
        half = half_step(scenario)
        steps_and_hold(half, half.law.sample_period, Row.count(1))
    except errors.ScenarioError as error:
        raise errors.ScenarioError(*(f"--halve: {fault}" for fault in error.faults)) from None


def _results(job: Job, options: Namespace) -> Results:
    """Return where the results go, saying what is at fault with the scenario too if they cannot go there."""
    from closedloop.command.results import Results, first_free
    from closedloop.record.save import question
    from closedloop.simulation.prepare import completed

    scenario = job.scenario
    with suppress(errors.ClosedLoopError):  # what is at fault is said by the run
        scenario = completed(scenario, job.model)
    inputs = question(scenario, job.model, job.law_name, job.digest, job.engine, job.members)
    try:
        return (Results if options.out else first_free)(job.folder, inputs, options.overwrite)
    except errors.OutputError as error:
        if faults := _faults_of(job.scenario, job.model):
            raise errors.ScenarioError(*faults, str(error)) from None
        raise


def _faults_of(scenario: Scenario, model: Any) -> tuple[str, ...]:
    """Return what is at fault with a scenario that has been read: it cannot be prepared."""
    from closedloop.jit.interim import not_compiled_first
    from closedloop.simulation.prepare import prepare

    try:
        with not_compiled_first():
            prepare(scenario, model)
    except errors.ClosedLoopError as error:
        return errors.lines_of(error)
    return ()


def _draw(run: Run, folder: Path, unstabilised: Callable[[], Any] | None) -> list[Path]:
    from closedloop.figures import draw_figures

    try:
        return draw_figures(run, folder, unstabilised)
    except KeyboardInterrupt as stop:
        said = f"{word_for(stop)} while drawing; run.nc and summary.json are in {folder}{os.sep}"
        raise type(stop)(said) if isinstance(stop, Terminated) else KeyboardInterrupt(said) from None


def _parser() -> Parser:
    parser = scenario_parser(
        "closedloop run",
        "SCENARIO",
        description="Simulate a robot arm whose tip is in contact with a surface.",
        epilog=list_of_sections()
        + "\nexit status: 0 done; 2 the input is at fault; 3 the simulation could not go on;\n"
        "with --strict 4, a bad verdict, or 5, of the control; 130 Ctrl-C, 143 SIGTERM.",
        cure="a key of the scenario is set as --law.force 15; see --help",
    )  # fmt: skip
    add = parser.add_argument
    add("scenario", nargs="?", metavar="SCENARIO", help="a shipped name, a .toml file, or a run.nc to repeat")
    add("--version", action="store_true", help="print the versions that a run depends on")
    add("--list", action="store_true", help="list the shipped scenarios")
    add("--out", metavar="DIR", help="where results go (default: out/SCENARIO, -2 ...)")
    add("--overwrite", action="store_true", help="replace results of another run in that folder")
    add("--no-figures", action="store_true", help="write run.nc and summary.json only")
    add("--json", action="store_true", help="print the summary as JSON instead of tables")
    add("--halve", action=BooleanOptionalAction, help="print the comparison at half the step, or omit it")
    add("--strict", action="store_true", help="exit with status 4 or 5 if a verdict is bad")
    engines = ("pinocchio", "compiled")
    add("--engine", choices=engines, metavar="ENGINE", help="source of H, C, r, J: pinocchio (default), compiled")
    add("--law", metavar="MODULE:NAME", help="law(x) or law(t, q, v, terms) of your own as the law")
    parser.options({"--record MODULE:NAME ...": "column: wrench:JOINT[@FRAME], contact:NAME, or own"})
    return parser


def _open(name: str, overrides: dict[str, Any]) -> tuple[Scenario, Any, Run | None]:
    """Return the scenario, and the robot and the run if it came from a run file."""
    if not name.endswith(".nc"):
        return load_scenario(name, overrides), None, None
    from closedloop.record.run import load_run
    from closedloop.scenario.arm import is_of_model

    earlier = load_run(name)
    scenario = parse_scenario(earlier.scenario.to_toml(), where=name, overrides=overrides)
    changed = any(map(is_of_model, overrides))
    return scenario, None if changed else earlier.model, earlier


if __name__ == "__main__":
    sys.exit(main())
