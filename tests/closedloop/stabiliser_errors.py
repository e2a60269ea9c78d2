"""What the stabiliser's choice of T rests on: its error of a sliding tip, and what it makes of rounding."""

import math

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.closure.baumgarte import amplification, spectral_radius
from closedloop.mechanics.integrators import INTEGRATORS, Integrator


def sliding_error(integrator: str | type[Integrator], damping_ratio: float, ratio: float) -> tuple[float, float, float]:
    """Return the steady error of sliding, per unit of the tip's centripetal acceleration along the normal, a = Ȧq̇.

    With a constant a one step of the integrator from e = ė = 0 ends off the closure by its local error, which the
    stabiliser balances. For the Euler schemes e is ∓ζ h T a: below the surface for the semi-implicit one, above it for
    the explicit one (a > 0).

    Parameters
    ----------
    integrator, damping_ratio, ratio
        See `amplification`; stable.

    Returns
    -------
    error, rate, share : float
        e/(h² a), ė/(h a), and (−s_v ė − s_p e)/a: the stabiliser's share of f over that of a.
    """
    scheme = INTEGRATORS.get(integrator, integrator)
    damper, spring = 2.0 * damping_ratio * ratio, ratio * ratio

    def acceleration(t: float, y: float, w: float) -> float:
        # With h = a = 1, what the integrator advances is y = e − t²/2 and w = ė − t.
        return -1.0 - damper * (w + t) - spring * (y + 0.5 * t * t)

    if scheme.semi_implicit:
        y = w = acceleration(0.0, 0.0, 0.0)
    else:
        slopes: list[tuple[float, float]] = []
        for node, row in zip(scheme.nodes, scheme.a, strict=True):
            y, w = (sum(a * slope[i] for a, slope in zip(row, slopes, strict=False)) for i in range(2))
            slopes.append((w, acceleration(node, y, w)))
        y, w = (sum(b * slope[i] for b, slope in zip(scheme.b, slopes, strict=True)) for i in range(2))
    defect = np.array([y + 0.5, w + 1.0])
    error, rate = np.linalg.solve(np.eye(2) - amplification(integrator, damping_ratio, ratio), defect).tolist()
    return error, rate, -damper * rate - spring * error


def rounding_gain(integrator: str | type[Integrator], damping_ratio: float, ratio: float) -> float:
    """Return the standard deviation of the stabiliser's acceleration that rounding of e causes, times h²/δ.

    e = n·r − d has an independent rounding error at every evaluation, of standard deviation δ, m (7e-17 half a metre
    from the base). The standard deviation of the force is then gain · δ / (h² A H⁻¹Aᵀ). Infinite at the limit of
    stability and beyond it.

    Parameters
    ----------
    integrator, damping_ratio, ratio
        See `amplification`.
    """
    if not spectral_radius(integrator, damping_ratio, ratio) < 1.0:
        return math.inf
    scheme = INTEGRATORS.get(integrator, integrator)
    M = np.array([[0.0, 1.0], [-(ratio**2), -2.0 * damping_ratio * ratio]])
    kick = np.array([0.0, -(ratio**2)])
    if scheme.semi_implicit:
        B = np.array([kick[[1, 1]]]).T
    else:
        columns = []
        for noisy in range(scheme.stages):
            slopes: list[Array] = []
            for stage, row in enumerate(scheme.a):
                state = sum((a * k for a, k in zip(row, slopes, strict=False)), np.zeros(2))
                slopes.append(M @ state + kick * (stage == noisy))
            columns.append(sum((b * k for b, k in zip(scheme.b, slopes, strict=True)), np.zeros(2)))
        B = np.array(columns).T
    step = amplification(integrator, damping_ratio, ratio)
    # The covariance of (e, hė) that a step keeps: P = step P stepᵀ + B Bᵀ.
    P = np.linalg.solve(np.eye(4) - np.kron(step, step), (B @ B.T).ravel()).reshape(2, 2)
    return math.sqrt(ratio**4 + float(M[1] @ P @ M[1]))
