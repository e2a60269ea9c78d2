"""A thread's bench for many runs: what earlier runs made and later ones may use, and a run's outcome as a few numbers.

Beside the steps a run of a batch costs some Python: its scenario is checked, and its numbers are packed. All that is
large is kept here from run to run: robots, paths and tables (`closedloop.pieces`), rows, events, scratch. Nothing of an
earlier run can be seen in a later one: the loop reads no row that it has not written.

Runs that are alike enough go eight abreast (`closedloop.abreast`), which changes no bit of what they come to.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from closedloop.abreast import Abreast, Kind, kind_of
from closedloop.compiled_engine import compiled_tree, compiled_work
from closedloop.errors import ClosedLoopError, SingularClosureError
from closedloop.forms import COMPILED, worth_going_abreast
from closedloop.octet import WIDE
from closedloop.pieces import Pieces
from closedloop.preparation import prepare
from closedloop.problem import Problem
from closedloop.report.assumptions import NAMES
from closedloop.report.measured import FAILED_AT, TALLY, WIDTH, measure_rows
from closedloop.robot import Robot
from closedloop.rows import Row
from closedloop.scenario import Scenario
from closedloop.simulation import recorded, run_loop
from closedloop.tree import Tree
from robot_models import RobotModel

Array = NDArray[np.float64]

SINGULAR_AT = FAILED_AT + NAMES.index("nonsingular")
RAN, STOPPED, REFUSED = "done", "stopped", "refused"

# Eight runs abreast take as long as two alone; fewer than this many are run alone.
FEWEST_ABREAST = 3
# After so many ranks in a row in which something came up, runs of the same kind of contact go alone.
MOST_MISSES = 2
# Rows of eight runs that are kept whole may take this many bytes: less than what there is room for in `Pieces`.
ROOM_ABREAST = 24_000_000


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Attributes
    ----------
    status : str
        "done"; "stopped" (the simulation could not go on: the figures are those of what ran); "refused" (the scenario
        is at fault: nothing ran).
    reason : str or None
        Why it was stopped or refused.
    rows : int
        How many rows it has.
    figures : (WIDTH,) array
        See `closedloop.report.measured`; NaN where there is none.
    columns : mapping of str to (rows,) or (rows, k) array
        The columns that were to be kept.
    end_time : float
        Instant of the last row, s; NaN if there is none.
    """

    status: str
    reason: str | None
    rows: int
    figures: Array
    end_time: float = math.nan
    columns: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Rank:
    """Runs that will go abreast: their kind, their memory, their robot, and their numbers so far."""

    kind: Kind
    abreast: Abreast
    tree: Tree
    members: list[int]


