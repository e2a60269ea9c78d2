"""From a scenario to a run: prepare the problem, then step it.

`prepare` turns a scenario into numbers and refuses what cannot be simulated; `simulate` steps them. Each stage of
each step asks Pinocchio for the terms of the state, and `closedloop.step` for everything else.
"""

from __future__ import annotations

import math
import sys
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop import reference
from closedloop.baumgarte import baumgarte_gains, largest_stable_ratio
from closedloop.compiled import forget_old_caches, needs_compiling
from closedloop.control import Law
from closedloop.errors import DivergenceError, ScenarioError, SimulationError, SingularClosureError
from closedloop.integrate import INTEGRATORS, Integrator
from closedloop.record import PRESSED, Run
from closedloop.robot import Robot
from closedloop.scenario import HoldSection, LineSection, NoStabiliserSection, Scenario
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
from closedloop.surface import Plane
from robot_models import RobotModel

Array = NDArray[np.float64]

# A run is held in memory; this many rows of a 7-joint arm are about 4 GB.
MOST_ROWS = 10_000_000
# Steps between two calls of the progress function.
CHUNK = 400


@dataclass(frozen=True)
class Problem:
    """A scenario turned into numbers: everything that the loop needs, to be looked at before it runs.

    Attributes
    ----------
    robot, plane, integrator
        The arm with its tip, the surface, the scheme.
    q, v : (n,) arrays
        State at t = 0.
    steps, h : int, float
        Number of steps and the step, s.
    stabiliser : (2,) array
        s_v, 1/s, and s_p, 1/s².
    settings, gains : (2,), (2, n) arrays
        See `closedloop.control.paper_law`.
    path : (steps · nodes + 1, 2, n) array
        q_des and q̇_des at every instant at which a stage is evaluated.
    nodes : tuple of int
        For each stage, how many rows of `path` after its step's first it is evaluated.
    hold : int
        Steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    """

    scenario: Scenario
    robot: Robot
    plane: Plane
    integrator: Integrator
    q: Array
    v: Array
    steps: int
    h: float
    stabiliser: Array
    settings: Array
    gains: Array
    path: Array
    nodes: tuple[int, ...]
    hold: int


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
    if needs_compiling(step_on_pinocchio):
        print("compiling the step (once for this installation, about 5 s) ...", file=sys.stderr, flush=True)
        compiled_now = True
    else:
        compiled_now = False
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


def prepare(scenario: Scenario, model: RobotModel | None = None) -> Problem:
    """Turn a scenario into the numbers of a `Problem`.

    Raises
    ------
    ScenarioError, ModelError
        If something in it cannot be simulated: a wrong length, an unreachable path, a step that makes the
        stabiliser unstable, a tip that the robot does not have ...
    """
    section = scenario.robot
    if model is None:
        options: dict[str, Any] = {} if section.lock is None else {"lock": section.lock}
        model = robot_models.load(section.model, drive_inertia=section.drive_inertia, **options)
    robot = Robot(model, section.tip)
    n = robot.n
    q = model.home.copy() if scenario.start.q is None else _per_joint("start.q", scenario.start.q, model)
    v = np.zeros(n) if scenario.start.v is None else _per_joint("start.v", scenario.start.v, model)
    for j, (low, high) in enumerate(zip(model.position_lower, model.position_upper, strict=True)):
        if not low <= q[j] <= high:
            raise ScenarioError(
                f"start.q[{j}] = {q[j]:g}: joint {model.joint_names[j]} of {model.name} "
                f"moves within [{low:g}, {high:g}]"
            )

    surface = scenario.surface
    if surface.offset == "start":
        plane = Plane.through(robot.position(q), surface.normal)
    else:
        plane = Plane.of(surface.normal, float(surface.offset))

    integrator = INTEGRATORS[scenario.time.integrator]
    steps = _whole(scenario.time.duration, scenario.time.step, "time.duration")
    if steps > MOST_ROWS:
        raise ScenarioError(
            f"time.step = {scenario.time.step:g}: {scenario.time.duration:g} s would be {steps} rows, over the "
            f"{MOST_ROWS} that a run may have; use a larger step or a shorter duration"
        )
    h = scenario.time.step
    period = scenario.law.sample_period
    hold = _whole(period, h, "law.sample_period") if period else 0

    nodes_per_step = max(1, round(1 / min((x for x in integrator.nodes if x), default=1.0)))
    instants = (h / nodes_per_step) * np.arange(steps * nodes_per_step + 1, dtype=np.float64)
    q_des, v_des = _joint_path(scenario, robot, plane, q).sample(instants)
    path = np.stack([q_des, v_des], axis=1)

    law = scenario.law
    start = law.pd_start
    if start is None:
        start = scenario.reference.start if isinstance(scenario.reference, LineSection) else 0.0
    return Problem(
        scenario=scenario,
        robot=robot,
        plane=plane,
        integrator=integrator,
        q=q,
        v=v,
        steps=steps,
        h=h,
        stabiliser=np.array(_stabiliser_gains(scenario)),
        settings=np.array([law.force, start - 1e-9 * h]),  # i·h and 0.5 may differ by rounding
        gains=np.array([_per_joint("law.kp", law.kp, model), _per_joint("law.kd", law.kd, model)]),
        path=path,
        nodes=tuple(round(x * nodes_per_step) for x in integrator.nodes),
        hold=hold,
    )


