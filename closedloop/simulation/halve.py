"""A run, and the same at half the step: by how much each value differs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import InterruptedRunError, ScenarioError, SimulationError
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.report.halved import halved_comparison
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.law_source import fresh
from closedloop.simulation.engines.loops import PINOCCHIO
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.simulate import check_engine, simulate
from robot_models import RobotModel


def half_step(scenario: Scenario) -> Scenario:
    """Return the scenario at half its step."""
    time = scenario.time
    if time.integrator in ADAPTIVE:
        raise ScenarioError(
            f"time.integrator = {time.integrator!r}: chooses its steps, and half of time.step would change the rows "
            f"only; tighten time.tolerance instead"
        )
    return scenario.model_copy(update={"time": time.model_copy(update={"step": 0.5 * time.step})})


@arguments_checked()
def halve(
    scenario: Scenario,
    *,
    law: Law | None = None,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
    engine: str = PINOCCHIO,
) -> Run:
    """Simulate a scenario as `simulate` does, and again at half its step; return the first run, with the comparison.

    The run's ``halved``, which is in its summary, its report and its file, says by how much each value and each main
    column differ (`closedloop.record.report.halved`). The step error in the summary is then the measured one.

    Parameters
    ----------
    scenario, law, model, progress, engine
        As of `simulate`. An object with a state is copied for each run; a law that has `reset` is reset.

    Returns
    -------
    Run

    Raises
    ------
    ScenarioError, ModelError
        As by `simulate`, and if the integrator chooses its steps.
    SimulationError
        As by `simulate`, if the first run stops early. If the second run does, the verdict says so.
    """
    check_engine(scenario, engine, law)
    half_step(scenario)
    run = simulate(scenario, law=fresh(law), model=model, progress=progress, engine=engine)
    return beside_half(run, law=law, model=model, progress=progress)


def beside_half(
    run: Run,
    *,
    law: Law | None = None,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
) -> Run:
    """Simulate what a run is of again, at half the step, and return the run with the comparison; see `halve`.

    Raises
    ------
    InterruptedRunError
        After Ctrl-C; its `run` is the one given.
    """
    try:
        other = simulate(
            half_step(run.scenario), law=fresh(law), model=model, progress=progress, engine=run.engine
        )  # fmt: skip
    except InterruptedRunError as error:
        raise InterruptedRunError(f"in the run at half the step: {error}", error.time, run) from error
    except SimulationError as error:
        if not isinstance(error.run, Run):
            raise
        other = error.run
    return replace(run, halved=halved_comparison(run, other))
