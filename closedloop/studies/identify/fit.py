"""Weighted least squares and instrumental variables, with intervals that allow for correlated residuals.

    χ = (Zᵀ Ω W)⁻¹ Zᵀ Ω τ,   Ω = 1/σ_j² of each joint, Z = W for least squares

Instruments Z are the regressor of a motion whose noise is independent of that of W, so that noise of the positions does
not bias χ. The covariance is that of Newey and West: the residuals of a real robot are no white noise, and those of its
joints at one instant belong together,

    cov χ = A⁻¹ S A⁻ᵀ,   A = Zᵀ Ω W,   S = Σ_l (1 − |l|/(L + 1)) Σ_t s_t s_{t−l}ᵀ,   s_t = Z_tᵀ Ω u_t

with L from the correlation of neighbouring residuals. Of a short log S is a little too small, as few windows tell it:
where it gives a smaller deviation than white residuals would, theirs is taken. Sources: W. Newey, K. West,
Econometrica 55 (1987) 703-708; D. Andrews, Econometrica 59 (1991) 817-858, (6.2) and (6.4); A. Janot,
P.-O. Vandanjon, M. Gautier, A generic instrumental variable approach for industrial robot identification, IEEE Trans.
Control Systems Technology 22 (2014) 132-145.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from closedloop.base.arrays import Array, Mask

# Rounds of weighting: the weights follow from the residuals, and the residuals from the weights.
ROUNDS = 20
# A column whose part that no other column explains is below this share of it is not told from the others.
UNIQUE = 2e-3
# So many products, and the threads of the linear algebra library are worth their start.
LARGE = 100_000_000
# Lags of the portmanteau test of whiteness.
WHITENESS_LAGS = 10
# No division by zero, nor by its square.
TINY = 1e-100


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters, and the residual of the torques."""

    # value, deviation (b,): the parameters and their standard deviations; 0 and ∞ for those that cannot be
    # distinguished from others
    value: Array
    deviation: Array
    # (b, b): covariance of the parameters that can be distinguished; the rows and columns of others are 0
    covariance: Array
    told: Mask  # (b,) bool: which parameters the rows distinguish
    # for each parameter that cannot be distinguished, the others with which it is confused; empty where its column is
    # zero
    alike: tuple[tuple[int, ...], ...]
    residual: Array  # (R, n): torque less W χ, N m, in all windows, used or not
    sigma: Array  # (n,): their standard deviation in the windows used
    condition: float  # of the weighted W, columns of length one
    lags: int  # L


def fit(W: Array, torque: Array, used: Mask, Z: Array | None = None, told: Mask | None = None) -> Fit:
    """Fit the parameters of W (R, n, b) to torques (R, n), by least squares or with instruments Z (R, n, b).

    Parameters
    ----------
    used : (R, n) bool
        Which torques count.
    told : (b,) bool, optional
        Parameters to be found; the others are 0. What the rows tell apart, if not given.
    """
    n, b = W.shape[1:]
    Z = W if Z is None else Z
    weights = used / np.maximum(_deviation(torque, used), TINY)
    products = [_product(Z[used[:, j], j], W[used[:, j], j]) for j in range(n)]  # Zᵀ W of each joint, (b, b)
    sides = [_product(Z[used[:, j], j], torque[used[:, j], j, None])[:, 0] for j in range(n)]
    alike: list[tuple[int, ...]] = [()] * b
    if told is None:
        weighted = [W[:, j] * weights[:, j, None] for j in range(n)]
        told, alike = told_apart(np.sum([_product(x, x) for x in weighted], axis=0))
    X, S, at, value = W[:, :, told], Z[:, :, told], np.ix_(told, told), np.zeros(b)
    sigma, residual = np.maximum(_deviation(torque, used), TINY), torque
    scale = np.sqrt(np.einsum("tji,tj->i", X**2, weights**2))  # columns of about one length
    for _ in range(ROUNDS):
        A = np.sum([x[at] / s**2 for x, s in zip(products, sigma, strict=True)], axis=0) / scale / scale[:, None]
        side = np.sum([x[told] / s**2 for x, s in zip(sides, sigma, strict=True)], axis=0) / scale
        value[told] = linalg.solve(A, side) / scale
        residual = torque - X @ value[told]
        last, sigma = sigma, np.maximum(_deviation(residual, used), 1e-12 * np.abs(torque).max() + TINY)
        if np.all(np.abs(sigma - last) < 1e-6 * sigma):
            break
    scores = np.einsum("tji,tj->ti", S, residual * used / sigma**2) / scale
    lags, count = _lags(residual, used), int(used.sum())
    # Bartlett's weights are those of sums over L + 1 windows, one beside the other.
    padded = np.cumsum(np.vstack([np.zeros((1, len(scale))), scores, np.zeros((lags, len(scale)))]), axis=0)
    sums = padded - np.vstack([np.zeros((lags + 1, len(scale))), padded[: -lags - 1]])
    back = linalg.inv(A) / scale[:, None]
    white = _squares(S, used, sigma) / scale / scale[:, None]
    correlated, plain = back @ (_product(sums, sums) / (lags + 1)) @ back.T, back @ white @ back.T
    wider = np.sqrt(np.maximum(np.diag(plain) / np.maximum(np.diag(correlated), TINY), 1.0))
    covariance = np.zeros((b, b))
    covariance[at] = correlated * wider * wider[:, None] * count / max(1, count - int(told.sum()))
    deviation = np.where(told, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.inf)
    square = _squares(X, used, sigma)
    length = np.sqrt(np.diag(square))
    condition = float(np.sqrt(np.linalg.cond(square / length / length[:, None])))
    return Fit(value, deviation, covariance, told, tuple(alike), residual, sigma, condition, lags)


