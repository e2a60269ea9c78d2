"""A thread's bench for many runs: what earlier runs made and later ones may use, and a run's outcome as a few numbers.

Beside the steps a run of a batch costs some Python: its scenario is checked, and its numbers are packed. All that is
large is kept here from run to run: robots, paths and tables (`closedloop.simulation.cache`), rows, events, scratch.
Nothing of an earlier run can be seen in a later one: the loop reads no row that it has not written.

Runs that are alike enough go eight abreast (`closedloop.engines.lanes`), which changes no bit of what they come to.
"""

from __future__ import annotations

import logging
import math
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from closedloop.engines.compiled import compiled_tree, compiled_work
from closedloop.engines.lanes import FEWEST, Abreast, Kind, goes_abreast, kind_of
from closedloop.engines.loops import COMPILED
from closedloop.engines.problem import Problem
from closedloop.errors import ClosedLoopError, SingularClosureError, one_line
from closedloop.jit.background import make_ready
from closedloop.jit.simd8 import WIDE
from closedloop.report.assumptions import NAMES
from closedloop.report.measured import FAILED_AT, WIDTH, Tally, Values, measure_rows
from closedloop.report.row_sample import joint_limits
from closedloop.report.tabled import verdict_of
from closedloop.robot.pinocchio import Robot
from closedloop.robot.tree import Tree
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.cache import Pieces
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import run_loop
from closedloop.step.record_row import Row, recorded
from robot_models import RobotModel

Array = NDArray[np.float64]

SINGULAR_AT = FAILED_AT + NAMES.index("nonsingular")
RAN, STOPPED, REFUSED, FAILED = "done", "stopped", "refused", "failed"
# Frames of an unforeseen error that its row names, from where it was raised outwards.
FRAMES = 3
# Characters of its message.
MOST_SAID = 300

