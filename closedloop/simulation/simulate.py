"""From a scenario to a run: prepare the problem, step it, and make the record of its rows.

The same at half the step says by how much each value differs. So the error of the step is measured.
"""

import time as clock
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import DivergenceError, InterruptedRunError, LawError, ScenarioError, SimulationError
from closedloop.base.interrupts import held_back
from closedloop.base.progress import reporting
from closedloop.control.reference.desired import Reference
from closedloop.jit.interim import Interim, at_hand, call_now, not_compiled_first
from closedloop.jit.kernel import plain
from closedloop.loop.events.locate import DONE, TERMS
from closedloop.loop.events.table import EVENT_COLUMNS, EVENT_WIDTH, event_column
from closedloop.loop.step.record_row import complete_record, rows_there
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.mechanics.robot.tree import Tree, energies_of_rows, potential_energies, work_size
from closedloop.record.columns.derived import DERIVED, RESERVED, Recorded, check_names, own_columns
from closedloop.record.columns.record import ALL_COLUMNS, POSITIONS, ColumnsOnDemand
from closedloop.record.report.halved import halved_comparison, step_error
from closedloop.record.run import Run
from closedloop.record.save import package_versions
from closedloop.scenario.arm import start_positions, without_tools
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.failures import interrupted, member_error
from closedloop.simulation.engines.law_source import arguments_of, fresh, law_digest
from closedloop.simulation.engines.loops import COMPILED, ENGINES, PINOCCHIO, loop_for
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.loop_calls import Driver, drive
from closedloop.simulation.parts import kept_cache
from closedloop.simulation.prepare import borrowed, problem_of
from robot_models import RobotModel
from robot_models.coordinates import continuous, with_quaternions
from robot_models.errors import shown

# Runs of one process after which it is worth reading the compiled form of `potential_energies` from the disk.
FEW_RUNS = 3
_runs = count(1)


def as_run(
    problem: Problem, rows: Array, events: Array, seconds: float, engine: str, *,
    law: tuple[str, str] = ("scenario", ""), with_states: bool = True, stopped: str | None = None, first: int = 0,
) -> Run:  # fmt: skip
    """Return the rows and events of a problem, see `run_loop`, as a run; the rest as in `Run`.

    `law` is the name and the digest of what drove it, `with_states` whether the rows have the states of the scenario's,
    `first` the number of the first of the rows.
    """
    source = _Source.of(problem, rows, problem.table[first * problem.nodes :], events, first)
    return Run(  # type: ignore[abstract]  # its columns are there by their names
        scenario=problem.scenario,
        model=without_tools(problem.robot.model),
        columns=ColumnsOnDemand(problem.record.names[with_states], source.column),
        law=law[0],
        versions=package_versions(),
        stopped=stopped,
        wall_seconds=seconds,
        engine=engine,
        law_digest=law[1],
        member_digests=problem.member_digests,
        added=problem.record.states if with_states else {},
    )


