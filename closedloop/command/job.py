"""What `closedloop run` simulates: the run, the same at half the step, and the same without its stabiliser."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from closedloop.base.errors import InterruptedRunError, SimulationError
from closedloop.base.second_process import Beside
from closedloop.scenario.load import parse_scenario
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
    """Return the run with its comparison with one at half the step, unless it was interrupted, and its failure."""
    if isinstance(failure, InterruptedRunError):
        return run, failure
    from closedloop.simulation.halve import beside_half

    try:
        with redirect_stdout(sys.stderr):
            return beside_half(run, law=job.law, model=job.model, progress=progress), failure
    except InterruptedRunError as error:
        return run, error


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
    plain = parse_scenario(
        job.scenario.to_toml(), where=job.scenario.name, overrides={"stabiliser.kind": "none"}
    )  # fmt: skip

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
