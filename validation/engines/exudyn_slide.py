"""Exudyn's own integrator on the slide: a hard constraint in a differential-algebraic system of index 3."""

import time as clock
from importlib import import_module
from typing import Any

import numpy as np

from closedloop import Problem
from validation.engines.exudyn import Solver, add_lock, add_tree, quiet_settings
from validation.engines.trajectories import Trajectory, law
from validation.oracle import read_urdf
from validation.oracle.spatial import Array


def slide_exudyn(of: Problem, *, contact: bool = True) -> Trajectory:
    """Slide with Exudyn's generalized-α scheme, spectral radius 0.9: implicit, second order, in f too.

    The closure holds at the level of positions at every step, n·r = d, and f is minus its multiplier. There is no
    stabiliser, as none is needed: this is the motion that every stabilised scheme tends to as h → 0. The law is
    evaluated inside Newton's iteration, at the end of the step, with C and A of a second Exudyn system that is
    held at the same state: nothing of Pinocchio or of the simulator takes part but the reference q_des(t).

    The reference may not jump inside the run: at a jump an implicit step would use the later value from the step's
    beginning on, an error of first order.

    Index 3 magnifies the rounding of positions by 1/h²: f has a floor of 4e-6 N at 0.25 ms and of 2e-5 N at 0.125 ms.
    """
    tree, tip, n, lock = read_urdf(of.robot.model), of.robot.tip, len(of.q), of.plane.normal[None, :]
    exudyn: Any = import_module("exudyn")
    container, place, now = (
        exudyn.SystemContainer(),
        exudyn.OutputVariableType.Position,
        exudyn.ConfigurationType.Current,
    )
    system = container.AddSystem()
    body, marker = add_tree(system, tree, tip, of.q, of.v)
    if contact:
        add_lock(system, marker, of.plane.normal * of.plane.offset, lock)
    terms = Solver(tree, tip, of.q, of.v, np.zeros(n), lock)

    def torque(_system: Any, t: float, _item: Any, q: Any, v: Any) -> Array:
        state = np.array(q), np.array(v)
        bias, A = _bias_and_row(terms, *state)
        return law(of, round(t / of.h), *state, bias, A)

    system.SetObjectParameter(body, "forceUserFunction", torque)
    system.Assemble()
    rows: dict[int, list[float]] = {}

    def store(its_system: Any, t: float) -> bool:
        data = its_system.systemData
        f = -data.GetAECoordinates()[2] if contact else 0.0
        tip_now = its_system.GetMarkerOutput(marker, place, now)
        e = float(of.plane.normal @ np.array(tip_now)) - of.plane.offset
        rows[round(t / of.h)] = [*data.GetODE2Coordinates(), *data.GetODE2Coordinates_t(), f, e]
        return True

    settings = quiet_settings()
    time = settings.timeIntegration
    time.numberOfSteps, time.endTime, time.adaptiveStep = of.steps, of.steps * of.h, False
    time.generalizedAlpha.spectralRadius = 0.9
    time.newton.relativeTolerance, time.newton.absoluteTolerance = 1e-10, 1e-12
    system.SetPostStepUserFunction(store)
    solver = exudyn.MainSolverImplicitSecondOrder()
    began = clock.perf_counter()
    if not (solver.InitializeSolver(system, settings) and store(system, 0.0) and solver.SolveSteps(system, settings)):
        raise RuntimeError("Exudyn's Newton iteration did not converge")
    solver.FinalizeSolver(system, settings)
    seconds = clock.perf_counter() - began
    table = np.array([rows[k] for k in range(of.steps + 1)])
    return Trajectory(
        "exudyn", np.arange(of.steps + 1) * of.h, table[:, :n], table[:, n : 2 * n], table[:, 2 * n],
        table[:, 2 * n + 1], of.h, seconds=seconds,
    )  # fmt: skip


def _bias_and_row(terms: Solver, q: Array, v: Array) -> tuple[Array, Array]:
    """Return C (n,) and A = nᵀJᵣ (n,) at a state, from a system of Exudyn's that bears no torque."""
    data = terms.system.systemData
    data.SetODE2Coordinates(q)
    data.SetODE2Coordinates_t(v)
    terms.solver.ComputeODE2RHS(terms.system)
    return -np.array(terms.solver.GetSystemResidual())[: len(q)], terms.jacobian()[0]
