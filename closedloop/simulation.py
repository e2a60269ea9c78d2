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

from closedloop.compiled import forget_old_caches, needs_compiling
from closedloop.control import Law
from closedloop.errors import DivergenceError, ScenarioError, SimulationError, SingularClosureError
from closedloop.problem import Problem, prepare
from closedloop.projection import CLOSED, MOST_MOVES, POSITION, VELOCITY, project_on_pinocchio
from closedloop.record import PRESSED, Run
from closedloop.robot import Robot
from closedloop.scenario import Scenario
from closedloop.solve import NOT_POSITIVE_DEFINITE, OK, SINGULAR
from closedloop.step import (
    LAW_GIVEN,
    LAW_PAPER,
    SCALARS,
    SPEED_LIMIT,
    Row,
    memory_layout,
    pack_constants,
    step_on_pinocchio,
)
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

    Returns
    -------
    Run
        The record.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario or the robot is at fault; nothing was simulated.
    SimulationError
        If the simulation could not go on (`SingularClosureError`, `DivergenceError`); its `run` holds what ran.
    """
    problem = prepare(scenario, model)
    compiled_now = needs_compiling(step_on_pinocchio)
    if progress is True:
        from closedloop.progress import bar

        with bar(scenario.name, problem.steps) as report:
            rows, failure, seconds = run_loop(problem, law, report)
    else:
        rows, failure, seconds = run_loop(problem, law, progress or _silent)
    if compiled_now:
        forget_old_caches()
    run = _as_run(problem, rows, law, failure, seconds)
    if failure is not None:
        failure.run = run
        raise failure
    return run


def _silent(done: int, total: int) -> None:
    """Report nothing."""


def run_loop(
    problem: Problem, law: Law | None = None, report: Callable[[int, int], None] = _silent
) -> tuple[Array, SimulationError | None, float]:
    """Step the problem.

    Returns
    -------
    rows : (N, width) array
        What was recorded, in the order of `closedloop.step.Row`.
    failure : SimulationError or None
        Why it stopped early.
    seconds : float
        Time the steps after the first took, s: compilation is not counted.
    """
    robot, scheme, h, steps, path = problem.robot, problem.integrator, problem.h, problem.steps, problem.path
    n = robot.n
    per_step = (path.shape[0] - 1) // steps
    constants = pack_constants(
        [*problem.plane.normal, problem.plane.offset], problem.stabiliser, problem.settings,
        robot.tip_offset, robot.gravity, h, h / per_step, scheme.semi_implicit,
    )  # fmt: skip
    memory = np.zeros((memory_layout(n, 1, scheme.stages)[-1], n))
    memory[0], memory[1] = problem.q, problem.v
    q, v, torque = memory[:3]
    rows = np.zeros((steps + 1, Row.of(n, 1).width))
    fixed = (
        *robot.views,
        constants,
        np.vstack([problem.gains, robot.support]),
        path,
        scheme.tableau(),
        memory,
        rows,
    )
    stages = tuple(enumerate(problem.nodes))
    plain = law is None and not problem.hold and not problem.project and len(stages) == 1
    evaluate, hold = robot.evaluator(q, v), problem.hold
    kind = LAW_PAPER if law is None else LAW_GIVEN
    user_torque = None if law is None else _checked_law(law, robot, q, v)
    project = _projection(fixed[:-4], memory, evaluate) if problem.project else None
    if project is not None:
        project()

    failure: SimulationError | None = None
    began = clock.perf_counter()
    for i in range(steps + 1):
        if i == 1:
            began = clock.perf_counter()  # the first step compiled the kernel, or read it from the cache
        if i % CHUNK == 0:
            report(i, steps)
        if plain:  # the common case, without the loop over stages and without asking who computes the torque
            evaluate()
            status = step_on_pinocchio(i, i, 0, LAW_PAPER, *fixed)
            if status == OK:
                continue
            failure, rows = _failure(status, i * h, robot, problem, law, q, v), rows[:i]
            break
        for stage, node in stages if i < steps else stages[:1]:
            at = i * per_step + node
            sampled = not hold or (stage == 0 and i % hold == 0)
            if sampled and user_torque is not None:
                fault = user_torque(at * h / per_step, torque)
                if fault:
                    failure = DivergenceError(f"{_when(at * h / per_step)}: {fault}", at * h / per_step)
                    break
            evaluate()
            status = step_on_pinocchio(i, at, stage, kind if sampled else LAW_GIVEN, *fixed)
            if status != OK:
                failure = _failure(status, at * h / per_step, robot, problem, law, q, v)
                break
        if failure is not None:
            rows = rows[: i + (stage > 0)]  # a later stage may fail where the row's own state did not
            break
        if project is not None:
            project()
    report(len(rows) - 1, steps)
    return rows, failure, clock.perf_counter() - began


def _projection(passed: tuple[Array, ...], memory: Array, evaluate: Callable[[], None]) -> Callable[[], None]:
    """Return a function that puts the state in `memory` on the closure, position first, then velocity.

    `passed` is what `project_on_pinocchio` reads: Pinocchio's views, the constants and the joints.
    """
    n = memory.shape[1]
    work = np.zeros((n + 5, n))

    def project() -> None:
        for _ in range(MOST_MOVES):
            evaluate()
            if project_on_pinocchio(POSITION, memory, work, *passed) <= CLOSED:
                break
        project_on_pinocchio(VELOCITY, memory, work, *passed)

    return project


def _checked_law(law: Law, robot: Robot, q: Array, v: Array) -> Callable[[float, Array], str]:
    """Wrap a user's law: give it read-only copies, check what it returns, and write that into the torque."""

    def evaluate(t: float, torque: Array) -> str:
        q_, v_ = q.copy(), v.copy()
        q_.setflags(write=False)
        v_.setflags(write=False)
        answer = law(t, q_, v_, robot.terms(q, v))
        try:
            given = np.asarray(answer)
            given = given.astype(np.float64, casting="same_kind" if given.dtype.kind in "iufc" else "unsafe")
        except (TypeError, ValueError):
            raise ScenarioError(
                f"the law returned {str(answer)[:60]!r} at t = {t:g} s: must be {robot.n} numbers, one torque a joint"
            ) from None
        if given.shape != torque.shape:
            raise ScenarioError(
                f"the law returned Q of shape {given.shape} at t = {t:g} s: must be ({robot.n},), one torque a joint"
            )
        if not np.all(np.isfinite(given)):
            return f"the law returned Q = {given.tolist()}, which is not finite"
        torque[:] = given
        return ""

    return evaluate


