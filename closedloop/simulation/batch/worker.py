"""One thread's runs of a batch: the memory that they reuse, and the outcome of a run as a few values.

Large arrays and objects are reused from run to run: robots, paths and tables (`closedloop.simulation.prepare`), rows,
events, scratch. No run depends on an earlier one: the loop reads no row that it has not written.

Runs of one kind go eight at a time in SIMD lanes (`closedloop.simulation.engines.lanes`), with the same results to the
last bit.

The control of a run is judged from its rows, or from what the lanes keep of them.
"""

import logging
import math
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.base.errors import ClosedLoopError, SingularClosureError, faults_on_one_line, one_line
from closedloop.control.drives import DrivesSection
from closedloop.jit.background import make_ready
from closedloop.jit.simd8 import WIDE
from closedloop.loop.events.table import IMPACT, TOUCHDOWN, EventRow
from closedloop.loop.step.record_row import Row, recorded
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.columns.record import SURFACE_COLUMNS
from closedloop.record.columns.touching import contact_rows
from closedloop.record.report import control_verdict
from closedloop.record.report.measures import (
    CONTROL,
    FAILED_AT,
    NAMES,
    WIDTH,
    Tally,
    Values,
    joint_limits,
    measure_rows,
)
from closedloop.record.report.summary import lost_to_slips
from closedloop.record.report.verdict import GOOD, count_limited, forget_absent, verdict_of, verdicts_of
from closedloop.scenario import modes
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.lanes import FEWEST, Kind, LaneRuns, Worst, kind_of, uses_lanes
from closedloop.simulation.engines.law_source import fresh
from closedloop.simulation.engines.loops import COMPILED, compiled_work
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.parts import Asked, Cache, asking
from closedloop.simulation.prepare import problem_of
from closedloop.simulation.simulate import positions_told, run_loop
from robot_models import RobotModel


def control_of_lanes(runs: LaneRuns, scenarios: Sequence[Scenario], values: Array) -> list[str]:
    """Return `control_in_lanes` of each run, of values (R, W): where the worst of them is good, each is."""
    lanes, count = slice(len(scenarios)), runs.kind.steps + 1
    good = not runs.kind.many and all(_first_look(runs.worst(lanes), count))
    if good and not any(map(control_verdict.negative_gain, scenarios)):
        return [GOOD] * len(scenarios)
    return [control_in_lanes(runs, lane, each, values[lane]) for lane, each in enumerate(scenarios)]


def _first_look(worst: Worst, count: int) -> tuple[bool, bool]:
    """Return whether of runs of so many rows only the force counts, and whether it is near that desired.

    Only the force counts where contact is commanded in all rows, and no other error reaches what a bound is about.
    """
    led = 4.0 * worst.off_squared <= control_verdict.PATH_FLOOR**2 and worst.rise <= control_verdict.RELEASE
    near = worst.miss <= control_verdict.MEAN_SHARE * math.sqrt(worst.wanted_squared / count)
    return bool(led and worst.least > 0.0), bool(near)


def control_in_lanes(runs: LaneRuns, lane: int, scenario: Scenario, values: Array) -> str:
    """Return "good", or what is wrong with the control of a run in a lane, whose values are (W,).

    Where nothing can happen to a run, all its rows are in contact. If a first look finds that only the force counts,
    and that it is near, which is so in most runs of a sweep, the rows are not gone over.
    """
    if runs.kind.many:
        problem, _, found, events = runs.by_itself(lane)
        return control_of_rows(problem, found, events, values, None)
    worst, count = runs.worst(slice(lane, lane + 1)), runs.kind.steps + 1
    only_force, near = _first_look(worst, count)
    if only_force and not control_verdict.negative_gain(scenario):
        if near:
            return GOOD
        rows, scale, unknown = np.arange(count), math.sqrt(worst.wanted_squared / count), list[str]()
        return _told((control_verdict.judge_force(runs.miss(lane), scale, runs.kind.h, rows, unknown), unknown))
    # In contact from the start, only by how much the path rises off the surface counts.
    wanted, force, path = runs.signals(lane)
    touching = np.ones(count, dtype=bool)
    signals = control_verdict.signals_of(scenario, runs.kind.h, force, wanted, touching, path, np.empty(0))
    return _told(control_verdict.judge_control(signals, {}))


