"""One step of a linear system by each integrator, its inputs held over the step.

    ẋ = A x + B u,  u constant over h:    x⁺ = Φ x + Γ u

A scheme of Runge and Kutta gives polynomials in h A, the semi-implicit one lets positions advance with the new
velocities, and an integrator that chooses its own steps the exponential, which is exact.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from closedloop.base.arrays import Array
from closedloop.mechanics.integrators import AdaptiveIntegrator, Scheme


def step_of(scheme: type[Scheme], A: Array, B: Array, h: float, leads: Array, exact: Array) -> tuple[Array, Array]:
    """Return Φ (k, k) and Γ (k, m) of a step h, s.

    Parameters
    ----------
    scheme : type of Scheme
        The integrator.
    A, B : (k, k), (k, m) arrays
        The system.
    leads : (k,) array of int
        For the semi-implicit scheme, the state whose new value is in the rate of this one; −1: none.
    exact : (k,) array of bool
        For the semi-implicit scheme, the states that advance exactly, with what they depend on held over the step.
    """
    k, m = B.shape
    both = np.zeros((k + m, k + m))
    both[:k, :k], both[:k, k:] = A, B
    if issubclass(scheme, AdaptiveIntegrator):
        step = expm(h * both)[:k]
        return step[:, :k], step[:, k:]
    eye = np.eye(k + m)
    if scheme.semi_implicit:
        step = eye + h * both
        if np.any(exact):
            alone = both.copy()
            alone[~np.append(exact, np.zeros(m, dtype=bool))] = 0.0
            rows = np.flatnonzero(exact)
            step[rows] = expm(h * alone)[rows]
        for place in np.flatnonzero(leads >= 0):
            step[place] = eye[place] + h * (both[place] - eye[leads[place]] + step[leads[place]])
        return step[:k, :k], step[:k, k:]
    slopes: list[Array] = []
    for row in scheme.a:
        state = eye + h * sum((weight * slope for weight, slope in zip(row, slopes, strict=True)), np.zeros_like(both))
        slopes.append(both @ state)
    step = eye + h * sum((weight * slope for weight, slope in zip(scheme.b, slopes, strict=True)), np.zeros_like(both))
    return step[:k, :k], step[:k, k:]