class Bench:
    """What one thread needs to run scenarios one after the other.

    Parameters
    ----------
    engine : str
        "compiled" or "pinocchio", see `closedloop.simulate`.
    keep : sequence of str
        Columns to hand out with the figures, see `closedloop.simulation.RECORDED`.
    model : RobotModel, optional
        The robot to use instead of loading the one that each scenario names.
    runs : int
        How many runs there will be, on this bench and others.
    common : Pieces, optional
        What the threads share, see `closedloop.pieces`.
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
        self._misses: Counter[str] = Counter()
        self._rows, self._tally = np.empty(0), np.empty(TALLY)

    def run(self, scenario: Scenario) -> Outcome:
        """Run a scenario and return its outcome; a run that fails says why."""
        try:
            problem = prepare(scenario, self._model, self._pieces)
            return self._run(problem)
        except ClosedLoopError as error:
            return refused(error)

    def run_all(self, scenarios: Sequence[Scenario], ran: Callable[[], None] = lambda: None) -> list[Outcome]:
        """Run scenarios, abreast where they can, and return their outcomes in order; `ran` is called after each."""
        outcomes: dict[int, Outcome] = {}
        ranks: dict[Kind, Rank] = {}

        def done(members: Sequence[int], came_to: Sequence[Outcome]) -> None:
            for i, outcome in zip(members, came_to, strict=True):
                outcomes[i] = outcome
                ran()

        for i, scenario in enumerate(scenarios):
            try:
                problem = prepare(scenario, self._model, self._pieces)
                rank = self._rank(problem, ranks)
                if rank is None:
                    done([i], [self._run(problem)])
                    continue
            except ClosedLoopError as error:
                done([i], [refused(error)])
                continue
            rank.abreast.take(len(rank.members), problem)
            rank.members.append(i)
            if len(rank.members) == WIDE:
                done(rank.members, self._run_rank(rank, scenarios))
                rank.members.clear()
        for rank in ranks.values():
            done(rank.members, self._run_rank(rank, scenarios))
        return [outcomes[i] for i in range(len(scenarios))]

    def _kind(self, problem: Problem) -> Kind | None:
        """Return the kind in which a problem goes abreast with others; None if it goes alone."""
        kind = kind_of(problem) if self._engine == COMPILED else None
        if kind is None or not worth_going_abreast(self._runs * problem.steps):
            return None
        rows = (problem.steps + 1) * Row.of(problem.robot.n).width
        too_large = bool(self._keep) and rows * WIDE * self._rows.itemsize > ROOM_ABREAST
        return None if too_large or self._misses[kind.contact] >= MOST_MISSES else kind

    def _rank(self, problem: Problem, ranks: dict[Kind, Rank]) -> Rank | None:
        """Return the rank in which a problem may go, found among `ranks` or put there; None if it must go alone."""
        kind = self._kind(problem)
        if kind is None:
            return None
        if kind not in ranks:
            abreast = self._pieces.get(
                ("abreast", kind), lambda: Abreast(problem, bool(self._keep)), lambda made: made.bytes
            )
            ranks[kind] = Rank(kind, abreast, self._tree(problem)[0], [])
        return ranks[kind]

    def _run_rank(self, rank: Rank, scenarios: Sequence[Scenario]) -> list[Outcome]:
        """Return the outcomes of a rank's members."""
        abreast, count = rank.abreast, len(rank.members)
        alone = count < FEWEST_ABREAST
        if not alone:
            alone = not abreast.run(rank.tree, count)
            self._misses[rank.kind.contact] = self._misses[rank.kind.contact] + 1 if alone else 0
        if alone:
            return [self.run(scenarios[i]) for i in rank.members]
        outcomes = []
        for lane in range(count):
            rows = abreast.rows(lane)
            columns = {name: recorded(rows, abreast.n, name) for name in self._keep}
            outcomes.append(Outcome(RAN, None, abreast.steps + 1, abreast.figures(lane), abreast.end, columns))
        return outcomes

    def _run(self, problem: Problem) -> Outcome:
        tree = self._tree(problem)
        ahead = self._runs * problem.steps if self._kind(problem) is None else 0  # those to come go abreast
        rows, events, failure, _ = run_loop(
            problem, engine=self._engine, rows=self._room(problem), tree=tree, ahead=ahead
        )
        figures = np.full(WIDTH, math.nan)
        if len(rows) > 0:
            measure_rows(
                *tree, rows, len(rows), problem.table, problem.nodes, problem.h, problem.frame.ravel(), events,
                len(events), self._tally, figures,
            )  # fmt: skip
        columns = {name: recorded(rows, problem.robot.n, name) for name in self._keep}
        end = problem.h * (len(rows) - 1) if len(rows) > 0 else math.nan
        if isinstance(failure, SingularClosureError) and np.isnan(figures[SINGULAR_AT]):
            figures[SINGULAR_AT] = end + problem.h  # no row was near it: the step after the last was
        if failure is None:
            return Outcome(RAN, None, len(rows), figures, end, columns)
        return Outcome(STOPPED, str(failure), len(rows), figures, end, columns)

    def _tree(self, problem: Problem) -> tuple[Tree, Array]:
        robot = problem.robot
        if robot not in self._trees:
            self._trees[robot] = compiled_tree(problem), compiled_work(robot.n)
        return self._trees[robot]

    def _room(self, problem: Problem) -> Array:
        """Return memory for the rows of a problem; the adaptive integrator has its own."""
        width = Row.of(problem.robot.n).width
        count = (problem.steps + 1) * width
        if self._rows.size < count:
            self._rows = np.empty(count)
        return self._rows[:count].reshape(-1, width)


def refused(error: ClosedLoopError) -> Outcome:
    """Return the outcome of a scenario that cannot be simulated."""
    return Outcome(REFUSED, str(error), 0, np.full(WIDTH, math.nan))
