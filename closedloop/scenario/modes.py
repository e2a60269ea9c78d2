"""Whether the step resolves the fast swings of elastic joints and of a soft surface: accuracy, not stability alone.

A step that is stable may damp a swing that the arm does not damp, or feed one that it does: Runge-Kutta's fourth order
scheme takes away 23 % of the rate at hω = 2.3. So what a step makes of a swing, its eigenvalue μ, is compared with
e^hλ.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.transmission import transmission_constants
from closedloop.mechanics.closure.baumgarte import linear_step
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.gains import closed_mobility
from closedloop.scenario.scenario import Scenario

Array = NDArray[np.float64]

# A swing whose rate of decay or frequency is off by a tenth of |λ| is another swing: its damping ratio is off by 0.1.
WRONG_BY = 0.1


def wrong_by(integrator: str, h: float, stiffness: Array, damping: Array) -> tuple[float, float]:
    """Return |ln μ − hλ|/|hλ| of the swing ẍ = −stiffness x − damping ẋ that a step h, s, gets most wrong, and its |λ|.

    Only swings count, not what dies out without one.
    """
    m = stiffness.shape[0]
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-h * h * stiffness, -h * damping]])
    rates = np.linalg.eigvals(A)
    made = np.linalg.eigvals(linear_step(INTEGRATORS[integrator], A))
    worst, rate = 0.0, 0.0
    for z in rates[rates.imag > 1e-3 * np.abs(rates)]:
        with np.errstate(divide="ignore"):
            off = float(np.min(np.abs(np.log(made.astype(complex)) - z)) / np.abs(z))
        if off > worst:
            worst, rate = off, float(np.abs(z)) / h
    return worst, rate


def unresolved(scenario: Scenario, robot: Robot, q: Array, normal: Array, depth: float) -> list[str]:
    """Return a line for each swing that the step does not resolve, with a step that would.

    Parameters
    ----------
    scenario, robot
        What is run, and its robot with its tip.
    q : (n,) array
        A posture.
    normal : (3,) array
        The unit normal of the surface there, base axes.
    depth : float
        How deep the tip is in the surface there, m.
    """
    name, h = scenario.time.integrator, scenario.time.step
    soft, elastic = scenario.compliance.kind != "none", scenario.transmission.elastic
    if name not in INTEGRATORS or not (soft or elastic):
        return []
    swings: list[tuple[str, Array, Array]] = []
    try:
        terms = robot.terms(np.array(q), np.zeros(robot.n))
        inverse = np.linalg.inv(terms.mass_matrix)
    except np.linalg.LinAlgError:  # some joint moves no inertia: the run says so
        return []
    mobility = closed_mobility(robot, q, inverse)
    if elastic:
        k, d, inertia = transmission_constants(scenario.transmission, robot.model)
        between = mobility + np.diag(np.divide(1.0, inertia, out=np.zeros(robot.n), where=inertia > 0.0))
        swings.append(("transmission.stiffness", between * k, between * d))
    if soft:
        A = normal @ terms.jacobian
        k, d = scenario.compliance.tangent(max(0.0, depth))
        along = np.array([[float(A @ mobility @ A)]])
        swings.append(("compliance", along * k, along * d))
    lines = []
    for key, stiffness, damping in swings:
        if not (np.all(np.isfinite(stiffness)) and np.any(stiffness)):
            continue
        off, rate = wrong_by(name, h, stiffness, damping)
        if off > WRONG_BY:
            lines.append(
                f"{key}: {name} with time.step = {h:g} s gets a swing of {rate:.3g} rad/s wrong by {100 * off:.2g} %; "
                f"it is within {100 * WRONG_BY:g} % with a step of {_resolving(name, h, stiffness, damping):.2g} s"
            )
    return lines


def _resolving(name: str, h: float, stiffness: Array, damping: Array) -> float:
    """Return the first of h/2, h/4 ... that resolves the swing."""
    for _ in range(40):
        h *= 0.5
        if wrong_by(name, h, stiffness, damping)[0] <= WRONG_BY:
            break
    return h
