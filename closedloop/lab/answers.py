"""From the changes of a scenario to a run, or to the one line that says what is wrong with them."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from closedloop.base.errors import ClosedLoopError, ScenarioError, SimulationError, one_line
from closedloop.figures.scene.joined import compile_rows
from closedloop.jit.background import compiling_notice
from closedloop.jit.kernel import needs_compiling
from closedloop.lab.history import Changes, History
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.as_run import as_run
from closedloop.simulation.engines.law_source import fresh
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO, kernels_of
from closedloop.simulation.prepare import load_model, model_key, prepare
from closedloop.simulation.simulate import check_engine, run_loop, simulate
from robot_models import RobotModel

# Steps of the run with which a loop is compiled.
FEW = 3
# So long, s, a run goes on whatever is asked meanwhile, and says nothing of how far it is.
PATIENCE = 0.5


class _Overtaken(Exception):
    """A newer change waits, and the run takes long: it is given up."""


@dataclass(frozen=True)
class Answer:
    """What came of some changes.

    Attributes
    ----------
    changes : dict
        The changes.
    key : str
        The key that was changed last, "" if none was.
    run : Run or None
        The run, until where it stopped; None if nothing ran.
    fault : str
        What is wrong with the input, "" if nothing is.
    stopped : str
        Why the run stopped before its end, "" if it did not.
    seconds : float
        Time that it took, s, without compiling.
    """

    changes: Changes
    key: str
    run: Run | None
    fault: str = ""
    stopped: str = ""
    seconds: float = 0.0


class Answers:
    """Answers changes of one scenario.

    Parameters
    ----------
    history : History
        What the changes are of.
    law : callable, optional
        A user's law, see `closedloop.simulate`.
    model : RobotModel, optional
        The robot to use instead of loading the scenario's.
    say : callable
        Takes a line while something is compiled or takes long, and "" when it is done.
    overtaken : callable
        Whether a newer change waits; a run that takes long is given up then, where the engine returns meanwhile.
    """

    def __init__(
        self, history: History, law: Any = None, model: RobotModel | None = None,
        say: Callable[[str], None] = lambda line: None, overtaken: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        self._overtaken = overtaken
        self._history, self.law, self._given, self._say = history, law, model, say
        self._models: dict[Hashable, RobotModel] = {}
        self._ready: set[tuple[Any, ...]] = set()
        self._began = 0.0

    def answer(self, changes: Changes, key: str = "") -> Answer:
        """Run the scenario with these changes; `key` is the one changed last."""
        self._began = clock.perf_counter()

        def took(run: Run | None, **more: str) -> Answer:
            return Answer(changes, key, run, seconds=clock.perf_counter() - self._began, **more)

        try:
            scenario = self._history.scenario(changes)
            return took(self._run(scenario))
        except _Overtaken:
            return took(None)
        except SimulationError as error:
            run = error.run if error.run is not None and len(error.run) else None
            return took(run, stopped=one_line(str(error)))
        except ClosedLoopError as error:
            return took(None, fault=_without_name(one_line(str(error)), self._history.base.name))
        except MemoryError:
            return took(None, fault="out of memory: ask for fewer steps")

    def _run(self, scenario: Scenario) -> Run:
        model, engine = self.model(scenario), self.engine(scenario)
        if self._compile(scenario, model, engine):
            self._began = clock.perf_counter()  # what is compiled once is no part of what a run takes
        began = said = clock.perf_counter()

        def progress(done: int, total: int) -> None:
            nonlocal said
            now = clock.perf_counter()
            if now - began > PATIENCE and done < total:
                if self._overtaken():
                    raise _Overtaken
                if now - said > PATIENCE:
                    said = now
                    self._say(f"computing ... {done / total:.0%}")

        return simulate(scenario, law=fresh(self.law), model=model, engine=engine, progress=progress)

    def model(self, scenario: Scenario) -> RobotModel:
        """Return the robot of a scenario, loaded once."""
        if self._given is not None:
            return self._given
        key = model_key(scenario)
        if key not in self._models:
            self._models = {key: load_model(scenario)}
        return self._models[key]

    def engine(self, scenario: Scenario) -> str:
        """Return the compiled engine where it covers the scenario and the law, else Pinocchio."""
        if scenario.time.integrator in ADAPTIVE:
            return PINOCCHIO
        try:
            check_engine(scenario, COMPILED, self.law)
        except ScenarioError:
            return PINOCCHIO
        return COMPILED

    def _compile(self, scenario: Scenario, model: RobotModel, engine: str) -> bool:
        """Have compiled what a run of these kinds needs, here and now, and say so if it takes time.

        Return whether these kinds are new.
        """
        kinds = (engine, scenario.time.integrator, *_kinds(scenario))
        if kinds in self._ready or scenario.time.integrator in ADAPTIVE:
            return False
        few = min(FEW, round(scenario.time.duration / scenario.time.step))
        short = scenario.time.model_copy(update={"duration": few * scenario.time.step})
        problem = prepare(scenario.model_copy(update={"time": short}), model)
        try:
            if any(map(needs_compiling, kernels_of(engine))):
                self._say(compiling_notice())
            rows, events, _, seconds = run_loop(problem, fresh(self.law), engine=engine)
            if len(rows):
                as_run(problem, rows, events, seconds, engine)  # what makes a run of the rows has kernels of its own
            if problem.robot.model.loops:
                compile_rows(problem.robot)
            self._ready.add(kinds)
        finally:
            self._say("")
        return True


def _kinds(scenario: Scenario) -> tuple[str, ...]:
    """Return the kinds of a scenario's sections: they decide which loop runs."""
    sections = (getattr(scenario, name) for name in type(scenario).model_fields)
    return (scenario.surface.contact, *(str(getattr(section, "kind", "")) for section in sections))


def _without_name(message: str, name: str) -> str:
    return message.removeprefix(f"{name}: ")
