"""Many runs at once: `closedloop.simulate_batch`, whole, with all that it does beside stepping.

Beside it two threads that do nothing but arithmetic, for what the machine gives to two threads at that moment: on a
shared one it may be hardly more than to one, and no batch can be better.
"""

import time as clock
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

import closedloop as cl
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.simd8 import WIDE
from closedloop.simulation.engines.compiled import compiled_tree
from closedloop.simulation.engines.lanes import LaneRuns, kind_of
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final, our_engine

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
    kind, tree, n = kind_of(problem), compiled_tree(problem), problem.robot.n
    assert kind is not None
    lane_runs = LaneRuns(problem, kind, keep=False)

    def lap() -> tuple[float | None, Array | None]:
        for lane in range(WIDE):
            lane_runs.put(lane, problem)
        began = clock.perf_counter()
        ran = lane_runs.run(tree, WIDE)
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
