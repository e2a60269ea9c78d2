"""The whole slide in several engines: what a trajectory is, and the two loops that step as the simulator steps."""

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import closedloop
from closedloop import Problem
from closedloop.scenario.scenario import BothSection, ProjectionSection
from closedloop.simulation.simulate import simulate
from validation.oracle import Law, Oracle, simulate_slide
from validation.oracle.engine import Closure
from validation.oracle.spatial import Array

SCENARIO = "wam_slide"

SHORT = {"reference.start": 0.0, "reference.stop": 0.4, "time.duration": 0.3}
"""The first 0.3 s of the motion, for engines that are slow: its beginning, where f dips and recovers, decides; what
comes before and long after is f = 10 N."""


@dataclass(frozen=True)
class Trajectory:
    """A slide as an engine made it; the force of a row belongs to the state of the same row.

    time (N,) [s]; q, v (N, n); contact_force (N,) of the surface on the robot along +n [N]; closure_error (N,) [m];
    step [s]; softness: R of A q̈ + R f = b [1/kg], 0 where the constraint is hard; seconds: what it took
    """

    engine: str
    time: Array
    q: Array
    v: Array
    contact_force: Array
    closure_error: Array
    step: float
    softness: float = 0.0
    seconds: float = 0.0

    @property
    def pressed(self) -> bool:
        """Tell whether the surface pushed at every instant: a constraint that is off shows no force."""
        return bool(np.all(self.contact_force > 0.0))


def problem(overrides: dict[str, Any] | None = None) -> Problem:
    """Return the slide as numbers, with some keys of the scenario set otherwise."""
    return closedloop.prepare(closedloop.load_scenario(SCENARIO, overrides or {}))


def slide_closedloop(of: Problem) -> Trajectory:
    """Run the simulator."""
    began = clock.perf_counter()
    run = simulate(of.scenario, model=of.robot.model)
    seconds = clock.perf_counter() - began
    return Trajectory("closedloop", run.time, run.q, run.v, run.contact_force, run.closure_error, of.h, seconds=seconds)


def slide_oracle(of: Problem) -> Trajectory:
    """Run the loop of the hand-written oracle; it knows semi-implicit Euler only."""
    if not of.integrator.semi_implicit:
        raise ValueError("the oracle's loop steps by semi-implicit Euler only")
    stabiliser = of.scenario.stabiliser
    if isinstance(stabiliser, ProjectionSection | BothSection):
        raise ValueError("the oracle's loop does not project")
    pair = None
    if stabiliser.kind != "none":
        pair = stabiliser.damping_ratio, float(of.stabiliser[1] ** -0.5)
    began = clock.perf_counter()
    run = simulate_slide(
        Oracle.from_model(of.robot.model, of.robot.tip), q=of.q, v=of.v, q_des=of.path[:, 0], v_des=of.path[:, 1],
        step=of.h, law=Law(of.gains[0], of.gains[1], float(of.settings[0]), float(of.settings[1])),
        closure=Closure(of.plane.normal, of.plane.offset, pair),
    )  # fmt: skip
    seconds = clock.perf_counter() - began
    return Trajectory("oracle", run.time, run.q, run.v, run.contact_force, run.closure_error, of.h, seconds=seconds)


def law(of: Problem, row: int, q: Array, v: Array, C: Array, A: Array) -> Array:
    """Return Q of Eq. 33 at row `row` of the reference, from an engine's own C (n,) and A = nᵀJᵣ (n,)."""
    torque = C - A * of.settings[0]
    if row * of.h >= of.settings[1]:
        torque = torque - of.gains[0] * (q - of.path[row, 0]) - of.gains[1] * (v - of.path[row, 1])
    return np.asarray(torque)


def at_zero(runs: Sequence[Trajectory], parameters: Sequence[float]) -> Trajectory:
    """Return the trajectory at parameter 0 of the polynomial through trajectories at different parameters.

    At each instant f, e, q and v are smooth functions of a softness R, and of h² in a scheme of second order: so many
    smooth steps one after the other. k parameters in a fixed ratio leave an error of their k-th power.
    """
    x = np.asarray(parameters, dtype=float)
    others = [np.delete(x, i) for i in range(len(x))]
    weights = [float(np.prod(rest / (rest - x_i))) for x_i, rest in zip(x, others, strict=True)]  # Lagrange's, at 0

    def limit(name: str) -> Array:
        return np.asarray(sum(w * getattr(run, name) for w, run in zip(weights, runs, strict=True)))

    return replace(
        runs[0], q=limit("q"), v=limit("v"), contact_force=limit("contact_force"), closure_error=limit("closure_error"),
        softness=0.0, seconds=sum(run.seconds for run in runs),
    )  # fmt: skip
