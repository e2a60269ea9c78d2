"""One step of a linear system by each integrator, its inputs constant over the step but for its beginning.

    ẋ = A x + B₀ u  at the beginning,  A x + B u  within the step:    x⁺ = Φ x + Γ u

A scheme of Runge and Kutta gives polynomials in h A, and exponentials of what decays by itself, the semi-implicit one
lets positions advance with the new velocities, and an integrator that chooses its own steps the exponential, which is
exact. B₀ is that of the first stage: what a sampled sensor reads changes at a row, between the law's evaluation there
and those within the step. Of schemes of one stage it is the whole step, of the exponential no part.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from closedloop.base.arrays import Array
from closedloop.mechanics.integrators import AdaptiveIntegrator, Scheme


def step_of(
    scheme: type[Scheme], A: Array, B: Array, begin: Array, h: float, leads: Array, exact: Array, decays: Array
) -> tuple[Array, Array]:
    """Return Φ (k, k) and Γ (k, m) of a step h, s.

    Parameters
    ----------
    scheme : type of Scheme
        The integrator.
    A, B, begin : (k, k), (k, m), (k, m) arrays
        The system; `begin` is B₀.
    leads : (k,) array of int
        For the semi-implicit scheme, the state whose new value is in the rate of this one; −1: none.
    exact : (k,) array of bool
        For the semi-implicit scheme, the states that advance exactly, with what they depend on held over the step.
    decays : (k,) array
        For the schemes of Runge and Kutta, the rates a of states that decay by themselves, 1/s; 0 of others.
    """
    k, m = B.shape
    both = np.zeros((k + m, k + m))
    both[:k, :k], both[:k, k:] = A, B
    if issubclass(scheme, AdaptiveIntegrator):
        step = expm(h * both)[:k]
        return step[:, :k], step[:, k:]
    eye, first = np.eye(k + m), both.copy()
    first[:k, k:] = begin
    if scheme.semi_implicit:
        step = eye + h * first
        if np.any(exact):
            alone = first.copy()
            alone[~np.append(exact, np.zeros(m, dtype=bool))] = 0.0
            rows = np.flatnonzero(exact)
            step[rows] = expm(h * alone)[rows]
        for place in np.flatnonzero(leads >= 0):
            step[place] = eye[place] + h * (first[place] - eye[leads[place]] + step[leads[place]])
        return step[:k, :k], step[:k, k:]
    return _stages(scheme, both, first, h, np.append(decays, np.zeros(m)), k)


def _stages(scheme: type[Scheme], within: Array, first: Array, h: float, decays: Array, k: int) -> tuple[Array, Array]:
    """Return Φ and Γ of a scheme of Runge and Kutta, with exponentials of the states that decay.

    About states at rest, g = a z, the E of `closedloop.loop.step.decay` is E δz = e^(−s) δz + (1 − e^(−s))/s p, with
    p = h Σ wᵢ (δżᵢ + a δzᵢ).
    """
    states, slopes = [np.eye(within.shape[0])], list[Array]()
    fast = np.flatnonzero(decays > 0.0)
    a = decays[fast, None]
    for weights, early in zip(scheme.tableau()[1:], scheme.first_tableau()[1:], strict=True):
        slopes.append((within if slopes else first) @ states[-1])
        done = len(slopes)
        new = states[0] + h * np.tensordot(weights[:done], slopes, 1)
        z = states[0][fast]
        driven = [slope[fast] + a * state[fast] for slope, state in zip(slopes, states, strict=True)]
        for part in (early, weights - early):
            s = h * a * np.sum(part)
            z = np.exp(-s) * z + np.where(s == 0.0, 1.0, -np.expm1(-s) / np.where(s == 0.0, 1.0, s)) * (
                h * np.tensordot(part[:done], driven, 1)
            )
        new[fast] = z
        states.append(new)
    return states[-1][:k, :k], states[-1][:k, k:]
