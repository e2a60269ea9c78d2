"""`cl.gradients`: the derivatives of several scenarios, side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
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
    """Return what `gradient` returns of each of several scenarios, which run side by side.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Such as one with several values of a gain.
    keys, of, model
        See `gradient`.
    progress : bool or callable
        True draws a bar on standard error; a callable gets (scenarios done, scenarios in all).
    workers : int, optional
        Threads, a scenario each; as many as there are cores if left out. The result is the same for any number.

    Raises
    ------
    ScenarioError, SimulationError
        As `gradient`, of the first of the scenarios that it is raised of.
    """
    if not scenarios:
        raise ScenarioError("scenarios: must be a list of scenarios, such as [load_scenario('wam_slide')]")
    threads, done = threads_for(COMPILED, workers), Done()
    found: list[Gradient | None] = [None] * len(scenarios)
    with ExitStack() as open_until_done:
        if progress is True:
            from closedloop.base.progress import bar

            progress = open_until_done.enter_context(bar("derivatives", len(scenarios)))
        report = progress or (lambda *_: None)

        def one(_: None, i: int) -> None:
            found[i] = gradient(scenarios[i], keys, of, model=model, workers=1)
            done.add()

        side_by_side(one, len(scenarios), threads, lambda: None, lambda: report(done.count, len(scenarios)), done)
    return [each for each in found if each is not None]