def control_of_rows(problem: Problem, found: Array, events: Array, values: Any, stopped: str | None) -> str:
    """Return the same of a run by itself.

    It is judged by what `closedloop.record.report.measures.write_control` wrote of its rows, its events, and its values
    (Values.count(n),).
    """
    n = problem.robot.n
    if not found.shape[1]:
        return _told(control_verdict.judge_control(None, {}, stopped))
    kinds = events[:, EventRow.place("kind")]
    began = (kinds == IMPACT) | (kinds == TOUCHDOWN)
    signals = control_verdict.signals_of(
        problem.scenario, problem.h, found[0], found[1], found[2] != 0.0, (found[4:7].T, found[3], found[7:].T),
        events[began, EventRow.place("time")],
    )  # fmt: skip
    measured = Values(values, n)
    names = problem.robot.model.joint_names
    limited = control_verdict.limited_joints(names, measured.torque_limited_share, measured.torque_limited_at)
    return _told(control_verdict.judge_control(signals, limited, stopped))


def _told(judged: tuple[list[dict[str, Any]], list[str]]) -> str:
    """Return the text of the column, with what is not known where nothing else is wrong."""
    problems, unknown = judged
    return control_verdict.told({"control_verdict": {"problems": problems, "not_known": unknown}})


SINGULAR_AT = FAILED_AT + NAMES.index("nonsingular")
RAN, STOPPED, REFUSED, FAILED = "done", "stopped", "refused", "failed"
# Stack frames of an unforeseen error that its row names, innermost first.
FRAMES = 3
# Characters of its message.
MOST_SAID = 300

