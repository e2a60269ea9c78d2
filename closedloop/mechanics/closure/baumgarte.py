"""Baumgarte's stabiliser: its gains, the largest stable step (Eq. 22), and the choice of the time constant.

ë + s_v ė + s_p e = 0 is a damped oscillator. With damping ratio ζ and time constant T its gains are
s_v = 2ζ/T and s_p = 1/T². The paper's s_v = 1414 1/s and s_p = 10⁶ 1/s² are ζ = 0.707 and T = 1 ms.

A contact that rolls without slip wanders over both bodies, and has no place to return to: its tangential rows, as those
of resistances to rolling and pivoting, are stabilised on the velocity alone, u̇ + s_v u = 0. That is the same with s_p =
0, with limits of its own: of the real axis, 2 for either Euler scheme and 2.785 for RK4, over 2ζ.

An integrator of step h turns that oscillator into a linear map of (e, hė), stable while the map's spectral
radius is below one. The map depends on ζ and h/T alone, so the limit is a bound on h/T.

Choice of T for a step
----------------------
``stabiliser.time_constant = "auto"`` is two steps, or twice the shortest stable T where that is longer
(`recommended_ratio`). Everything scales with h, so the choice is one of z = h/T for each integrator and ζ:

- A larger z makes an error decay in fewer steps, and reduces the error of a sliding tip with an Euler scheme,
  e = ∓ζ h T Ȧq̇ (tests/closedloop/stabiliser_errors.py).
- Near the limit an error alternates from step to step instead. The paper's z = 1 is at 97 % of semi-implicit Euler's
  limit: an error is multiplied by −0.88 at every step, with z = 1/2 by 0.54. Rounding of e goes into f by a gain
  that grows like z² first, and without bound at the limit. So z is at most half the limit.
- The stages of a Runge-Kutta scheme are evaluated at states off the closure, to which the stabiliser responds. Its
  share of f grows like z⁴ with RK4, and does not fall with h while T falls with it: 3 % of the centripetal force at
  half the limit for ζ = 0.707, 29 % for ζ = 1; with z = 1/2 about 1 % at most, for any ζ. So z is at most 1/2.

The z of least spectral radius is no rule. For small ζ it lies within a hundredth of the limit, near ζ = 0.78 it jumps
from 0.46 to 0.83 with semi-implicit Euler, and with RK4 that share is 7 % for ζ = 0.707 and 59 % for ζ = 1. The rule
above costs little: at ζ = 0.707 the spectral radius is 0.54, 0.74 and 0.70 (semi-implicit Euler, explicit Euler,
RK4) where the least is 0.41, 0.71 and 0.34. Rounding needs no bound of its own: it moves the WAM's f by 5e-11 N at
h = 1 ms, and by 1/h² more with shorter steps. `closedloop study drift` measures all of this.
"""

from functools import lru_cache

import numpy as np

from closedloop.base.arrays import Array
from closedloop.mechanics.integrators import INTEGRATORS, Integrator

# An undamped mode has radius one, and a hundred roundings of 1e-16 in computing it.
NEUTRAL = 1.0 + 1e-13
# The automatic T is at least this many steps, and this many times the shortest stable one.
STEPS, MARGIN = 2.0, 2.0
# Ratios at which a crossing is looked at closer.
CLOSER = 65


def baumgarte_gains(damping_ratio: float, time_constant: float) -> tuple[float, float]:
    """Return (s_v, s_p) = (2ζ/T, 1/T²) in 1/s and 1/s² for damping ratio ζ and time constant T, s."""
    return 2.0 * damping_ratio / time_constant, 1.0 / time_constant / time_constant


def _scheme(integrator: str | type[Integrator]) -> type[Integrator]:
    return INTEGRATORS[integrator] if isinstance(integrator, str) else integrator


def amplification(
    integrator: str | type[Integrator], damping_ratio: float | Array, ratio: float | Array, rolls: bool = False
) -> Array:
    """Return the (2, 2) map of (e, hė) over one step of `integrator`, for ratio = h/T; (..., 2, 2) for many ratios.

    `damping_ratio`, float, or ndarray (...): ζ, dimensionless; one for all, or one for each ratio.
    `ratio`, float, or ndarray (...): h/T, dimensionless.
    `rolls`: of a row that is stabilised on the velocity alone.
    """
    # (e, hė)' = M (e, hė)/h with the stabilised closure ë = −s_v ė − s_p e
    M = np.zeros((*np.shape(ratio), 2, 2))
    M[..., 0, 1], M[..., 1, 0], M[..., 1, 1] = 1.0, 0.0 if rolls else -np.square(ratio), -2.0 * damping_ratio * ratio
    return linear_step(_scheme(integrator), M)


