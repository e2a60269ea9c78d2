"""What is done again and again: short runs from other starts or with other values, episodes of an environment, batches
and derivatives of runs.

A contestant's laps differ from each other, so that nothing that is kept of a lap before helps, but for their last run:
that comes to what a run comes to that finds nothing made.

A batch is `closedloop.simulate_batch`, whole, with all that it does beside stepping. Beside it two threads that do
nothing but arithmetic, for what the machine gives to two threads at that moment: on a shared one it may be hardly more
than to one, and no batch can be better.

Derivatives of a whole run: dual numbers, differences of runs in a batch, and Pinocchio's derivatives at one instant. A
step of a contestant is one of the plain run, so that a ratio says how many plain runs value and derivatives cost.

Beside these, a fresh interpreter, from its start to its first result.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
import time as clock
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

import closedloop
import closedloop as cl
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.simd8 import WIDE
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.worker import Worker
from closedloop.simulation.engines.dual_loop import DIRECTIONS, DualRun, Prepared, prepared
from closedloop.simulation.engines.lanes import LaneRuns, kind_of
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final, our_engine

# Runs of a lap, their steps, and how far away the starts are, rad.
RUNS, SHORT, NEAR = 20, 50, 1e-3


def from_elsewhere(arm: str, problem: Problem) -> list[Contestant]:
    """Return short runs of a prepared problem from other starts, from call to Run, and their steps alone.

    The law holds the arm where it starts, so that a start has no path of its own to be followed.
    """
    last, random = problem.q + NEAR, np.random.default_rng(0)

    def other(short: Problem, k: int) -> Run:
        q = last if k == RUNS - 1 else problem.q + NEAR * random.uniform(-1.0, 1.0, problem.robot.n)
        return short.run(q=q, engine=COMPILED)

    return _in_turn("elsewhere", arm, problem, other, {"start.q": last}, f"{SHORT} steps from other starts")


def with_other_values(arm: str, problem: Problem) -> list[Contestant]:
    """Return short runs of a prepared problem with other forces and gains, and their steps alone."""
    random = np.random.default_rng(0)

    def other(short: Problem, k: int) -> Run:
        force = 12.0 if k == RUNS - 1 else float(random.uniform(8.0, 12.0))
        return short.run({"law.force": force}, engine=COMPILED)

    return _in_turn("values", arm, problem, other, {"law.force": 12.0}, f"{SHORT} steps with other forces")


def _in_turn(
    name: str, arm: str, problem: Problem, other: Callable[[Problem, int], Run], last: dict[str, Any], what: str
) -> list[Contestant]:
    """Return runs `other` of the shortened problem, the k-th of a lap, of which the last has the values `last`."""
    changes = {"time.duration": SHORT * problem.h, "reference.kind": "hold"}
    short = cl.prepare(problem.scenario.replace(changes), problem.robot.model)
    alone = final(cl.prepare(short.scenario.replace(last)))

    def call() -> tuple[float, Array]:
        runs = [other(short, k) for k in range(RUNS)]
        return sum(run.wall_seconds for run in runs), runs[-1].q[-1]

    def whole() -> tuple[float | None, Array | None]:
        return None, call()[1]

    both = Contestant(name, arm, problem.robot.n, RUNS * SHORT, whole, alone, 0.0, f"{what}, whole")
    return [both, replace(both, name=f"{name}_steps", lap=call, what=f"{what}, the steps")]


def episodes(arm: str) -> list[Contestant]:
    """Return resets of the environment that presses, and as many of its steps, if Gymnasium is installed.

    A step is a control period. Both come to what a new environment observes with the same seed.
    """
    if find_spec("gymnasium") is None:
        return []
    from closedloop.gym.env import ContactEnv

    env, seed = ContactEnv("press"), 7

    def reset() -> tuple[float | None, Array | None]:
        for k in range(RUNS):
            seen, _ = env.reset(seed=seed if k == RUNS - 1 else None)
        return None, np.array(seen)

    def steps(on: ContactEnv) -> Array:
        action = np.zeros(on.action_space.shape or (), dtype=np.float32)
        for _ in range(RUNS):
            seen = on.step(action)[0]
        return np.array(seen)

    def step() -> tuple[float | None, Array | None]:
        env.reset(seed=seed)
        began = clock.perf_counter()
        end = steps(env)
        return clock.perf_counter() - began, end

    fresh = ContactEnv("press")
    begun = np.array(fresh.reset(seed=seed)[0])
    n, went = fresh.core.ensemble.problem(0).robot.n, steps(fresh)
    return [
        Contestant("reset", arm, n, RUNS, reset, begun, 0.0, "Press-v0, a reset"),
        Contestant("gym_step", arm, n, RUNS, step, went, 0.0, "Press-v0, a step of ten"),
    ]


SPINS, SPINNERS = 400_000, 4
# Runs beside those on a smooth plane, by the names of their contestants.
IN_LANES = {
    "rough": "wam_slide_friction", "landing": "wam_touchdown", "round": "wam_sphere", "soft": "soft_table",
}  # fmt: skip


def compiled_batch(arm: str, problem: Problem, runs: int, threads: int) -> Contestant:
    """Return a batch of slides in the compiled engine on some threads, each with a force of its own.

    What it must come to are the least contact forces, N, of the runs made one by one.
    """
    forces = [10.0 + 0.1 * i for i in range(runs)]

    def alone(force: float) -> float:
        scenario = problem.scenario.replace({"law.force": force})
        return float(cl.simulate(scenario, engine="compiled").contact_force.min())

    def lap() -> tuple[float | None, Array | None]:
        table = cl.simulate_batch(problem.scenario, {"law.force": forces}, workers=threads)
        return None, np.array(table["min_contact_force"])

    wanted = np.array([alone(force) for force in forces])
    what = f"compiled batch, {threads} thread{'s' * (threads > 1)}"
    return Contestant(f"batch_{threads}", arm, problem.robot.n, problem.steps * runs, lap, wanted, 1e-12, what)


def in_lanes(arm: str, problem: Problem, name: str = "lanes", of: str = "") -> Contestant:
    """Return the loop in which a batch's runs go, without what a batch does beside: a step is one of one run."""
    kind, n = kind_of(problem), problem.robot.n
    assert kind is not None
    lane_runs = LaneRuns(problem, kind, keep=False)

    def lap() -> tuple[float | None, Array | None]:
        for lane in range(WIDE):
            lane_runs.put(lane, problem)
        began = clock.perf_counter()
        ran = lane_runs.run(WIDE)
        seconds = clock.perf_counter() - began
        rows = lane_runs.rows(WIDE - 1)
        return seconds, rows[problem.steps % len(rows), :n].copy() if ran else None

    what = f"compiled, eight runs in SIMD lanes{of}"
    return Contestant(name, arm, n, WIDE * problem.steps, lap, final(problem), 1e-11, what)


