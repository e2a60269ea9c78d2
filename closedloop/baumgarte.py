"""Baumgarte's stabiliser: its gains, and the step beyond which it shakes the closure apart (Eq. 22).

ë + s_v ė + s_p e = 0 is a damped oscillator. With damping ratio ζ and time constant T its gains are
s_v = 2ζ/T and s_p = 1/T². The paper's s_v = 1414 1/s and s_p = 10⁶ 1/s² are ζ = 0.707 and T = 1 ms.

An integrator of step h turns that oscillator into a linear map of (e, hė), stable while the map's spectral
radius is below one. The map depends on ζ and h/T alone, so the limit is a bound on h/T.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from closedloop.integrate import INTEGRATORS

# An undamped mode has radius one, and a hundred roundings of 1e-16 in computing it.
NEUTRAL = 1.0 + 1e-13

__all__ = ["amplification", "baumgarte_gains", "largest_stable_ratio", "recommended_ratio", "spectral_radius"]


def baumgarte_gains(damping_ratio: float, time_constant: float) -> tuple[float, float]:
    """Return (s_v, s_p) = (2ζ/T, 1/T²) in 1/s and 1/s² for damping ratio ζ and time constant T, s."""
    return 2.0 * damping_ratio / time_constant, 1.0 / time_constant / time_constant


def amplification(integrator: str, damping_ratio: float, ratio: float) -> NDArray[np.float64]:
    """Return the (2, 2) map of (e, hė) over one step of `integrator`, for ratio = h/T.

    Parameters
    ----------
    integrator : str
        A name in `closedloop.integrate.INTEGRATORS`.
    damping_ratio, ratio : float
        ζ and h/T, dimensionless.
    """
    scheme = INTEGRATORS[integrator]
    # (e, hė)' = M (e, hė)/h with the stabilised closure ë = −s_v ė − s_p e
    M = np.array([[0.0, 1.0], [-(ratio**2), -2.0 * damping_ratio * ratio]])
    if scheme.semi_implicit:
        rate_row = np.array([0.0, 1.0]) + M[1]
        return np.array([np.array([1.0, 0.0]) + rate_row, rate_row])
    stages: list[NDArray[np.float64]] = []
    for row in scheme.a:
        stages.append(M @ (np.eye(2) + sum((a * k for a, k in zip(row, stages, strict=False)), np.zeros((2, 2)))))
    return np.eye(2) + sum((b * k for b, k in zip(scheme.b, stages, strict=True)), np.zeros((2, 2)))


def spectral_radius(integrator: str, damping_ratio: float, ratio: float) -> float:
    """Return how much one step can at most multiply the closure error by, in the long run."""
    return float(np.max(np.abs(np.linalg.eigvals(amplification(integrator, damping_ratio, ratio)))))


@lru_cache(maxsize=256)
def largest_stable_ratio(integrator: str, damping_ratio: float) -> float:
    """Return the largest h/T for which the closure error does not grow; 0 if it grows at any (ζ = 0, explicit Euler).

    Found by walking up from small ratios and bisecting the first crossing of spectral radius one.
    For ζ = 1/√2: 1.0353 semi-implicit Euler, 1.4142 explicit Euler, 2.7044 RK4.
    """
    # The faster of two overdamped modes has rate 2ζ/T, so limits fall with 1/ζ.
    ratios = np.geomspace(1e-5, 1e3, 801) / max(1.0, damping_ratio)
    low = 0.0
    for ratio in ratios.tolist():
        if spectral_radius(integrator, damping_ratio, ratio) > NEUTRAL:
            high = ratio
            break
        low = ratio
    else:
        return low
    if low == 0.0:
        return 0.0
    while high - low > 1e-12 * high:
        middle = math.sqrt(low * high)
        if spectral_radius(integrator, damping_ratio, middle) > NEUTRAL:
            high = middle
        else:
            low = middle
    return low


@lru_cache(maxsize=256)
def recommended_ratio(integrator: str, damping_ratio: float) -> float:
    """Return the h/T at which the closure error dies out fastest, of least spectral radius; 0 if none is stable.

    This is what ``stabiliser.time_constant = "auto"`` takes. A larger T forgets more slowly; a smaller one comes near
    the limit of stability, amplifies the rounding of e by s_p = 1/T², and rings. For ζ = 1/√2 the map of semi-implicit
    Euler has there two real modes that coincide.
    """
    limit = largest_stable_ratio(integrator, damping_ratio)
    if limit == 0.0:
        return 0.0
    low, high, best = 0.0, limit, 0.0
    for _ in range(6):  # each pass looks closer around the best of the last
        ratios = np.linspace(low, high, 65)[1:]
        best = float(min(ratios, key=lambda x: spectral_radius(integrator, damping_ratio, float(x))))
        width = (high - low) / 32
        low, high = max(0.0, best - width), min(limit, best + width)
    return best
