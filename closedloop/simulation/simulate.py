"""From a scenario to a run: prepare the problem, step it, and keep what happened.

Each stage of each step asks Pinocchio for the terms of the state, and `closedloop.step.evaluate` for everything else.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.solve import LAW_FAILED
from closedloop.engines.failures import failure_of, interrupted
from closedloop.engines.loops import COMPILED, ENGINES, PINOCCHIO, SECONDS, SECONDS_WITH_MORE, loop_for
from closedloop.engines.own_law import law_digest
from closedloop.engines.pinocchio import addresses_of, set_events
from closedloop.engines.problem import Problem
from closedloop.engines.user_law import Law, UserLaw
from closedloop.errors import (
    DivergenceError,
    InterruptedRunError,
    LawError,
    ScenarioError,
    SimulationError,
)
from closedloop.events.phases import DONE, IMPACT_LAW_WANTED, ROOM, ROOM_FOR_EVENTS, TERMS
from closedloop.events.table import EVENT_WIDTH, event_columns
from closedloop.events.transitions import collide
from closedloop.integrators import ADAPTIVE, INTEGRATORS
from closedloop.interrupts import held_back
from closedloop.jit.background import make_ready, start
from closedloop.jit.interpreted import Interim, at_hand, call_now
from closedloop.jit.kernel import direct, plain
from closedloop.jit.pointers import address_of
from closedloop.record.run import Run
from closedloop.record.versions import package_versions
from closedloop.robot.tree import Tree, potential_energies, work_size
from closedloop.scenario.members import member_digests
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.prepare import prepare
from closedloop.step.memory import Loop
from closedloop.step.record_row import RECORDED, Row, complete_record, recorded, rows_there
from robot_models import RobotModel

Array = NDArray[np.float64]

# Steps between two calls of the progress function.
CHUNK = 400


def simulate(
    scenario: Scenario,
    *,
    law: Law | None = None,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
    engine: str = PINOCCHIO,
) -> Run:
    """Simulate a scenario.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`.
    law : callable, optional
        A law of one's own, ``law(t, q, v, terms) -> Q``, in place of the scenario's: t, s; q and q̇ (n,) read-only;
        `Terms` of that state; Q (n,), N m. It is evaluated as often as the scenario's law would be.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`: one made in Python, or the one inside a run file.
    progress : bool or callable, optional
        True draws a bar on standard error; a callable gets (steps done, steps in all).
    engine : "pinocchio" or "compiled"
        Who computes H, C, r, Jᵣ and J̇ᵣq̇: Pinocchio, or the package's own compiled terms (`closedloop.robot.tree`),
        which are equal to rounding and ten times as fast. The compiled engine takes a law of one's own that numba has
        compiled, see `closedloop.engines.user_law`.

    Returns
    -------
    Run
        The record.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario or the robot is at fault; nothing was simulated.
    SimulationError
        If the simulation could not go on; its `run` holds what ran. `SingularClosureError`, `DivergenceError` and
        others name the reason; `LawError` has what a law of one's own raised as its cause, and `InterruptedRunError`,
        which is a KeyboardInterrupt too, says that Ctrl-C came: between two steps, or at the end of the compiled loop.
    """
    check_engine(scenario, engine, law)
    problem = prepare(scenario, model)
    if progress is True:
        from closedloop.progress import bar

        with bar(scenario.name, problem.steps) as report:
            rows, events, failure, seconds = run_loop(problem, law, report, engine, keep_interrupted=True, interim=True)
    else:
        report = progress or _silent
        rows, events, failure, seconds = run_loop(problem, law, report, engine, keep_interrupted=True, interim=True)
    try:
        with held_back():
            run = _as_run(problem, rows, events, law, failure, seconds, engine)
    except KeyboardInterrupt as stop:  # it came while the record was being put together
        failure = failure or interrupted(stop, float(run.time[-1]))
    if failure is not None:
        failure.run = run
        raise failure
    return run


def check_engine(scenario: Scenario, engine: str, law: Law | None) -> None:
    """Refuse what an engine does not cover, before anything is prepared; of the robot's joints, `tree_of` does.

    Raises
    ------
    ScenarioError
        If there is no such engine, or the compiled one is asked for an integrator that chooses its steps or for a law
        that numba has not compiled, or cannot.
    """
    if engine not in ENGINES:
        raise ScenarioError(f"engine = {engine!r}: must be {' or '.join(map(repr, ENGINES))}")
    if engine == PINOCCHIO:
        return
    if scenario.time.integrator in ADAPTIVE:
        raise ScenarioError(
            f"engine = {engine!r}: has no integrator that chooses its steps, as {scenario.time.integrator!r} does; "
            f"use the engine 'pinocchio', or one of {', '.join(map(repr, INTEGRATORS))}"
        )
    if law is not None:
        from closedloop.engines.user_law import compiled_law

        compiled_law(law)


def _silent(done: int, total: int) -> None:
    """Report nothing."""


def run_loop(
    problem: Problem,
    law: Law | None = None,
    report: Callable[[int, int], None] = _silent,
    engine: str = PINOCCHIO,
    *,
    rows: Array | None = None,
    tree: tuple[Tree, Array] | None = None,
    interim: bool = False,
    keep_interrupted: bool = False,
) -> tuple[Array, Array, SimulationError | None, float]:
    """Step the problem.

    Parameters
    ----------
    problem, law, report, engine
        See `simulate`.
    rows : (>= steps + 1, width) array, optional
        Memory for the rows, whatever is in it.
    tree : (Tree, array), optional
        The problem's robot for the compiled engine, and its scratch, if they are there already.
    interim : bool
        Whether it may begin interpreted where the loop is not compiled yet; else that is compiled first.
    keep_interrupted : bool
        Whether Ctrl-C is a failure that leaves a record, as others do; else it goes through.

    Returns
    -------
    rows : (N, width) array
        What was recorded, in the order of `closedloop.step.record_row.Row`.
    events : (M, EVENT_WIDTH) array
        What happened between rows, see `closedloop.events.table`.
    failure : SimulationError or None
        Why it stopped early.
    seconds : float
        Time the steps took, s; on Pinocchio those after the first. Compilation is not counted.
    """
    if problem.tolerance is not None:
        from closedloop.engines.adaptive import run_adaptive

        check_engine(problem.scenario, engine, law)
        return run_adaptive(problem, law, report, keep_interrupted)
    robot, steps = problem.robot, problem.steps
    loop = problem.loop(own_law=law is not None)
    state, w = loop.state, loop.w
    user_law = None if law is None else UserLaw(law, loop)
    connect = partial(problem.connect, loop) if user_law is None else user_law.connect
    rows = np.empty((steps + 1, Row.count(robot.n))) if rows is None else rows
    events = np.zeros((ROOM_FOR_EVENTS, EVENT_WIDTH))
    machine = loop_for(engine, problem.more or law is not None)
    if interim:
        machine = _begun(machine, problem, loop, connect, law)
    else:
        make_ready(machine)
    connect(not (isinstance(machine, Interim) and machine.interpreting))
    step, many = _driver(problem, machine, loop, (problem.table, problem.integrator.tableau(), rows), engine, tree)

    def finish(done: int) -> None:
        call = partial(call_now, complete_record, loop_memory) if interim else complete_record
        call(loop.address, rows, done)

    loop_memory = (state.memory, w.memory)
    failure: SimulationError | None = None
    request = TERMS
    began, first, impacts = clock.perf_counter(), engine == PINOCCHIO, False
    try:
        report(0, steps)
        while True:
            if request == TERMS:
                request = (step if first else many)(events)
            elif request == ROOM:
                events = np.vstack([events, np.zeros_like(events)])
                request = step(events)
            elif request == IMPACT_LAW_WANTED:
                struck = clock.perf_counter()
                if interim:
                    call_now(collide, loop_memory, loop.address)
                else:
                    collide(loop.address)
                if not impacts:  # the first may have compiled it
                    began += clock.perf_counter() - struck
                impacts = True
                request = step(events)
            elif request == DONE:
                break
            elif state.status == LAW_FAILED and user_law is not None:
                raise user_law.failure()
            else:
                failure = failure_of(int(state.status), float(w.time), robot, problem, law, w.q, w.v)
                break
            if first:  # the first call compiled the kernel, or read it from the cache
                first, began = False, clock.perf_counter()
            report(int(state.row), steps)
        if failure is None:
            report(steps, steps)
        finish(int(state.row) + (failure is None))
    except (LawError, DivergenceError) as error:
        failure = error
    except KeyboardInterrupt as stop:
        if not keep_interrupted:
            raise
        failure = interrupted(stop, float(w.time))
    seconds = clock.perf_counter() - began - (machine.compiling if isinstance(machine, Interim) else 0.0)
    done = int(state.row) + (failure is None)
    if isinstance(failure, InterruptedRunError):
        done = rows_there(state, done, robot.n)
    finish(done)  # what an exception left; else there is nothing left
    return rows[:done], events[: int(state.events)], failure, seconds


def _driver(
    problem: Problem,
    machine: Callable[..., int],
    loop: Loop,
    arrays: tuple[Array, Array, Array],
    engine: str,
    made: tuple[Tree, Array] | None,
) -> tuple[Callable[[Array], int], Callable[[Array], int]]:
    """Return two functions of the table of events: they provide terms once, and as long as nothing else is asked."""
    if engine == COMPILED:
        from closedloop.engines.compiled import ALL, compiled_tree, compiled_work

        tree, work = made or (compiled_tree(problem), compiled_work(problem.robot.n))
        if not isinstance(machine, Interim) and not getattr(machine, "signatures", ()):
            # Compiled, or read, before the clock starts.
            direct(machine, tree, work, loop.address, *arrays, np.zeros((0, EVENT_WIDTH)), ALL)

        def go_on(events: Array) -> int:
            # Interpreted, it comes back after each evaluation, as Pinocchio does, and can be interrupted.
            most = 1 if isinstance(machine, Interim) and machine.interpreting else ALL
            return machine(tree, work, loop.address, *arrays, events, most)

        return go_on, go_on

    robot = problem.robot
    addresses = addresses_of(robot.views, loop, *arrays, np.zeros((0, EVENT_WIDTH)))
    crba, bias, convention, pinocchio, data = robot.passes
    q, v, at = loop.w.q, loop.w.v, address_of(addresses.memory)

    def chunk(length: int) -> Callable[[Array], int]:
        def go_on(events: Array) -> int:
            set_events(addresses, events)
            request, call = TERMS, direct(machine, at)
            for _ in range(length):
                crba(pinocchio, data, q, convention)  # as in `Robot.evaluator`, without a call
                bias(pinocchio, data, q, v)
                request = call(at)
                if request != TERMS:
                    break
            return request

        return go_on

    return chunk(1), chunk(CHUNK)


def _begun(
    machine: Callable[..., int], problem: Problem, loop: Loop, connect: Callable[[], None], law: Law | None
) -> Callable[..., int]:
    """Return the loop, or what it is begun with if it is not compiled; and have compiled what else is missing."""
    with_it: list[Callable[..., Any]] = [
        complete_record,
        *([collide] if loop.state.unilateral else []),
        *([] if law else problem.entries()),
    ]
    if not at_hand(machine):
        calls = problem.steps * problem.integrator.stages
        seconds = SECONDS_WITH_MORE if problem.more or law is not None else SECONDS
        return Interim(machine, (loop.state.memory, loop.w.memory), calls, seconds, with_it, connect)
    make_ready(machine)
    start([function for function in with_it if not at_hand(function)])
    return machine


def _as_run(
    problem: Problem,
    rows: Array,
    events: Array,
    law: Law | None,
    failure: SimulationError | None,
    seconds: float,
    engine: str,
) -> Run:
    n, count = problem.robot.n, rows.shape[0]
    wanted = problem.table[:: problem.nodes][:count]
    reference_rows = problem.path[:: problem.nodes][:count]
    columns: dict[str, NDArray[Any]] = {
        "time": problem.h * np.arange(count),
        "reference_position": reference_rows[:, 0].copy(),
        "reference_velocity": reference_rows[:, 1].copy(),
        "reference_tip": wanted[:, 2 * n : 2 * n + 3] @ problem.frame,
        "reference_force": wanted[:, 2 * n + 9].copy(),
    }
    columns |= {name: recorded(rows, n, name) for name in RECORDED}
    columns["mode"] = columns["mode"].astype(np.int8)
    columns["potential_energy"] = np.empty(count)
    potential_energies(problem.robot.tree, columns["q"], np.zeros(plain(work_size)(n)), columns["potential_energy"])
    return Run(
        scenario=problem.scenario,
        model=problem.robot.model,
        columns=columns | event_columns(events),
        law="scenario" if law is None else _law_name(law),
        versions=package_versions(),
        stopped=str(failure) if failure else None,
        wall_seconds=seconds,
        engine=engine,
        law_digest="" if law is None else law_digest(law),
        member_digests=member_digests(problem.scenario),
    )


def _law_name(law: Law) -> str:
    module, name = getattr(law, "__module__", "?"), getattr(law, "__qualname__", type(law).__name__)
    return f"{module}:{name}"