def linear_step(scheme: type[Integrator], M: Array) -> Array:
    """Return the (2 m, 2 m) map of (x, hẋ) over one step h of a scheme, where (x, hẋ)' = M (x, hẋ)/h; x is (m,).

    M may be a stack of such matrices, (..., 2 m, 2 m); so is the map then.
    """
    m, eye = M.shape[-1] // 2, np.eye(M.shape[-1])
    if scheme.semi_implicit:
        rates = eye[m:] + M[..., m:, :]
        return np.concatenate([eye[:m] + rates, rates], axis=-2)
    stages: list[Array] = []
    for row in scheme.a:
        stages.append(M @ (eye + sum((a * k for a, k in zip(row, stages, strict=False)), np.zeros_like(M))))
    return eye + sum((b * k for b, k in zip(scheme.b, stages, strict=True)), np.zeros_like(M))


def spectral_radius(
    integrator: str | type[Integrator], damping_ratio: float, ratio: float, rolls: bool = False
) -> float:
    """Return the spectral radius: the asymptotic growth of the closure error per step."""
    return float(spectral_radii(integrator, damping_ratio, ratio, rolls))


def spectral_radii(
    integrator: str | type[Integrator], damping_ratio: float | Array, ratios: float | Array, rolls: bool = False
) -> Array:
    """Return the spectral radius for one ratio h/T, or for each of an array; arguments as those of `amplification`."""
    A = amplification(integrator, damping_ratio, ratios, rolls)
    mean, half = 0.5 * (A[..., 0, 0] + A[..., 1, 1]), 0.5 * (A[..., 0, 0] - A[..., 1, 1])
    square = half * half + A[..., 0, 1] * A[..., 1, 0]  # the eigenvalues are mean ± √square
    root = np.sqrt(np.abs(square))
    return np.where(square < 0.0, np.hypot(mean, root), np.abs(mean) + root)


def largest_stable_ratio(integrator: str | type[Integrator], damping_ratio: float, rolls: bool = False) -> float:
    """Return the largest h/T for which the closure error does not grow; 0 if it grows at any (ζ = 0, explicit Euler).

    Found by looking upwards from small ratios, and closer at the first crossing of spectral radius one.
    For ζ = 1/√2: 1.0353 semi-implicit Euler, 1.4142 explicit Euler, 2.7044 RK4. With `rolls` that of a system which
    has rows stabilised on the velocity alone, too: 1.9694 RK4.
    """
    limit = _largest_stable_ratio(_scheme(integrator), damping_ratio, False)  # type: ignore[arg-type]  # hashable
    if not rolls:
        return limit
    return min(limit, _largest_stable_ratio(_scheme(integrator), damping_ratio, True))  # type: ignore[arg-type]


@lru_cache(maxsize=256)
def _largest_stable_ratio(integrator: type[Integrator], damping_ratio: float, rolls: bool) -> float:
    ratios = _ratios(damping_ratio)
    while True:
        grows = np.flatnonzero(spectral_radii(integrator, damping_ratio, ratios, rolls) > NEUTRAL)
        if grows.size == 0:
            return float(ratios[-1])
        if grows[0] == 0:
            return 0.0
        low, high = float(ratios[grows[0] - 1]), float(ratios[grows[0]])
        if high - low <= 1e-12 * high:
            return low
        ratios = np.geomspace(low, high, CLOSER)


_RATIOS = np.geomspace(1e-5, 1e3, 801)


def _ratios(damping_ratio: float) -> Array:
    """Return the ratios h/T that are looked at, upwards."""
    # The faster of two overdamped modes has rate 2ζ/T, so limits fall with 1/ζ.
    return _RATIOS / max(1.0, damping_ratio)


def is_stable(integrator: str | type[Integrator], damping_ratio: float, ratio: float) -> bool:
    """Whether a ratio h/T is up to the `largest_stable_ratio`, without finding that."""
    ratios = _ratios(damping_ratio)
    looked_at = np.append(ratios[ratios < ratio], ratio)
    return not np.any(spectral_radii(integrator, damping_ratio, looked_at) > NEUTRAL)


def recommended_ratio(integrator: str | type[Integrator], damping_ratio: float, rolls: bool = False) -> float:
    """Return the h/T of ``stabiliser.time_constant = "auto"``; 0 if no T makes the closure error die out (ζ = 0).

    T is two steps, or twice the shortest stable time constant where that is longer; the top of this module says why.
    """
    if not damping_ratio > 0.0:
        return 0.0
    return min(1.0 / STEPS, largest_stable_ratio(integrator, damping_ratio, rolls) / MARGIN)
