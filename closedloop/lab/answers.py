"""From the changes of a scenario to a run, or to the one line that says what is wrong with them."""

import time as clock
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, ScenarioError, SimulationError, one_line
from closedloop.base.interrupts import held_back
from closedloop.figures.scene.solids import compile_rows
from closedloop.jit.background import compiling_notice
from closedloop.jit.kernel import needs_compiling
from closedloop.lab.controls import Changes
from closedloop.lab.history import History
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.law_source import fresh, law_digest
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO, kernels_of
from closedloop.simulation.prepare import load_model, model_key, prepare
from closedloop.simulation.simulate import as_run, check_engine, law_name, run_loop
from robot_models import RobotModel

NO_EVENTS = np.zeros((0, EVENT_WIDTH))
# Steps of the run with which a loop is compiled.
FEW = 3
# A run that takes longer than this, s, shows what is done of it, this often: not just before its end.
SLOW = 0.1
# The first part is shown as soon as it is clear that the run takes that long, if so large a share of SLOW is left.
LEFT = 0.3


@dataclass(frozen=True)
class Answer:
    """What came of some changes."""

    changes: Changes
    key: str  # the key that was changed last, "" if none was
    run: Run | None  # the run, until where it stopped; None if nothing ran
    fault: str = ""  # what is wrong with the input, "" if nothing is
    stopped: str = ""  # why the run stopped before its end, "" if it did not
    seconds: float = 0.0  # time that it took, s, without compiling
    effort: float = 0.0  # time of a processor that it took, s: not longer while other programs are at work


class Answers:
    """Answers changes of one scenario.

    `law`: a user's law, see `closedloop.simulate`.
    `say`: takes a line while something is compiled or takes long, and "" when it is done.
    `part`: takes a `Run` until where it is, again and again, of one that takes long.
    """

    def __init__(
        self, history: History, law: Any = None, model: RobotModel | None = None,
        say: Callable[[str], None] = lambda line: None, part: Callable[[Run], None] = lambda run: None,
    ) -> None:  # fmt: skip
        self._part = part
        self._cache = Cache()
        self._history, self.law, self._given, self._say = history, law, model, say
        self._models: dict[Hashable, RobotModel] = {}
        self._ready: set[tuple[Any, ...]] = set()
        self._began = self._worked = 0.0

    def answer(self, changes: Changes, key: str = "") -> Answer:
        """Run the scenario with these changes; `key` is the one changed last."""
        self._begin_clocks()

        def took(run: Run | None, **more: str) -> Answer:
            seconds, effort = clock.perf_counter() - self._began, clock.thread_time() - self._worked
            return Answer(changes, key, run, seconds=seconds, effort=effort, **more)

        try:
            scenario = self._history.scenario(changes)
            return took(self._run(scenario))
        except SimulationError as error:
            run = error.run if error.run is not None and len(error.run) else None
            return took(run, stopped=one_line(str(error)))
        except ClosedLoopError as error:
            return took(None, fault=one_line(str(error)).removeprefix(f"{self._history.base.name}: "))
        except MemoryError:
            return took(None, fault="out of memory: ask for fewer steps")

    def _begin_clocks(self) -> None:
        self._began, self._worked = clock.perf_counter(), clock.thread_time()

    def _run(self, scenario: Scenario) -> Run:
        model, engine = self.model(scenario), self.engine(scenario)
        if self._compile(scenario, model, engine):
            self._begin_clocks()  # what is compiled once is no part of what a run takes
        law = fresh(self.law)
        with held_back():
            problem = prepare(scenario, model, self._cache)
        rows = np.empty((problem.steps + 1, problem.row_width))
        name, digest = ("scenario", "") if law is None else (law_name(law), law_digest(law))

        def made(some: Array, events: Array, seconds: float, stopped: str | None = None) -> Run:
            return as_run(
                problem, some, events, seconds, engine, law=(name, digest), with_states=law is None, stopped=stopped
            )  # fmt: skip

        began = shown = clock.perf_counter()

        def report(done: int, total: int) -> None:
            nonlocal shown
            now = clock.perf_counter()
            left = (now - began) * (total - done) / max(done, 1)
            first = shown == began and now - began + left > SLOW and left > LEFT * SLOW
            if (first or (now - shown > SLOW and left > SLOW)) and 1 < done < total:
                if now - began > SLOW:
                    self._say(f"computing ... {done / total:.0%}")
                if problem.tolerance is None:  # whose rows are elsewhere
                    self._part(made(rows[:done], NO_EVENTS, 0.0))
                shown = clock.perf_counter()

        try:
            found, events, failure, seconds = run_loop(problem, law, report, engine, rows=rows)
        finally:
            if shown > began:
                self._say("")
        run = made(found, events, seconds, None if failure is None else str(failure))
        if failure is not None:
            failure.run = run
            raise failure
        return run

    def model(self, scenario: Scenario) -> RobotModel:
        """Return the robot of a scenario, loaded once."""
        if self._given is not None:
            return self._given
        key = model_key(scenario)
        if key not in self._models:
            self._models, self._cache = {key: load_model(scenario)}, Cache()
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