# Bytes that the kept rows of eight runs may take: less than the limit of `Cache`.
LANE_ROW_BYTES = 24_000_000


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run."""

    # "done"; "stopped" (the simulation could not go on: the values are those of what ran); "refused" (the scenario is
    # at fault: nothing ran); "failed" (an unforeseen error: a fault of this package, or no memory left)
    status: str
    reason: str | None  # why it was stopped, was refused or failed
    rows: int  # how many rows it has
    # (Values.count(n),): see `closedloop.record.report.measures`; NaN where there is none, and (WIDTH,) if nothing ran
    values: Array
    end_time: float = math.nan  # instant of the last row, s; NaN if there is none
    columns: dict[str, Array] = field(default_factory=dict)  # the columns that were to be kept
    # "good", or what is wrong with what ran, see `closedloop.record.report.verdict`; None if it was refused or failed
    verdict: str | None = None
    control: str | None = None  # the same of the control, see `closedloop.record.report.control_verdict`


class Worker:
    """Runs scenarios in one thread.

    `engine`: "compiled" or "pinocchio", see `closedloop.simulate`.
    `keep`: columns to return with the values, see `closedloop.loop.step.record_row.RECORDED`.
    `model`: the robot to use instead of loading the one that each scenario names.
    `runs`: how many runs there will be, of this worker and others.
    `shared`: cache that the threads share, see `closedloop.simulation.prepare`.
    `law`: a user's law in place of the scenarios' own, see `closedloop.simulate`; an object is copied for each run.
    """

    def __init__(
        self, engine: str = COMPILED, keep: tuple[str, ...] = (), model: RobotModel | None = None, runs: int = 1,
        shared: Cache | None = None, law: Law | None = None,
    ) -> None:  # fmt: skip
        self.law = law
        self._engine, self._keep, self._model, self._runs = engine, keep, model, runs
        self._cache = Cache(shared=shared)
        self._failures: Counter[str] = Counter()  # sets of lanes that failed in a row, by kind of contact
        self._one_by_one: Counter[str] = Counter()  # sets of eight still to be run one by one
        self._rows, self._signals = np.empty(0), np.empty((CONTROL, 0))
        self._kind: tuple[Kind | None, Asked] | None = None  # of the last run, and what it was made of
        self._fed: tuple[Scenario, Robot, list[str]] | None = None  # a run, and what is said of its feedback

    def run(self, scenario: Scenario) -> Outcome:
        """Run a scenario and return its outcome; a run that fails says why."""
        try:
            return self._run(problem_of(scenario, self._model, self._cache))
        except Exception as error:  # the border of a row: see `failed`
            return self._failed(error)

    def _failed(self, error: Exception) -> Outcome:
        if not isinstance(error, ClosedLoopError):
            self._cache.clear()  # what it left half done is not used again
        return failed(error)

    def run_all(self, scenarios: Sequence[Scenario], ran: Callable[[], None] = lambda: None) -> list[Outcome]:
        """Run up to eight scenarios, in SIMD lanes if they are of one kind, and return their outcomes in order.

        `ran` is called after each.
        """
        outcomes: dict[int, Outcome] = {}
        members: list[int] = []
        lane_runs: LaneRuns | None = None
        together = len(scenarios) >= FEWEST and self._try_lanes(scenarios[0])

        def done(i: int, outcome: Outcome) -> None:
            outcomes[i] = outcome
            ran()

        for i, scenario in enumerate(scenarios):
            try:
                problem = problem_of(scenario, self._model, self._cache)
                kind = self._kind_of(problem) if together else None
                if lane_runs is None and kind is not None:
                    lane_runs = self._lane_runs(problem, kind)
                if lane_runs is not None and kind == lane_runs.kind:
                    lane_runs.put(len(members), problem)
                    members.append(i)
                    continue
                outcome = self._run(problem)
            except Exception as error:  # the border of a row: see `failed`
                outcome = self._failed(error)
            done(i, outcome)
        ended = None if lane_runs is None else self._run_in_lanes(lane_runs, [scenarios[i] for i in members])
        for lane, i in enumerate(members):
            done(i, self.run(scenarios[i]) if ended is None else ended[lane])
        return [outcomes[i] for i in range(len(scenarios))]

    def _kind_of(self, problem: Problem) -> Kind | None:
        """Return `kind_of`, that of the run before where this one says the same."""
        if self._kind is None or not self._kind[1].stands_for(problem):
            self._kind = asking(problem, kind_of)
        return self._kind[0]

    def _run_in_lanes(self, lane_runs: LaneRuns, scenarios: Sequence[Scenario]) -> list[Outcome] | None:
        """Return the outcomes of these scenarios, a lane each; None if they have to be run one by one."""
        if len(scenarios) < FEWEST:
            return None
        try:
            ended_well = lane_runs.run(len(scenarios))
            self._count(lane_runs.kind.contact, ended_well)
            return self._outcomes(lane_runs, scenarios) if ended_well else None
        except Exception as error:  # alone, the one at fault fails by itself
            self._failed(error)
            return None

    def _try_lanes(self, scenario: Scenario) -> bool:
        """Whether to try lanes for scenarios like this one: not after repeated failures, see `_count`."""
        if self.law is not None or not uses_lanes(scenario, self._engine, self._runs):
            return False
        contact = scenario.surface.contact
        self._one_by_one[contact] -= 1
        return self._one_by_one[contact] < 0

    def _count(self, contact: str, ended_well: bool) -> None:
        """Count failures: after 2, 3, 4 or 5 in a row the next 2, 6, 14 or 30 sets of eight are run one by one."""
        self._failures[contact] = 0 if ended_well else min(self._failures[contact] + 1, 5)
        self._one_by_one[contact] = max(0, 2 ** self._failures[contact] - 2)

    def _lane_runs(self, problem: Problem, kind: Kind) -> LaneRuns | None:
        """Return the memory for runs of a kind; None if they would need too much."""
        rows = (problem.steps + 1) * Row.count(problem.robot.n)
        if self._keep and rows * WIDE * self._rows.itemsize > LANE_ROW_BYTES:
            return None
        return self._cache.get(
            ("lanes", kind), lambda: LaneRuns(problem, kind, bool(self._keep)), lambda made: made.bytes
        )

    def _outcomes(self, lane_runs: LaneRuns, scenarios: Sequence[Scenario]) -> list[Outcome]:
        kind, count = lane_runs.kind, len(scenarios)
        values = lane_runs.values(count)
        forget_absent(scenarios[0], values)
        swings = self._unresolved_feedbacks(scenarios, kind.robot)
        if kind.many:
            swings = [_unresolved_at(*lane_runs.by_itself(i)[:2]) + said for i, said in enumerate(swings)]
        verdicts = verdicts_of(scenarios, kind.robot, values, kind.steps, swings)
        controls = control_of_lanes(lane_runs, scenarios, values)
        return [
            Outcome(
                RAN, None, kind.steps + 1, values[i], lane_runs.end,
                {name: recorded(lane_runs.rows(i), lane_runs.n, name) for name in self._keep}, verdicts[i], controls[i],
            )
            for i in range(count)
        ]  # fmt: skip

    def _run(self, problem: Problem) -> Outcome:
        memory = self._row_memory(problem)
        rows, events, failure, _ = run_loop(problem, fresh(self.law), engine=self._engine, rows=memory)
        n = problem.robot.n
        values = np.full(Values.count(n), math.nan)
        if self._signals.shape[1] < len(rows):
            self._signals = np.empty((CONTROL, len(rows)))
        signals = self._signals[:, : len(rows)]
        if len(rows) > 0:
            make_ready(measure_rows)
            measure_rows(
                problem.robot.tree, (compiled_work(n), np.empty(Tally.count(n))), rows, (problem.table, problem.nodes),
                problem.h, joint_limits(problem.robot.model), events, values, signals,
            )  # fmt: skip
            if k := len(problem.scenario.contact or ()):
                slid = [recorded(rows, n, name, k, problem.row_states) for name in ("link_frictions", "link_slips")]
                time = problem.h * np.arange(float(len(rows)))
                Values(values, n).energy_lost_to_friction += lost_to_slips(time, *slid)
            forget_absent(problem.scenario, values, self.law is not None)
            if problem.scenario.drives != DrivesSection():
                count_limited(recorded(rows, n, "torque_limited"), problem.h, Values(values, n))
        columns = {
            name: recorded(rows, n, name, len(problem.scenario.contact or ()), problem.row_states)
            for name in self._keep
        }
        columns |= positions_told(problem, columns)
        if not problem.scenario.has_surface:
            columns |= {name: np.full_like(columns[name], math.nan) for name in SURFACE_COLUMNS if name in columns}
        end = problem.h * (len(rows) - 1) if len(rows) > 0 else math.nan
        if isinstance(failure, SingularClosureError) and np.isnan(values[SINGULAR_AT]):
            values[SINGULAR_AT] = end + problem.h  # no row was near it: the step after the last was
        reason = None if failure is None else str(failure)
        swings = _unresolved(problem, rows, self.law is not None)
        if self.law is None and len(rows):
            swings += self._unresolved_feedbacks([problem.scenario], problem.robot)[0]
        verdict = verdict_of(
            problem.scenario, problem.robot, values, len(rows) - 1, reason, swings, self.law is not None
        )
        control = control_of_rows(problem, signals, events, values, reason)
        status = RAN if failure is None else STOPPED
        return Outcome(status, reason, len(rows), values, end, columns, verdict, control)

    def _unresolved_feedbacks(self, scenarios: Sequence[Scenario], robot: Robot) -> list[list[str]]:
        """Return what of the law's feedback the step does not resolve, as of the run before if that has the same."""
        last = self._fed
        if last is None or last[1] is not robot or not all(modes.same_feedback(each, last[0]) for each in scenarios):
            found = modes.unresolved_feedbacks(scenarios, robot)
            self._fed = scenarios[-1], robot, found[-1]
            return found
        return [last[2]] * len(scenarios)

    def _row_memory(self, problem: Problem) -> Array:
        """Return memory for the rows of a problem; the adaptive integrator has its own."""
        width = problem.row_width
        count = (problem.steps + 1) * width
        if self._rows.size < count:
            self._rows = np.empty(count)
        return self._rows[:count].reshape(-1, width)