class _Source(NamedTuple):
    """What the columns of a run are made of: not the problem, whose table is large and may be another's next."""

    rows: Array
    wanted: Array  # (N, 2 n + 10): what is desired at each row
    events: Array
    first: int
    h: float
    places: Mapping[str, tuple[bool, int | slice]]
    tree: Tree
    model: RobotModel
    scenario: Scenario

    @classmethod
    def of(cls, problem: Problem, rows: Array, table: Array, events: Array, first: int = 0) -> "_Source":
        """Return what the columns of rows, with the table of what is desired from the first of them on, are made of."""
        robot = problem.robot
        wanted = table[: len(rows) * problem.nodes : problem.nodes, : Reference.count(robot.n)].copy()
        return cls(
            rows, wanted, events, first, problem.h, problem.record.places, robot.tree, robot.model, problem.scenario
        )

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of the run, by its name."""
        if name == "time":
            return self.h * np.arange(self.first, self.first + len(self.rows))
        if name == "potential_energy":
            return _potential_energies(self.tree, self.of_loop("q"))
        if name in EVENT_COLUMNS:
            return event_column(self.events, name)
        found = self.of_loop(name)
        if name in POSITIONS and self.model.balls:
            return _told(self.scenario, self.model, found)
        return found.astype(np.int8) if name in ("mode", "link_modes") else found

    def of_loop(self, name: str) -> Array:
        """Return a column as rows and table have it, a copy: of their derivatives it is the derivative."""
        of_row, place = self.places[name]
        return (self.rows if of_row else self.wanted)[:, place].copy()


def columns_of_rows(problem: Problem, rows: Array, table: Array) -> dict[str, NDArray[Any]]:
    """Return the columns that rows and the table of what is desired have as they are, and the time.

    They are copies of parts of both: of derivatives of rows and table they are the derivatives of the columns.
    """
    source = _Source.of(problem, rows, table, np.empty((0, EVENT_WIDTH)))
    return {"time": source.column("time"), **{name: source.of_loop(name) for name in source.places}}


def positions_told(problem: Problem, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return those of a run's columns that are positions as the run tells them, (N, nq), from what the loop has."""
    model = problem.robot.model
    if not model.balls:
        return {}
    return {name: _told(problem.scenario, model, x) for name, x in columns.items() if name in POSITIONS}


def _told(scenario: Scenario, model: RobotModel, q: Array) -> Array:
    types = model.joint_types
    return continuous(with_quaternions(q, types), types, start_positions(scenario, model))


def _potential_energies(tree: Tree, q: Array) -> Array:
    """Return the potential energy (N,) at each row of q (N, n), J."""
    if next(_runs) <= FEW_RUNS or not at_hand(potential_energies):
        return energies_of_rows(tree, q)
    energies = np.empty(q.shape[0])
    potential_energies(tree, q, np.zeros(plain(work_size)(tree.n)), energies)
    return energies


def law_name(law: Law) -> str:
    """Return the name of a user's law, MODULE:NAME."""
    module, name = getattr(law, "__module__", "?"), getattr(law, "__qualname__", type(law).__name__)
    return f"{module}:{name}"


@arguments_checked(record="a function of the run, or (function, unit), by the name of its column")
def simulate(
    scenario: Scenario, *, law: Law | None = None, model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False, engine: str = PINOCCHIO, record: Recorded | None = None,
) -> Run:  # fmt: skip
    """Simulate a scenario.

    If the loop is not compiled yet, the run may start interpreted while the loop is compiled in the background
    (`closedloop.jit.background`), with the same result to the last bit; the logger ``closedloop.compiling`` says so.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`.
    law : callable, optional
        A user's law in place of the scenario's, ``law(x) -> Q`` with x a `LawInput`, or ``law(t, q, v, terms) -> Q``:
        t, s; q and q̇ (n,) read-only; `Terms` of that state; Q (n,), N m. It is evaluated as often as the scenario's
        law would be.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`: one made in Python, or the one inside a run file.
    progress : bool or callable, optional
        True draws a bar on standard error; a callable gets (steps done, steps in all).
    engine : "pinocchio" or "compiled"
        The source of H, C, r, Jᵣ and J̇ᵣq̇: Pinocchio, or the package's own compiled terms
        (`closedloop.mechanics.robot.tree`), which are equal to rounding and a few times as fast. The compiled engine
        takes a user's law only if numba has compiled it, see `closedloop.simulation.engines.user_law`.
    record : mapping of str to callable, optional
        Columns of your own: by name a function of the `Run` that returns (N,) or (N, k) finite numbers, or a pair of
        such a function and a unit, ``{"power": (power, "W")}``. They are computed once, at the end, and are columns
        of the run and its file like all others.

    Returns
    -------
    Run
        The record.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario or the robot is at fault; nothing was simulated.
    SimulationError
        If the simulation stopped early; its `run` holds the rows until then. `SingularClosureError`,
        `DivergenceError` and others name the reason; the cause of a `LawError` is the exception of the user's law;
        `InterruptedRunError`, also a KeyboardInterrupt, follows Ctrl-C, between two steps.
    """
    with kept_cache(scenario, model) as cache:
        return _simulated(scenario, lambda: problem_of(scenario, model, cache), law, progress, engine, record)


