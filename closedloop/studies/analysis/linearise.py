"""The force loop as a linear system about the motion at an instant.

Of the equation of motion the derivatives are taken at one state of a run, by the kernels of that run (`here`,
`derivatives`). With the closure they are reduced to what it leaves free (`reduced`), carried over a step as the
scenario's integrator would (`discretise`), and put together with what happens to samples (`assembly`): the sensor's
delay, the hold of a sampled torque, the encoders. The result is x⁺ = A x + B u, y = C x + D u from one sample of the
law to the next.
"""

from __future__ import annotations

from closedloop.base.arguments import arguments_checked
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.assembly import assembled
from closedloop.studies.analysis.here import without_event
from closedloop.studies.analysis.instant import Instant, refuse_outside, row_at, run_to
from closedloop.studies.analysis.linear_loop import LinearLoop
from closedloop.studies.analysis.reduced import Reduced
from robot_models import RobotModel


@arguments_checked()
def linearise(
    scenario: Scenario, at: float | None = None, *, model: RobotModel | None = None, cache: Cache | None = None
) -> LinearLoop:
    """Return the force loop, linear about the motion at an instant.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`.
    at : float, optional
        The instant, s, taken to the nearest sample of the law; half of the duration if left out.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.
    cache : Cache, optional
        For repeated calls: the robot and the path that they share are prepared once.

    Returns
    -------
    LinearLoop
        A, B, C, D, dt, names with units, poles, margins, responses, the port.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario is at fault, or `at` is outside the run.
    SimulationError
        At an event, in flight, if a drive is at its limit or a joint at its stop, or if the run stops before.
    """
    at = 0.5 * scenario.time.duration if at is None else at
    refuse_outside(scenario, at)  # before the path is made, which takes a while
    problem = prepare(scenario, model, cache)
    instant = instant_of(scenario, problem, at, model)
    return loop_at(problem, instant)


def instant_of(scenario: Scenario, problem: Problem, at: float, model: RobotModel | None = None) -> Instant:
    """Return the state of a scenario's run at an instant; with an integrator that chooses its steps, by rk4."""
    row = row_at(problem, at)
    return run_to(of_fixed_steps(problem, model), row)


def of_fixed_steps(problem: Problem, model: RobotModel | None = None, cache: Cache | None = None) -> Problem:
    """Return a problem that is stepped row by row: with an integrator that chooses its steps, the same one by rk4."""
    scenario = problem.scenario
    if scenario.time.integrator not in ADAPTIVE:
        return problem
    fixed = Variants(scenario, ("time.integrator", "time.tolerance")).scenario(("rk4", None))
    return prepare(fixed, model, cache)


def loop_at(problem: Problem, instant: Instant, free: bool = False) -> LinearLoop:
    """Return the loop of a problem at the state of an instant, which may be that of a run with other gains.

    In flight there is only a loop of motion, which is returned if `free` says that it is meant.
    """
    with without_event(instant.time):
        return assembled(Reduced(problem, instant, free))