# Rows of eight runs that are kept whole may take this many bytes: less than what there is room for in `Pieces`.
ROOM_ABREAST = 24_000_000


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Attributes
    ----------
    status : str
        "done"; "stopped" (the simulation could not go on: the figures are those of what ran); "refused" (the scenario
        is at fault: nothing ran); "failed" (an error that nobody foresaw: a fault of this package, or no memory left).
    reason : str or None
        Why it was stopped, was refused or failed.
    rows : int
        How many rows it has.
    figures : (Values.count(n),) array
        See `closedloop.report.measured`; NaN where there is none, and (WIDTH,) if nothing ran.
    columns : mapping of str to (rows,) or (rows, k) array
        The columns that were to be kept.
    end_time : float
        Instant of the last row, s; NaN if there is none.
    verdict : str or None
        "good", or what is wrong with what ran, see `closedloop.report.verdict`; None if it was refused or failed.
    """

    status: str
    reason: str | None
    rows: int
    figures: Array
    end_time: float = math.nan
    columns: dict[str, Array] = field(default_factory=dict)
    verdict: str | None = None


class Bench:
    """What one thread needs to run scenarios one after the other.

    Parameters
    ----------
    engine : str
        "compiled" or "pinocchio", see `closedloop.simulate`.
    keep : sequence of str
        Columns to hand out with the figures, see `closedloop.step.record_row.RECORDED`.
    model : RobotModel, optional
        The robot to use instead of loading the one that each scenario names.
    runs : int
        How many runs there will be, on this bench and others.
    common : Pieces, optional
        What the threads share, see `closedloop.simulation.cache`.
    """

    def __init__(
        self,
        engine: str = COMPILED,
        keep: tuple[str, ...] = (),
        model: RobotModel | None = None,
        runs: int = 1,
        common: Pieces | None = None,
    ) -> None:
        self._engine, self._keep, self._model, self._runs = engine, keep, model, runs
        self._pieces = Pieces(common=common)
        self._trees: WeakKeyDictionary[Robot, tuple[Tree, Array]] = WeakKeyDictionary()
        self._misses: Counter[str] = Counter()  # eights in a row in which something came up, by kind of contact
        self._waits: Counter[str] = Counter()  # eights that are still to go alone
        self._rows = np.empty(0)

    def run(self, scenario: Scenario) -> Outcome:
        """Run a scenario and return its outcome; a run that fails says why."""
        try:
            return self._run(prepare(scenario, self._model, self._pieces))
        except Exception as error:  # the border of a row: see `failed`
            return self._failed(error)

    def _failed(self, error: Exception) -> Outcome:
        if not isinstance(error, ClosedLoopError):
            self._pieces.forget()  # what it left half done is not used again
        return failed(error)

    def run_all(self, scenarios: Sequence[Scenario], ran: Callable[[], None] = lambda: None) -> list[Outcome]:
        """Run up to eight scenarios, abreast if they are of one kind, and return their outcomes in order.

        `ran` is called after each.
        """
        outcomes: dict[int, Outcome] = {}
        members: list[int] = []
        abreast: Abreast | None = None
        together = len(scenarios) >= FEWEST and self._try_abreast(scenarios[0])

        def done(i: int, outcome: Outcome) -> None:
            outcomes[i] = outcome
            ran()

        for i, scenario in enumerate(scenarios):
            try:
                problem = prepare(scenario, self._model, self._pieces)
                kind = kind_of(problem) if together else None
                if abreast is None and kind is not None:
                    abreast = self._abreast(problem, kind)
                if abreast is not None and kind == abreast.kind:
                    abreast.take(len(members), problem)
                    members.append(i)
                    continue
                outcome = self._run(problem)
            except Exception as error:  # the border of a row: see `failed`
                outcome = self._failed(error)
            done(i, outcome)
        came_to = self._run_abreast(abreast, [scenarios[i] for i in members]) if abreast is not None else None
        for lane, i in enumerate(members):
            done(i, self.run(scenarios[i]) if came_to is None else came_to[lane])
        return [outcomes[i] for i in range(len(scenarios))]

    def _run_abreast(self, abreast: Abreast, scenarios: Sequence[Scenario]) -> list[Outcome] | None:
        """Return what the runs of these scenarios, a lane each, came to; None if they have to go alone."""
        if len(scenarios) < FEWEST:
            return None
        try:
            ended_well = abreast.run(self._trees[abreast.kind.robot][0], len(scenarios))
            self._remember(abreast.kind.contact, ended_well)
            return [self._outcome(abreast, i, each) for i, each in enumerate(scenarios)] if ended_well else None
        except Exception as error:  # alone, the one at fault fails by itself
            self._failed(error)
            return None

    def _try_abreast(self, scenario: Scenario) -> bool:
        """Whether scenarios like this one should go abreast: not if that has failed again and again of late."""
        if not goes_abreast(scenario, self._engine, self._runs):
            return False
        contact = scenario.surface.contact
        self._waits[contact] -= 1
        return self._waits[contact] < 0

    def _remember(self, contact: str, ended_well: bool) -> None:
        """Let the next 2, 6, 14 or 30 eights go alone after 2, 3, 4 or 5 in a row in which something came up."""
        self._misses[contact] = 0 if ended_well else min(self._misses[contact] + 1, 5)
        self._waits[contact] = max(0, 2 ** self._misses[contact] - 2)

    def _abreast(self, problem: Problem, kind: Kind) -> Abreast | None:
        """Return the memory for runs of a kind; None if they would need too much."""
        rows = (problem.steps + 1) * Row.count(problem.robot.n)
        if self._keep and rows * WIDE * self._rows.itemsize > ROOM_ABREAST:
            return None
        self._tree(problem)
        return self._pieces.get(
            ("abreast", kind), lambda: Abreast(problem, kind, bool(self._keep)), lambda made: made.bytes
        )

    def _outcome(self, abreast: Abreast, lane: int, scenario: Scenario) -> Outcome:
        rows = abreast.rows(lane)
        columns = {name: recorded(rows, abreast.n, name) for name in self._keep}
        steps, figures = abreast.kind.steps, abreast.figures(lane)
        verdict = verdict_of(scenario, abreast.kind.robot, figures, steps)
        return Outcome(RAN, None, steps + 1, figures, abreast.end, columns, verdict)

    def _run(self, problem: Problem) -> Outcome:
        tree = self._tree(problem)
        rows, events, failure, _ = run_loop(problem, engine=self._engine, rows=self._room(problem), tree=tree)
        n = problem.robot.n
        figures = np.full(Values.count(n), math.nan)
        if len(rows) > 0:
            make_ready(measure_rows)
            measure_rows(
                *tree, rows, len(rows), problem.table, problem.nodes, problem.h, problem.frame,
                joint_limits(problem.robot.model), events, len(events), np.empty(Tally.count(n)), figures,
            )  # fmt: skip
        columns = {name: recorded(rows, problem.robot.n, name) for name in self._keep}
        end = problem.h * (len(rows) - 1) if len(rows) > 0 else math.nan
        if isinstance(failure, SingularClosureError) and np.isnan(figures[SINGULAR_AT]):
            figures[SINGULAR_AT] = end + problem.h  # no row was near it: the step after the last was
        reason = None if failure is None else str(failure)
        verdict = verdict_of(problem.scenario, problem.robot, figures, len(rows) - 1, reason)
        return Outcome(RAN if failure is None else STOPPED, reason, len(rows), figures, end, columns, verdict)

    def _tree(self, problem: Problem) -> tuple[Tree, Array]:
        robot = problem.robot
        if robot not in self._trees:
            self._trees[robot] = compiled_tree(problem), compiled_work(robot.n)
        return self._trees[robot]

    def _room(self, problem: Problem) -> Array:
        """Return memory for the rows of a problem; the adaptive integrator has its own."""
        width = Row.count(problem.robot.n)
        count = (problem.steps + 1) * width
        if self._rows.size < count:
            self._rows = np.empty(count)
        return self._rows[:count].reshape(-1, width)


def failed(error: Exception) -> Outcome:
    """Return the outcome of a run that an error kept from coming to anything.

    One of ours says what is wrong with the scenario. Any other is a fault that nobody foresaw, in this package or in
    the machine: it costs its row and no other, the row says what and where, and the traceback goes to the log
    ``closedloop.batch.worker``. `simulate` of the row's values alone raises it.
    """
    if isinstance(error, ClosedLoopError):
        return Outcome(REFUSED, str(error), 0, np.full(WIDTH, math.nan))
    logging.getLogger(__name__).debug("a run failed", exc_info=error)
    frames = traceback.extract_tb(error.__traceback__)[: -FRAMES - 1 : -1]
    where = ", called from ".join(f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}" for frame in frames)
    reason = one_line(f"{type(error).__name__}: {' '.join(str(error).split())}"[:MOST_SAID])
    return Outcome(FAILED, f"{reason} ({where})", 0, np.full(WIDTH, math.nan))