def simulate_changed(
    scenario: Scenario, problem: Problem, law: Law | None, progress: bool | Callable[[int, int], None], engine: str,
    record: Recorded | None, kept: bool,
) -> Run:  # fmt: skip
    """Simulate a problem, or its scenario with other values; see `simulate`, and of `kept` `problem_of`."""
    if scenario is problem.scenario:
        return _simulated(scenario, lambda: problem, law, progress, engine, record)
    if scenario.robot.model != problem.scenario.robot.model:
        return simulate(scenario, law=law, progress=progress, engine=engine, record=record)
    with borrowed(problem) as cache:
        return _simulated(
            scenario, lambda: problem_of(scenario, problem.model_given, cache, kept), law, progress, engine, record
        )


def _simulated(
    scenario: Scenario, prepared: Callable[[], Problem], law: Law | None,
    progress: bool | Callable[[int, int], None], engine: str, record: Recorded | None,
) -> Run:  # fmt: skip
    problem: Problem | None = None
    check_engine(scenario, engine, law)
    if record:
        check_names(record, set(ALL_COLUMNS) | set(dir(Run)) | set(DERIVED) | RESERVED)
    try:
        with held_back(), not_compiled_first():
            problem = prepared()
        showing = reporting(progress, problem.scenario.name, problem.steps) if progress else nullcontext(_silent)
        with showing as report:
            rows, events, failure, seconds = run_loop(problem, law, report, engine, keep_interrupted=True, interim=True)
    except KeyboardInterrupt as stop:
        if problem is None:
            raise  # a second one, which does not wait
        rows, events = np.empty((0, problem.row_width)), np.empty((0, EVENT_WIDTH))
        failure, seconds = interrupted(stop, 0.0), 0.0
    run: Run | None = None
    try:
        with held_back(), not_compiled_first():
            stopped = str(failure) if failure else None
            name, digest = ("scenario", "") if law is None else (law_name(law), law_digest(law))
            run = as_run(
                problem, rows, events, seconds, engine, law=(name, digest), with_states=law is None, stopped=stopped
            )
    except KeyboardInterrupt as stop:  # it came while the record was being assembled
        if run is None:
            raise  # a second one, which does not wait
        failure = failure or interrupted(stop, float(run.time[-1]))
    if record and len(run):
        try:
            check_names(record, {*dir(run), *RESERVED})
            values, added = own_columns(run, record)
            run = replace(run, columns={**run.columns, **values}, added={**run.added, **added})
        except LawError as error:
            if failure is None:
                raise
            failure.add_note(str(error))
    if failure is not None:
        failure.run = run
        raise failure
    return run


