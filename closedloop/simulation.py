"""From a scenario to a run: prepare the problem, step it, and keep what happened.

Each stage of each step asks Pinocchio for the terms of the state, and `closedloop.step` for everything else.
"""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.addresses import address_of
from closedloop.compiled import direct
from closedloop.control import Law
from closedloop.control.gains import gains_fault
from closedloop.errors import (
    ChatterError,
    DivergenceError,
    InterruptedRunError,
    LawError,
    PainleveError,
    ScenarioError,
    SimulationError,
    SingularClosureError,
)
from closedloop.events import EVENT_WIDTH, event_columns
from closedloop.forms import COMPILED, ENGINES, PINOCCHIO, machine
from closedloop.integrate import ADAPTIVE, INTEGRATORS
from closedloop.interrupts import held_back, word_for
from closedloop.machine.events import collide
from closedloop.machine.phases import DONE, IMPACT_LAW_WANTED, ROOM, TERMS, TERMS_AND_LAW
from closedloop.own_law import law_digest, law_failure
from closedloop.pinocchio_engine import AT_EVENTS, EVENT_ROOM, places_of
from closedloop.preparation import prepare
from closedloop.problem import Problem
from closedloop.record import Run
from closedloop.robot import Robot
from closedloop.rows import SCALARS, Row, complete_record, rows_there
from closedloop.scenario import Scenario
from closedloop.solve import CHATTER, NOT_POSITIVE_DEFINITE, PAINLEVE, SINGULAR
from closedloop.step import SPEED_LIMIT
from closedloop.tree import Tree
from closedloop.workspace import EVENTS, ROW, STATUS, TIME, Work
from robot_models import RobotModel

Array = NDArray[np.float64]

