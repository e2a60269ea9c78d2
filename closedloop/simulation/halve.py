"""A run, and the same at half the step: by how much each value differs. So the error of the step is measured."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import InterruptedRunError, ScenarioError, SimulationError
from closedloop.jit.interim import at_hand
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.report.halved import halved_comparison, step_error
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.law_source import fresh
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO, loop_for
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
    column differ (`closedloop.record.report.halved`). The summary then states the error of the step, and the verdict
    counts it.

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
    return beside_half(run, law=law, model=model, progress=progress, engine=engine)


def beside_half(
    run: Run,
    *,
    law: Law | None = None,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
    engine: str | None = None,
) -> Run:
    """Simulate what a run is of again, at half the step, and return the run with the comparison; see `halve`.

    Without an `engine` it is the compiled one where it can run this and is compiled already, else the run's own: they
    differ by rounding.

    Raises
    ------
    InterruptedRunError
        After Ctrl-C; its `run` is the one given.
    """
    try:
        other = simulate(
            half_step(run.scenario), law=fresh(law), model=model, progress=progress, engine=engine or _fastest(run, law)
        )  # fmt: skip
    except InterruptedRunError as error:
        raise InterruptedRunError(f"in the run at half the step: {error}", error.time, run) from error.__cause__
    except SimulationError as error:
        if not isinstance(error.run, Run):
            raise
        other = error.run
    return replace(run, halved=halved_comparison(run, other))


def _fastest(run: Run, law: Law | None) -> str:
    """Return the engine that is compiled already and takes this law, the compiled one first."""
    try:
        check_engine(run.scenario, COMPILED, law)
    except ScenarioError:
        return run.engine
    return COMPILED if at_hand(loop_for(COMPILED)) else run.engine


def step_error_of(run: Run, law: Law | None = None) -> dict[str, Any]:
    """Return the error of the step of a run; see `closedloop.record.run.Run.step_error`."""
    if run.halved is None:
        if law is None and run.law != "scenario":
            raise ScenarioError(f"the run was made with the law {run.law}: pass it, as run.step_error(law=...)")
        run = beside_half(run, law=law, model=run.model)
    found = step_error(run)
    return {name: found[name] for name in ("force", "position")}