def _when(t: float) -> str:
    return f"stopped at t = {t:.6g} s"


def _failure(
    status: int, t: float, robot: Robot, problem: Problem, law: Law | None, q: Array, v: Array
) -> SimulationError:
    if status == SINGULAR:
        pose = np.array2string(q, precision=4, separator=", ", suppress_small=True)
        return SingularClosureError(
            f"{_when(t)}: singular pose: at q = {pose} the tip cannot move along the surface normal "
            f"{problem.plane.normal.round(4).tolist()}, so Eq. 24 does not determine the contact force; "
            "start from, or steer through, another posture",
            t,
        )
    if status == NOT_POSITIVE_DEFINITE:
        return SingularClosureError(
            f"{_when(t)}: the mass matrix of {robot.model.name} is not positive definite; "
            "some joint moves no inertia (look at the masses and tensors of the last links)",
            t,
        )
    fast = int(np.argmax(np.abs(v))) if np.all(np.isfinite(v)) else 0
    name = robot.joint_names[fast]
    if law is not None:
        cure = "look at the signs and sizes in the law, and at time.step"
    else:
        cure = "look at the signs and sizes of law.kp and law.kd, and at time.step"
        # A damper on a joint is itself stepped, and shakes loose where K_d h exceeds twice the inertia it acts on.
        damping = problem.gains[1] * problem.h / np.diag(robot.terms(problem.q, problem.v).mass_matrix)
        if damping[fast] > 2.0:
            cure = (
                f"law.kd[{fast}] times time.step is {damping[fast]:.3g} times that joint's inertia, where 2 is the "
                "most that a step can damp: lower law.kd for it"
            )
    return DivergenceError(
        f"{_when(t)}: the motion diverges: joint {name} is beyond {SPEED_LIMIT:g} rad/s or not a number; {cure}", t
    )


def _as_run(problem: Problem, rows: Array, law: Law | None, failure: SimulationError | None, seconds: float) -> Run:
    n, count = problem.robot.n, rows.shape[0]
    layout = Row.of(n, 1)

    def block(begin: int, width: int) -> Array:
        return np.ascontiguousarray(rows[:, begin : begin + width])

    per_step = (problem.path.shape[0] - 1) // problem.steps
    reference_rows = problem.path[::per_step][:count]
    columns: dict[str, NDArray[Any]] = {
        "time": problem.h * np.arange(count),
        "reference_position": reference_rows[:, 0].copy(),
        "reference_velocity": reference_rows[:, 1].copy(),
        "position": block(layout.position, 3),
        "velocity": block(layout.velocity, 3),
        "mode": np.full(count, PRESSED, dtype=np.int8),
    }
    for name in ("q", "v", "acceleration", "torque"):
        columns[name] = block(getattr(layout, name), n)
    for name in ("contact_force", "stabiliser_force", "closure_error", "closure_rate"):
        columns[name] = block(getattr(layout, name), 1)[:, 0]
    for k, name in enumerate(SCALARS):
        columns[name] = block(layout.scalars + k, 1)[:, 0]
    columns["potential_energy"] = problem.robot.potential_energy(columns["q"])
    return Run(
        scenario=problem.scenario,
        model=problem.robot.model,
        columns=columns,
        law="scenario" if law is None else _law_name(law),
        versions=package_versions(),
        stopped=str(failure) if failure else None,
        wall_seconds=seconds,
    )


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