def check_engine(scenario: Scenario, engine: str, law: Law | None) -> None:
    """Refuse what an engine does not cover, before anything is prepared; joint types are checked by `tree_of`.

    Raises ScenarioError if it is no scenario, if there is no such engine, if a law takes other arguments than it is
        given, or if with the compiled engine the integrator is adaptive or the law is not, or cannot be, compiled by
        numba.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"scenario = {shown(scenario)}: must be a Scenario, as load_scenario('wam_slide') returns")
    if engine not in ENGINES:
        raise ScenarioError(f"engine = {engine!r}: must be {' or '.join(map(repr, ENGINES))}")
    if law is not None:
        arguments_of(law)
    if engine == PINOCCHIO:
        return
    if scenario.time.integrator not in INTEGRATORS:
        raise ScenarioError(
            f"engine = {engine!r}: has no integrator that chooses its steps, as {scenario.time.integrator!r} does; "
            f"use the engine 'pinocchio', or one of {', '.join(map(repr, INTEGRATORS))}"
        )
    if law is not None:
        from closedloop.simulation.engines.compiled_law import compiled_law

        compiled_law(law)


def _silent(done: int, total: int) -> None:
    """Report nothing."""


def run_loop(
    problem: Problem, law: Law | None = None, report: Callable[[int, int], None] = _silent, engine: str = PINOCCHIO, *,
    rows: Array | None = None, interim: bool = False, keep_interrupted: bool = False,
) -> tuple[Array, Array, SimulationError | None, float]:  # fmt: skip
    """Step the problem.

    Parameters
    ----------
    report : callable
        Called with the number of rows that are done and of all, every `closedloop.simulation.engines.loops.MOMENT`, s;
        they are in `rows` then, but for the last condition numbers.
    rows : (>= steps + 1, width) array, optional
        Memory for the rows; its content is overwritten.
    interim : bool
        Whether the run may begin interpreted while the loop is not compiled yet; else the loop is compiled first.
    keep_interrupted : bool
        Whether Ctrl-C ends the run as a failure with its record; else it is raised.

    Returns
    -------
    rows : (N, width) array
        The record, in the order of `closedloop.loop.step.record_row.Row`.
    events : (M, EVENT_WIDTH) array
        See `closedloop.loop.events.table`.
    failure : SimulationError or None
        Why it stopped early.
    seconds : float
        Wall time of the steps, s, without compilation.
    """
    if problem.tolerance is not None:
        from closedloop.simulation.engines.adaptive import run_adaptive

        check_engine(problem.scenario, engine, law)
        return run_adaptive(problem, law, report, keep_interrupted)
    robot, steps = problem.robot, problem.steps
    rows = np.empty((steps + 1, problem.row_width)) if rows is None else rows
    driver: Driver | None = problem.spare.pop(engine, None) if law is None else None
    if driver is None or not driver.fits(problem):
        memory = driver.loop if driver else None
        driver = Driver(problem, rows, engine, law=law, interim=interim, into=memory, kept=True)
    else:
        driver.begin(problem, rows)
    kernel, answers, once, many = driver.kernel, driver.answers, driver.once, driver.many
    loop, (state, _, w) = driver.loop, driver.loop

    def finish(done: int) -> None:
        if interim:
            call_now(complete_record, (state.memory, w.memory), loop.address, rows, done)
        else:
            complete_record(loop.address, rows, done)

    def reported() -> bool:
        report(int(state.row), steps)
        return True

    failure: SimulationError | None = None
    began = clock.perf_counter()
    try:
        report(0, steps)
        if drive(lambda request: many() if request == TERMS else once(), answers.give, reported) == DONE:
            report(steps, steps)
            finish(int(state.row) + 1)
        else:
            failure = driver.failure()
    except (LawError, DivergenceError) as error:
        failure = error
    except Exception as error:
        failure = member_error(problem, error, float(w.time))
        if failure is None:
            raise
    except KeyboardInterrupt as stop:
        if not keep_interrupted:
            raise
        failure = interrupted(stop, float(w.time))
    finally:
        driver.close()
    seconds = clock.perf_counter() - began - answers.compiling
    seconds -= kernel.compiling if isinstance(kernel, Interim) else 0.0
    done = int(state.row) + (failure is None)
    if isinstance(failure, InterruptedRunError):
        done = rows_there(state, done, robot.n)
    if failure is not None:
        finish(done)
    events = answers.events[: int(state.event.rows)].copy()
    if driver.may_be_kept:
        driver.end()
        problem.spare[engine] = driver
    return rows[:done], events, failure, seconds


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
    scenario: Scenario, *, law: Law | None = None, model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False, engine: str = PINOCCHIO,
) -> Run:  # fmt: skip
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
    run: Run, *, law: Law | None = None, model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False, engine: str | None = None,
) -> Run:  # fmt: skip
    """Simulate what a run is of again, at half the step, and return the run with the comparison; see `halve`.

    Without an `engine` it is the compiled one where it can run this and is compiled already, else the run's own: they
    differ by rounding.

    Raises InterruptedRunError after Ctrl-C; its `run` is the one given.
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