# Steps between two calls of the progress function.
CHUNK = 400
# Who provides the terms.
# What a driver may return beside what `closedloop.machine` does: a compiled law gave a torque that is not finite.
NOT_FINITE = -1
# Events for which there is room at first; the table grows as needed.
ROOM_FOR_EVENTS = 64


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
        Who computes H, C, r, Jᵣ and J̇ᵣq̇: Pinocchio, or the package's own compiled terms (`closedloop.tree`), which
        are equal to rounding and ten times as fast. The compiled engine takes a law of one's own that numba has
        compiled, see `closedloop.compiled_law`.

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
            rows, events, failure, seconds = run_loop(problem, law, report, engine, keep_interrupted=True)
    else:
        rows, events, failure, seconds = run_loop(problem, law, progress or _silent, engine, keep_interrupted=True)
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
        from closedloop.compiled_law import compiled_law

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
    ahead: int = 0,
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
    ahead : int
        How many steps are to come, in this run and others: whether a loop for just this robot is worth compiling.
    keep_interrupted : bool
        Whether Ctrl-C is a failure that leaves a record, as others do; else it goes through.

    Returns
    -------
    rows : (N, width) array
        What was recorded, in the order of `closedloop.rows.Row`.
    events : (M, EVENT_WIDTH) array
        What happened between rows, see `closedloop.events`.
    failure : SimulationError or None
        Why it stopped early.
    seconds : float
        Time the steps took, s; on Pinocchio those after the first. Compilation is not counted.
    """
    if problem.tolerance is not None:
        from closedloop.adaptive import run_adaptive

        check_engine(problem.scenario, engine, law)
        return run_adaptive(problem, law, report, keep_interrupted)
    robot, steps = problem.robot, problem.steps
    given = law is not None
    k, state, memory = problem.constants(), problem.state(given), problem.memory(given)
    w = problem.views(memory, state)
    # The compiled engine asks the law by itself.
    user_torque = None if law is None or engine == COMPILED else checked_law(law, robot, w.q, w.v)
    rows = np.zeros((steps + 1, Row.of(robot.n).width)) if rows is None else rows
    events = np.zeros((ROOM_FOR_EVENTS, EVENT_WIDTH))
    arrays = (k, state, memory, problem.table, problem.integrator.tableau(), rows)
    step, many = _driver(problem, w, arrays, engine, law, tree, ahead)
    failure: SimulationError | None = None
    request = TERMS if user_torque is None else TERMS_AND_LAW
    began, first, impacts = clock.perf_counter(), engine == PINOCCHIO, False
    try:
        report(0, steps)
        while True:
            if request == TERMS:
                request = (step if first else many)(events)
            elif request == TERMS_AND_LAW:
                assert user_torque is not None
                fault = user_torque(float(w.now[TIME]), w.torque)
                if fault:
                    t = float(w.now[TIME])
                    failure = DivergenceError(f"{when(t)}: {fault}", t)
                    break
                request = step(events)
            elif request == ROOM:
                events = np.vstack([events, np.zeros_like(events)])
                request = step(events)
            elif request == IMPACT_LAW_WANTED:
                struck = clock.perf_counter()
                collide(k, state, memory, robot.n)
                if not impacts:  # the first may have compiled it
                    began += clock.perf_counter() - struck
                impacts = True
                request = step(events)
            elif request == DONE:
                break
            elif request == NOT_FINITE:
                t = float(w.now[TIME])
                failure = DivergenceError(f"{when(t)}: {not_finite(w.torque)}", t)
                break
            else:
                failure = failure_of(int(state[STATUS]), float(w.now[TIME]), robot, problem, law, w.q, w.v)
                break
            if first:  # the first call compiled the kernel, or read it from the cache
                first, began = False, clock.perf_counter()
            report(int(state[ROW]), steps)
        if failure is None:
            report(steps, steps)
        complete_record(w.pending, rows, state, int(state[ROW]) + (failure is None), robot.n)
    except LawError as error:
        failure = error
    except KeyboardInterrupt as stop:
        if not keep_interrupted:
            raise
        failure = interrupted(stop, float(w.now[TIME]))
    seconds = clock.perf_counter() - began
    done = int(state[ROW]) + (failure is None)
    if isinstance(failure, InterruptedRunError):
        done = rows_there(state, done, robot.n)
    complete_record(w.pending, rows, state, done, robot.n)  # what an exception left; else there is nothing left
    return rows[:done], events[: int(state[EVENTS])], failure, seconds


def _driver(
    problem: Problem,
    w: Work,
    arrays: tuple[Any, ...],
    engine: str,
    law: Law | None,
    made: tuple[Tree, Array] | None,
    ahead: int,
) -> tuple[Callable[[Array], int], Callable[[Array], int]]:
    """Return two functions of the table of events: they provide terms once, and as long as nothing else is asked."""
    if engine == COMPILED:
        from closedloop.compiled_engine import compiled_tree, compiled_work

        run = machine(problem.more, engine, problem.robot.n, ahead)
        tree, work = made or (compiled_tree(problem), compiled_work(problem.robot.n))
        if law is not None:
            from closedloop.compiled_law import compiled_law, loop_with_law

            with_law = loop_with_law(run, law, compiled_law(law), tree, work, w, arrays)
            return with_law, with_law
        if not getattr(run, "signatures", ()):
            direct(run, tree, work, *arrays, np.zeros((0, EVENT_WIDTH)))  # compiled, or read, before the clock starts

        def go_on(events: Array) -> int:
            return run(tree, work, *arrays, events)

        return go_on, go_on

    robot, proceed = problem.robot, machine(problem.more, engine, problem.robot.n, ahead)
    k, state, memory, table, tableau, rows = arrays
    places = places_of(robot.views, k, state, memory, table, tableau, rows, np.zeros((0, EVENT_WIDTH)))
    crba, bias, convention, pinocchio, data = robot.passes
    q, v, at = w.q, w.v, address_of(places)

    def chunk(length: int) -> Callable[[Array], int]:
        def go_on(events: Array) -> int:
            places[AT_EVENTS], places[EVENT_ROOM] = address_of(events), events.shape[0]
            request, call = TERMS, direct(proceed, at)
            for _ in range(length):
                crba(pinocchio, data, q, convention)  # as in `Robot.evaluator`, without a call
                bias(pinocchio, data, q, v)
                request = call(at)
                if request != TERMS:
                    break
            return request

        return go_on

    return chunk(1), chunk(CHUNK)


def checked_law(law: Law, robot: Robot, q: Array, v: Array) -> Callable[[float, Array], str]:
    """Wrap a user's law: give it read-only copies, check what it returns, and write that into the torque.

    The function returned takes t, s, reads the state from q and q̇ (n,), writes Q (n,), N m, and returns what is wrong
    with it in words, or "".
    """

    if hasattr(law, "py_func"):
        from closedloop.compiled_law import as_returning

        law = as_returning(law, robot.n)

    def evaluate(t: float, torque: Array) -> str:
        q_, v_ = q.copy(), v.copy()
        q_.setflags(write=False)
        v_.setflags(write=False)
        try:
            answer = law(t, q_, v_, robot.terms(q, v))
        except (Exception, SystemExit) as error:
            raise law_failure(law, error, t) from error
        fault = ""
        try:
            given = np.asarray(answer)
        except (TypeError, ValueError):  # lists of different lengths
            given, fault = np.zeros(0), f"{str(answer)[:60]!r}"
        if given.dtype.kind not in "iuf":
            fault = f"{str(answer)[:60]!r}"
        elif not fault and given.shape != torque.shape:
            fault = f"Q of shape {given.shape}"
        if fault:
            raise not_a_torque(fault, t, robot.n)
        if not np.all(np.isfinite(given)):
            return not_finite(given)
        torque[:] = given
        return ""

    return evaluate


def not_finite(torque: Array) -> str:
    """Return what is wrong with a law's torque Q (n,) that has an entry which is no finite number, in words."""
    return f"the law returned Q = {torque.tolist()}, which is not finite"


