"""`cl.gradients`: the derivatives of several scenarios, on two cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError
from closedloop.base.progress import reporting
from closedloop.base.second_process import Beside
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.engines.loops import COMPILED
from closedloop.studies.gradient.gradient import Gradient, gradient
from robot_models import RobotModel


@arguments_checked(keys="a list of keys", of="a list of quantities")
def gradients(
    scenarios: Sequence[Scenario],
    keys: Sequence[str],
    of: Sequence[str],
    *,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
    workers: int | None = None,
) -> list[Gradient]:
    """Return what `gradient` returns of each of several scenarios, on two cores.

    Half of the time is that of Python, and threads would wait for each other: a second process takes every other one.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Such as one with several values of a gain.
    keys, of, model
        See `gradient`.
    progress : bool or callable
        True draws a bar on standard error; a callable gets (scenarios done, scenarios in all).
    workers : int, optional
        1 leaves all scenarios to this process. The result is the same.

    Raises
    ------
    ScenarioError, SimulationError
        As `gradient`, of a scenario that it is raised of.
    """
    if not scenarios:
        raise ScenarioError("scenarios: must be a list of scenarios, such as [load_scenario('wam_slide')]")
    shared = threads_for(COMPILED, workers) > 1
    found: dict[int, Gradient] = {}
    with ExitStack() as open_until_done:
        report = open_until_done.enter_context(reporting(progress, "derivatives", len(scenarios)))

        def take(some: range) -> dict[int, Gradient]:
            for i in some:
                report(len(found), len(scenarios))
                found[i] = gradient(scenarios[i], keys, of, model=model, workers=1)
            return found

        take(range(1))  # the kernels are compiled now
        if shared:
            beside = Beside(lambda: take(range(2, len(scenarios), 2)))
            open_until_done.callback(beside.stop)
            take(range(1, len(scenarios), 2))
            found |= beside.result()
        else:
            take(range(1, len(scenarios)))
        report(len(scenarios), len(scenarios))
    return [found[i] for i in range(len(scenarios))]