def _unresolved(problem: Problem, rows: Array, own_law: bool) -> list[str]:
    if not len(rows):
        return []
    n = problem.robot.n
    first = Row(rows[0], n)

    def sliding() -> modes.Sliding | None:
        shape = len(problem.scenario.contact or ()), problem.row_states
        q, normal, f, friction, mode = (
            recorded(rows, n, name, *shape)
            for name in ("q", "surface_normal", "contact_force", "friction_force", "mode")
        )
        return modes.where_it_slides(q, normal, f, friction, mode)

    def pressed() -> modes.Pressed | None:
        shape = len(problem.scenario.contact or ()), problem.row_states
        q, mechanism = recorded(rows, n, "q"), problem.robot.model.pinocchio_model()

        def rows_at(row: int, some: Mask) -> Array:
            at = problem.h * row, problem.robot.pinocchios(q[row])
            return contact_rows(problem.scenario, mechanism, *at, some)

        return modes.where_they_press(q, recorded(rows, n, "link_forces", *shape), rows_at)

    return _unresolved_at(problem, first, sliding, own_law, pressed)


def _unresolved_at(problem: Problem, first: Row, *more: Any) -> list[str]:
    """Return what the step does not resolve where a run begins; see `closedloop.scenario.modes.unresolved`."""
    depth = -float(first.closure_error)
    return modes.unresolved(problem.scenario, problem.robot, problem.q, first.surface_normal, depth, *more)


def failed(error: Exception) -> Outcome:
    """Return the outcome of a run that ended with an exception.

    A `ClosedLoopError` says what is wrong with the scenario. Any other is an unforeseen fault, of this package or of
    the computer: it affects its own row only, which says what and where, and the traceback goes to the log
    ``closedloop.simulation.batch.worker``. `simulate` with the row's values raises it.
    """
    if isinstance(error, ClosedLoopError):
        return Outcome(REFUSED, faults_on_one_line(error), 0, np.full(WIDTH, math.nan))
    logging.getLogger(__name__).debug("a run failed", exc_info=error)
    frames = traceback.extract_tb(error.__traceback__)[: -FRAMES - 1 : -1]
    where = ", called from ".join(f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}" for frame in frames)
    reason = one_line(f"{type(error).__name__}: {' '.join(str(error).split())}"[:MOST_SAID])
    return Outcome(FAILED, f"{reason} ({where})", 0, np.full(WIDTH, math.nan))