def with_events(arm: str) -> list[Contestant]:
    """Return runs in which something happens or the surface is asked, each in lanes beside the same run alone."""
    racing = []
    for name, scenario in IN_LANES.items():
        problem, of = cl.prepare(cl.load_scenario(scenario)), f", {scenario}"
        alone = replace(our_engine(arm, problem, COMPILED), name=name, what=f"compiled{of}")
        racing += [alone, in_lanes(arm, problem, f"{name}_lanes", of)]
    return racing


def arithmetic(threads: int) -> Contestant:
    """Return threads that add sines and ask nothing of memory: what the machine has to give. A step is one sine."""
    pool = ThreadPoolExecutor(threads)

    def lap() -> tuple[float | None, Array | None]:
        list(pool.map(_spin, [SPINS] * SPINNERS))
        return None, None

    what = f"arithmetic, {threads} thread{'s' * (threads > 1)}"
    return Contestant(f"arithmetic_{threads}", "machine", 1, SPINNERS * SPINS, lap, what=what)


@entry_kernel
def _spin(count: int) -> float:
    total = 0.0
    for i in range(count):
        total += np.sin(i)
    return total


# A run with friction, in which the tip sticks and slips.
RUBBING = "wam_stick_slip"
# By this share of itself each number is changed for a difference.
SHARE = 1e-3