def told_apart(square: Array) -> tuple[Mask, list[tuple[int, ...]]]:
    """Return which columns of X are told from all others, and for each that is not, which it looks like.

    A column is not told if it is zero, or if the part of it that the others do not explain is below `UNIQUE` of it. Of
    columns that look alike one is taken out after the other, the least told first, and the rest is asked again.

    Parameters
    ----------
    square : (b, b)
        XᵀX.
    """
    b = len(square)
    size = np.sqrt(np.maximum(np.diag(square), 0.0))
    told = size > 1e-9 * max(float(size.max()), TINY)
    alike: list[tuple[int, ...]] = [()] * b
    length = np.where(told, size, 1.0)
    gram = square / length / length[:, None]
    while told.any():
        at = np.flatnonzero(told)
        # One over the diagonal of the inverse is the squared part of a column that the others do not explain.
        values, vectors = linalg.eigh(gram[np.ix_(at, at)])
        part = 1.0 / ((vectors**2) / np.maximum(values, 1e-18)).sum(axis=1)
        least = int(part.argmin())
        if part[least] > UNIQUE**2:
            break
        mix = vectors[:, 0] / (np.abs(vectors[:, 0]).max() or 1.0)
        alike[at[least]] = tuple(int(k) for k in at[np.abs(mix) > 0.1] if k != at[least])
        told[at[least]] = False
    return told, alike


def _product(x: Array, y: Array) -> Array:
    """Return xᵀy of x (R, b) and y (R, c), (b, c); a small one without the threads of the linear algebra library."""
    if x.size * y.shape[1] > LARGE:
        return np.asarray(x.T @ y)
    return np.einsum("ti,tk->ik", x, y)


def _squares(x: Array, used: Mask, sigma: Array) -> Array:
    """Return Σ_j x_jᵀ x_j/σ_j² of the rows used of x (R, n, b), (b, b)."""
    rows = [x[used[:, j], j] / sigma[j] for j in range(x.shape[1])]
    return np.asarray(np.sum([_product(one, one) for one in rows], axis=0))


def _deviation(x: Array, used: Mask) -> Array:
    found: Array = np.sqrt((x**2 * used).sum(axis=0) / np.maximum(used.sum(axis=0), 1))
    return np.where(used.any(axis=0), found, 1.0)


def correlation(residual: Array, used: Mask, lag: int = 1) -> Array:
    """Return the correlation of the residuals of each joint with those `lag` windows before, (n,)."""
    both = used[lag:] & used[:-lag]
    x, y = residual[lag:] * both, residual[:-lag] * both
    scale = np.sqrt((x**2).sum(axis=0) * (y**2).sum(axis=0))
    return (x * y).sum(axis=0) / np.where(scale > 0.0, scale, 1.0)


def whiteness(residual: Array, used: Mask) -> Array:
    """Return the probability that white residuals (R, n) are as correlated as these, (n,) (Ljung and Box)."""
    found = np.ones(residual.shape[1])
    for j in range(len(found)):
        pairs = [(int((used[k:, j] & used[:-k, j]).sum()), k) for k in range(1, WHITENESS_LAGS + 1)]
        rho = [correlation(residual, used, k)[j] for _, k in pairs]
        statistic = sum(count * r * r for (count, _), r in zip(pairs, rho, strict=True))
        found[j] = stats.chi2.sf(statistic, WHITENESS_LAGS)
    return found


def _lags(residual: Array, used: Mask) -> int:
    rho = np.clip(correlation(residual, used), -0.97, 0.97)
    alpha = float(np.median(4.0 * rho**2 / (1.0 - rho**2) ** 2))
    return int(np.clip(np.ceil(1.1447 * (alpha * len(residual)) ** (1.0 / 3.0)), 1, len(residual) // 10))
