"""What is done again and again: short runs from other starts or with other values, and episodes of an environment.

A contestant's laps differ from each other, so that nothing that is kept of a lap before helps, but for their last run:
that comes to what a run comes to that finds nothing made.
"""

import time as clock
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.record.run import Run
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final

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