def _start(problem: Problem) -> tuple[Prepared, list[list[Array | None]]]:
    """Return a prepared run, and the force, the normal's stabiliser and the gains as seven directions."""
    start = prepared(problem)
    parts: list[list[Array | None]] = []
    for i in range(DIRECTIONS):
        one: list[Array | None] = [None] * len(start.floats)
        for k, array in enumerate(start.floats):
            if array is start.loop.constants.memory:
                one[k] = np.zeros_like(array)
                law = start.loop.constants.place("law", *start.loop.constants.sizes)
                one[k][law.start + i] = 1.0  # type: ignore[index,union-attr]
        parts.append(one)
    return start, parts


def by_duals(arm: str, problem: Problem, name: str = "duals", what: str = "") -> Contestant:
    """Return the loop with a value and seven derivatives."""
    start, parts = _start(problem)
    run, n = DualRun(start, parts), problem.robot.n

    def lap() -> tuple[float | None, Array | None]:
        run.begin(parts)
        began = clock.perf_counter()
        ran = run.run()
        seconds = clock.perf_counter() - began
        return seconds, run.rows[-1, :n, 0].copy() if ran else None

    what = what or "compiled, value and seven derivatives"
    return Contestant(name, arm, n, problem.steps, lap, final(problem), 1e-11, what)


def by_differences(arm: str, problem: Problem) -> Contestant:
    """Return fourteen runs of a batch, two for each of seven central differences, on one thread."""
    scenario = problem.scenario
    kp, kd = (np.array(each) for each in problem.gains)
    changed: list[Scenario] = []
    for i in range(DIRECTIONS):
        for sign in (-1.0, 1.0):
            gains = np.concatenate([kp, kd])
            gains[i] *= 1.0 + sign * SHARE
            law = scenario.law.model_copy(update={"kp": tuple(gains[: kp.size]), "kd": tuple(gains[kp.size :])})
            changed.append(scenario.model_copy(update={"law": law}))
    worker = Worker(runs=len(changed))

    def lap() -> tuple[float | None, Array | None]:
        for begin in range(0, len(changed), 8):
            worker.run_all(changed[begin : begin + 8])
        return None, None

    what = "central differences, 14 runs of a batch"
    return Contestant("differences", arm, problem.robot.n, problem.steps, lap, what=what)


def at_one_instant(arm: str, problem: Problem) -> Contestant:
    """Return Pinocchio's derivatives of q̈ by q, q̇ and Q, called from Python: of an arm without contact."""
    model = problem.robot.model.pinocchio_model()
    data, n = model.createData(), problem.robot.n
    q, v, torque = pin.neutral(model), np.zeros(n), np.zeros(n)

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(problem.steps):
            pin.computeABADerivatives(model, data, q, v, torque)
        return None, None

    return Contestant("aba_derivatives", arm, n, problem.steps, lap, what="Pinocchio, derivatives at one instant")


def racing(arm: str, problem: Problem) -> list[Contestant]:
    """Return all of them, and a run with friction beside its own derivatives."""
    rubbing = prepare(cl.load_scenario(RUBBING))
    plain = replace(our_engine(arm, rubbing, "compiled"), name="rubbing", what=f"compiled, {RUBBING}")
    duals = by_duals(arm, rubbing, "rubbing_duals", f"value and seven derivatives, {RUBBING}")
    return [by_duals(arm, problem), by_differences(arm, problem), at_one_instant(arm, problem), plain, duals]


PROGRAM = "import closedloop as cl; cl.simulate(cl.load_scenario('wam_slide'), engine='{engine}')"
AFTERWARDS = "from closedloop.jit.background import wait_until_done; wait_until_done()"


def first_result(engine: str, repeats: int) -> float:
    """Return the median seconds of a process that simulates `wam_slide` once, everything compiled before."""
    _timed(engine, {})
    return statistics.median(_timed(engine, {}) for _ in range(repeats))


def first_result_ever(engine: str) -> float:
    """Return the seconds of the first such process of an installation, with nothing compiled."""
    with tempfile.TemporaryDirectory() as folder:
        settings = {"NUMBA_CACHE_DIR": folder}
        seconds = _timed(engine, settings)
        _timed(engine, settings, AFTERWARDS)  # no process in the background disturbs what is measured next
        return seconds


def _timed(engine: str, settings: dict[str, str], program: str = PROGRAM) -> float:
    root = str(Path(closedloop.__file__).parent.parent)
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", program.format(engine=engine)],
        check=True,
        env={**os.environ, "PYTHONPATH": path, **settings},
    )
    return time.perf_counter() - began
