"""What `closedloop run` simulates: the run, the same at half the step, and the same without its stabiliser.

And the warnings on standard error before it; none of them stops the run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from closedloop.base.errors import (
    ClosedLoopError,
    InterruptedRunError,
    ScenarioError,
    SimulationError,
    one_line,
    printable,
)
from closedloop.base.second_process import Beside
from closedloop.scenario.scenario import Scenario

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


def simulated(job: Job, progress: bool) -> tuple[Run, SimulationError | None]:
    """Return the run, or what there is of one that could not go on, and why it could not."""
    from closedloop.simulation.engines.law_source import fresh
    from closedloop.simulation.simulate import simulate

    asked = {"model": job.model, "progress": progress, "engine": job.engine, "record": job.columns}
    try:
        with redirect_stdout(sys.stderr):  # what a law prints is no result
            return simulate(job.scenario, law=fresh(job.law), **asked), None
    except SimulationError as error:
        if error.run is None or (isinstance(error, InterruptedRunError) and len(error.run) == 0):
            raise
        return error.run, error


def halved(job: Job, run: Run, failure: SimulationError | None, progress: bool) -> tuple[Run, SimulationError | None]:
    """Return the run with its comparison with one at half the step, and its failure.

    There is none if it was interrupted, or if it cannot be run at half the step.
    """
    if isinstance(failure, InterruptedRunError):
        return run, failure
    from closedloop.simulation.simulate import beside_half

    try:
        with redirect_stdout(sys.stderr):
            return beside_half(run, law=job.law, model=job.model, progress=progress), failure
    except InterruptedRunError as error:
        return run, error
    except ScenarioError:  # it cannot be run at half the step: the run itself stands
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
        except InterruptedRunError:
            raise
        except SimulationError:
            return None
        if isinstance(failure, InterruptedRunError):
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
            print(printable(said), file=sys.stderr)


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
    from closedloop.scenario.collision import hulls_taken

    try:
        lines = hulls_taken(scenario, model)
    except ClosedLoopError:  # it cannot be prepared, and `simulate` says why
        return
    for line in lines:
        print(f"closedloop: warning: {one_line(line)}", file=sys.stderr, flush=True)


def warn_of_gains(scenario: Scenario, model: Any) -> None:
    """Say before anything is simulated that the step does not carry or resolve the gains; contact may: no refusal."""
    from closedloop.scenario.arm import robot_of
    from closedloop.scenario.modes import gains_fault, unresolved_feedback

    try:
        robot = robot_of(scenario, model)
        fault = gains_fault(scenario, robot)
        faults = [fault] if fault else unresolved_feedback(scenario, robot)
    except ScenarioError:  # it cannot be prepared, and `simulate` says why
        return
    for fault in faults:
        print(f"closedloop: warning: {one_line(fault)}", file=sys.stderr, flush=True)
