"""Derivatives of a whole run: dual numbers, differences of runs in a batch, and Pinocchio's derivatives at one instant.

A step of a contestant is one of the plain run, so that a ratio says how many plain runs value and derivatives cost.
"""

import time as clock
from dataclasses import replace

import numpy as np
import pinocchio as pin

import closedloop as cl
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.worker import Worker
from closedloop.simulation.engines.dual_loop import DIRECTIONS, DualRun, Prepared, prepared
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final, our_engine

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