def _joint_path(scenario: Scenario, robot: Robot, plane: Plane, q: Array) -> reference.JointPath:
    section = scenario.reference
    if isinstance(section, HoldSection):
        return reference.hold(q)
    direction = np.array(section.direction)
    length = float(np.linalg.norm(direction))
    if not (length > 0 and np.isfinite(length)):
        raise ScenarioError("reference.direction = [0, 0, 0]: has no direction; give a vector along the surface")
    direction = direction / length
    out = float(plane.normal @ direction)
    if abs(out) > 1e-9:
        along = direction - out * plane.normal
        size = float(np.linalg.norm(along))
        hint = f"; the nearest direction along it is {(along / size).round(6).tolist()}" if size > 1e-9 else ""
        raise ScenarioError(f"reference.direction = {list(section.direction)}: must lie in the surface{hint}")
    if not section.stop > section.start:
        raise ScenarioError(
            f"reference.stop = {section.stop:g}: must be later than reference.start = {section.start:g}"
        )
    return reference.follow_line(robot, q, direction, section.speed, section.start, section.stop)


def _stabiliser_gains(scenario: Scenario) -> tuple[float, float]:
    section = scenario.stabiliser
    if isinstance(section, NoStabiliserSection):
        return 0.0, 0.0
    name = scenario.time.integrator
    limit = largest_stable_ratio(name, section.damping_ratio)
    ratio = scenario.time.step / section.time_constant
    if ratio > limit:
        if limit == 0.0:
            raise ScenarioError(
                f"stabiliser.damping_ratio = {section.damping_ratio:g}: Baumgarte is unstable with {name} at any step; "
                "use a positive damping ratio"
            )
        raise ScenarioError(
            f"stabiliser.time_constant = {section.time_constant:g} s with time.step = {scenario.time.step:g} s: "
            f"Baumgarte is unstable with {name} beyond step/time_constant = {limit:.4f} at damping ratio "
            f"{section.damping_ratio:g}; the step may be at most {_rounded(limit * section.time_constant, down=True)} "
            f"s, or the time constant at least {_rounded(scenario.time.step / limit, down=False)} s"
        )
    return baumgarte_gains(section.damping_ratio, section.time_constant)


def _rounded(x: float, down: bool) -> str:
    """Return x to four digits, rounded to the side on which it is still a valid limit."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 3)
    return f"{(math.floor(x / unit) if down else math.ceil(x / unit)) * unit:.4g}"


def _per_joint(key: str, value: float | tuple[float, ...], model: RobotModel) -> Array:
    if isinstance(value, float):
        return np.full(model.n, value)
    if len(value) != model.n:
        raise ScenarioError(
            f"{key} has {len(value)} entries: {model.name} has {model.n} joints, {', '.join(model.joint_names)}"
        )
    return np.array(value)


def _whole(span: float, h: float, key: str) -> int:
    """Return how many steps h the span is, refusing a span that is no whole number of them."""
    count = round(span / h) if np.isfinite(span / h) else 0
    if count < 1 or abs(count * h - span) > 1e-9 * span:
        near = max(1, count) * h
        raise ScenarioError(f"{key} = {span:g} s: must be a whole number of steps of {h:g} s, such as {near:.10g} s")
    return count


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
    plain = law is None and not problem.hold and len(stages) == 1
    evaluate, hold = robot.evaluator(q, v), problem.hold
    kind = LAW_PAPER if law is None else LAW_GIVEN
    user_torque = None if law is None else _checked_law(law, robot, q, v)

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
            failure, rows = _failure(status, i * h, robot, problem, q, v), rows[:i]
            break
        for stage, node in stages if i < steps else stages[:1]:
            at = i * per_step + node
            sampled = not hold or (stage == 0 and i % hold == 0)
            if sampled and user_torque is not None:
                fault = user_torque(at * h / per_step, torque)
                if fault:
                    failure = DivergenceError(f"{_when(i * h)}: {fault}", i * h)
                    break
            evaluate()
            status = step_on_pinocchio(i, at, stage, kind if sampled else LAW_GIVEN, *fixed)
            if status != OK:
                failure = _failure(status, i * h, robot, problem, q, v)
                break
        if failure is not None:
            rows = rows[:i]
            break
    report(len(rows) - 1, steps)
    return rows, failure, clock.perf_counter() - began


def _checked_law(law: Law, robot: Robot, q: Array, v: Array) -> Callable[[float, Array], str]:
    """Wrap a user's law: give it read-only copies, check what it returns, and write that into the torque."""

    def evaluate(t: float, torque: Array) -> str:
        q_, v_ = q.copy(), v.copy()
        q_.setflags(write=False)
        v_.setflags(write=False)
        given = np.asarray(law(t, q_, v_, robot.terms(q, v)), dtype=np.float64)
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


def _failure(status: int, t: float, robot: Robot, problem: Problem, q: Array, v: Array) -> SimulationError:
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
    return DivergenceError(
        f"{_when(t)}: the motion diverges: joint {robot.joint_names[fast]} is beyond {SPEED_LIMIT:g} rad/s or "
        "not a number; look at the signs and sizes of law.kp and law.kd, and at time.step",
        t,
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