def not_a_torque(returned: str, t: float, n: int) -> ScenarioError | LawError:
    """Return the error of a law that returned at t, s, what is no torque of n joints; at t = 0 s nothing ran yet."""
    what = f"the law returned {returned} at t = {t:g} s: must be {n} real numbers, one torque a joint, ({n},)"
    return LawError(f"{when(t)}: {what}", t) if t > 0.0 else ScenarioError(what)


def when(t: float) -> str:
    """Return the beginning of the message of a run that stopped at t, s."""
    return f"stopped at t = {t:.6g} s"


def interrupted(stop: KeyboardInterrupt, t: float) -> InterruptedRunError:
    """Return the error of a run that Ctrl-C, or another signal, stopped at t, s."""
    error = InterruptedRunError(f"{when(t)}: {word_for(stop)}", t)
    error.__cause__ = stop
    return error


def failure_of(
    status: int, t: float, robot: Robot, problem: Problem, law: Law | None, q: Array, v: Array
) -> SimulationError:
    """Return what a status of `closedloop.solve` other than OK, met at q and q̇ (n,) at t, s, is in words."""
    if status == SINGULAR:
        pose = np.array2string(q, precision=4, separator=", ", suppress_small=True)
        return SingularClosureError(
            f"{when(t)}: singular pose: at q = {pose} the tip cannot move along the surface normal "
            f"{problem.plane.normal.round(4).tolist()}, so Eq. 24 does not determine the contact force; "
            "start from, or steer through, another posture",
            t,
        )
    if status == NOT_POSITIVE_DEFINITE:
        return SingularClosureError(
            f"{when(t)}: the mass matrix of {robot.model.name} is not positive definite; "
            "some joint moves no inertia (look at the masses and tensors of the last links)",
            t,
        )
    if status == CHATTER:
        return ChatterError(
            f"{when(t)}: the contact chatters: at one instant the torque presses the tip on while it is off the "
            "surface and lifts it off while it is on; look at a law that depends on the contact, and at time.step",
            t,
        )
    if status == PAINLEVE:
        return PainleveError(
            f"{when(t)}: Painlevé's paradox: the tip slides so that pressing harder pulls it into the surface (the "
            "coefficient of f in Eq. 24 with friction is not positive), and no rigid contact force exists; lower the "
            "coefficient of friction, or change the posture or the direction of sliding",
            t,
        )
    fast = int(np.argmax(np.abs(v))) if np.all(np.isfinite(v)) else 0
    name = robot.joint_names[fast]
    cure = "look at the signs and sizes " + ("of law.kp and law.kd" if law is None else "in the law")
    if problem.tolerance is None:
        cure += ", and at time.step"
    if law is None:
        cure = gains_fault(problem.scenario, robot) or cure
    return DivergenceError(
        f"{when(t)}: the motion diverges: joint {name} is beyond {SPEED_LIMIT:g} rad/s or not a number; {cure}", t
    )


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
    columns["potential_energy"] = problem.robot.potential_energy(columns["q"])
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
    )


RECORDED = tuple(name for name in Row._fields if name not in ("scalars", "width")) + SCALARS


def recorded(rows: Array, n: int, name: str) -> Array:
    """Return a copy of one of the columns `RECORDED`, (N,) or (N, k), of the rows of a robot of n joints."""
    layout = Row.of(n)
    if name in SCALARS:
        return rows[:, layout.scalars + SCALARS.index(name)].copy()
    place = Row._fields.index(name)
    return rows[:, layout[place] : layout[place + 1]].copy()


def _law_name(law: Law) -> str:
    module, name = getattr(law, "__module__", "?"), getattr(law, "__qualname__", type(law).__name__)
    return f"{module}:{name}"


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages whose arithmetic a run depends on."""
    names = ("closedloop", "pin", "numpy", "numba", "llvmlite")
    return {"python": sys.version.split()[0]} | {name: _version(name) for name in names}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
