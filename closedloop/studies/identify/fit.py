"""Weighted least squares and instrumental variables, with intervals that allow for correlated residuals.

    χ = (Zᵀ Ω W)⁻¹ Zᵀ Ω τ,   Ω = 1/σ_j² of each joint, Z = W for least squares

Instruments Z are the regressor of a motion whose noise is independent of that of W, so that noise of the positions does
not bias χ. The residuals of a real robot are no white noise: those of each joint are taken for an autoregression,

    u_t = φ_j u_{t−1} + e_t,   var e = s_j²,   cov χ = A⁻¹ Zᵀ Ω Γ Ω Z A⁻ᵀ,   A = Zᵀ Ω W,   Γ = cov u

where φ_j and s_j maximise the restricted likelihood, that of the part of τ that no χ explains: the residuals themselves
are less correlated than the noise, as χ follows whatever in it is slow. The e of the joints at one instant may be
correlated. As φ and s are known only so well, intervals are those of Student's t, with the degrees of freedom that the
variance of a variance has (Satterthwaite): `deviation` is made so wide that 1.96 of it are 95 %. σ_j² is the sum of
squares over the windows less the parameters that they tell (Horn), and not below the noise of the torque itself.
Sources: D. Harville, J. American Statistical Association 72 (1977) 320-338; D. Andrews, J. Monahan, Econometrica 60
(1992) 953-966, who whiten by autoregressions; F. Satterthwaite, Biometrics Bulletin 2 (1946) 110-114; S. Horn, R. Horn,
D. Duncan, J. American Statistical Association 70 (1975) 380-385; A. Janot, P.-O. Vandanjon, M. Gautier, A generic
instrumental variable approach for industrial robot identification, IEEE Trans. Control Systems Technology 22 (2014)
132-145.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize, signal, stats

from closedloop.base.arrays import Array, Mask
from robot_models.cached import cached_property

# Rounds of weighting: the weights follow from the residuals, and the residuals from the weights.
ROUNDS = 20
# A column whose part that no other column explains is below this share of it is not told from the others.
UNIQUE = 2e-3
# So many products, and the threads of the linear algebra library are worth their start.
LARGE = 100_000_000
# A correlation of neighbouring residuals outside these is not looked for: the log is too short to tell it.
CORRELATED = -0.9, 0.995
# Of log (s/σ)², either way.
SPREAD = 20.0
# Steps of differences of φ and log s², and the least information on them that is believed.
STEP, LEAST_TOLD = 1e-4, 0.1
# Degrees of freedom of an interval, at least.
FEWEST = 3.0
# Lags of the portmanteau test of whiteness.
WHITENESS_LAGS = 10
# No division by zero, nor by its square.
TINY = 1e-100


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters, and the residual of the torques."""

    value: Array  # (b,): the parameters; 0 for those that cannot be distinguished from others
    told: Mask  # (b,) bool: which parameters the rows distinguish
    # for each parameter that cannot be distinguished, the others with which it is confused; empty where its column is
    # zero
    alike: tuple[tuple[int, ...], ...]
    residual: Array  # (R, n): torque less W χ, N m, in all windows, used or not
    sigma: Array  # (n,): standard deviation of the noise in the windows used
    condition: float  # of the weighted W, columns of length one
    # (b,): what a torque that the model lacks, and that is as large as the residual, adds to a parameter at most
    lacking: Array
    noise: Callable[[], tuple[Array, Array]]  # what `covariance` and `correlation` are computed by when they are asked

    @cached_property
    def _noise(self) -> tuple[Array, Array]:
        return self.noise()

    @property
    def covariance(self) -> Array:
        """Covariance (b, b) of the parameters that are distinguished; the rows and columns of others are 0."""
        return self._noise[0]

    @property
    def correlation(self) -> Array:
        """Correlation φ (n,) of the noise of each joint from one window to the next."""
        return self._noise[1]

    @property
    def deviation(self) -> Array:
        """Standard deviation (b,) of the parameters; ∞ for those that are not distinguished."""
        return np.where(self.told, np.sqrt(np.maximum(np.diag(self.covariance), 0.0)), np.inf)


def fit(
    W: Array, torque: Array, used: Mask, Z: Array | None = None, told: Mask | None = None, least: Array | float = 0.0,
    seen: Array | None = None,
) -> Fit:  # fmt: skip
    """Fit the parameters of W (R, n, b) to torques (R, n), by least squares or with instruments Z (R, n, b).

    `used` (R, n): which torques count; `told` (b,): parameters to be found, by default what `seen`, or W, tells apart.
    `least` (n,): standard deviation that the noise of the torques has at least, N m.
    """
    n, b = W.shape[1:]
    Z = W if Z is None else Z
    count = used.sum(axis=0)
    size = np.where(count > 0, np.sqrt((torque**2 * used).sum(axis=0) / np.maximum(count, 1)), 1.0)
    products = [_product(Z[used[:, j], j], W[used[:, j], j]) for j in range(n)]  # Zᵀ W of each joint, (b, b)
    sides = [_product(Z[used[:, j], j], torque[used[:, j], j, None])[:, 0] for j in range(n)]
    alike: list[tuple[int, ...]] = [()] * b
    if told is None:
        seen = W if seen is None else seen
        weighted = [seen[:, j] * (used[:, j] / np.maximum(size[j], TINY))[:, None] for j in range(n)]
        told, alike = told_apart(np.sum([_product(x, x) for x in weighted], axis=0))
    X, S, at, value = W[:, :, told], Z[:, :, told], np.ix_(told, told), np.zeros(b)
    floor = np.maximum(least, 1e-12 * np.abs(torque).max()) + TINY
    sigma, residual = np.maximum(size, floor), torque
    scale = np.sqrt(np.einsum("tji,tj->i", X**2, used / sigma**2))  # columns of about one length
    for _ in range(ROUNDS):
        parts = np.array([x[at] / s**2 for x, s in zip(products, sigma, strict=True)]) / scale / scale[:, None]
        inverse = linalg.inv(parts.sum(axis=0))
        side = np.sum([x[told] / s**2 for x, s in zip(sides, sigma, strict=True)], axis=0) / scale
        value[told] = inverse @ side / scale
        residual = torque - X @ value[told]
        squares, free = (residual**2 * used).sum(axis=0), count - np.einsum("ab,jba->j", inverse, parts)
        last, sigma = sigma, np.maximum(np.sqrt(squares / np.maximum(free, 1.0)), floor)
        if np.all(np.abs(sigma - last) < 1e-6 * sigma):
            break
    # χ̂ − χ = Σ_t rows_tᵀ u_t, at most Σ_j |rows_j| |u_j| whatever u is (Cauchy and Schwarz)
    back = inverse / scale[:, None] / scale
    rows = np.einsum("kl,tjl->tjk", back, S * (used / last**2)[:, :, None], optimize=True)
    lacking = np.zeros(b)
    lacking[told] = np.sqrt(squares) @ np.sqrt(np.einsum("tjk,tjk->jk", rows, rows))

    def noise() -> tuple[Array, Array]:
        found, phi = _covariance(rows, X / scale, torque, residual, used, sigma)
        covariance = np.zeros((b, b))
        covariance[at] = found
        return covariance, phi

    square = np.sum([_product(x, x) for x in (X[used[:, j], j] / sigma[j] for j in range(n))], axis=0)
    size = np.sqrt(np.diag(square))
    condition = float(np.sqrt(np.linalg.cond(square / size / size[:, None]))) if told.any() else 1.0
    return Fit(value, told, tuple(alike), residual, sigma, condition, lacking, noise)


def _covariance(rows: Array, X: Array, torque: Array, residual: Array, used: Mask, sigma: Array) -> tuple[Array, Array]:
    """Return the covariance (b, b) of Σ_t rows_tᵀ u_t, `rows` (R, n, b), as wide as Student's, and φ (n,) of u."""
    n = len(sigma)
    phi, step, unsure = _autoregression(X, torque, used, sigma)
    innovation = np.where(used[1:] & used[:-1], residual[1:] - phi * residual[:-1], 0.0)
    gram = innovation.T @ innovation
    length = np.maximum(np.sqrt(np.diag(gram)), TINY)
    together = np.where(np.eye(n) > 0.0, 1.0, gram / length / length[:, None]) * step * step[:, None]  # cov e

    def reach(phi: Array) -> list[Array]:
        """Return what an innovation adds, by all windows after it."""
        return [np.asarray(signal.lfilter([1.0], [1.0, -phi[j]], rows[:, j][::-1], axis=0)[::-1]) for j in range(n)]

    def variances(phi: Array) -> Array:
        """Return the parts (n, n, b) of the variances, by pairs of joints."""
        g = np.stack(reach(phi), axis=1)
        before = phi * phi[:, None] / (1.0 - phi * phi[:, None])  # the noise was there before the log
        inside = np.einsum("tia,tja->ija", g, g) + before[:, :, None] * g[0][:, None] * g[0]
        return np.asarray(together[:, :, None] * inside)

    parts = variances(phi)
    known = parts.sum(axis=(0, 1))
    slopes = []  # of the variances by φ and by log s² of each joint
    for j in range(n):
        moved = phi + STEP * (np.arange(n) == j) * np.where(phi > 0.0, -1.0, 1.0)
        slopes.append((variances(moved).sum(axis=(0, 1)) - known) / (moved[j] - phi[j]))
    slopes += list(parts.sum(axis=0))
    spread = np.einsum("ia,ij,ja->a", slopes, unsure, slopes)
    freedom = np.maximum(2.0 * known**2 / np.maximum(spread, TINY), FEWEST)
    wider = stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)
    found = np.zeros((rows.shape[2],) * 2)
    g = reach(phi)
    for i in range(n):
        for j in range(n):
            before = phi[i] * phi[j] / (1.0 - phi[i] * phi[j])
            found += together[i, j] * (_product(g[i], g[j]) + before * np.outer(g[i][0], g[j][0]))
    return found * wider * wider[:, None], phi


def _autoregression(X: Array, torque: Array, used: Mask, sigma: Array) -> tuple[Array, Array, Array]:
    """Return φ, s (n,) and the covariance (2n, 2n) of φ and log s² of the noise, of greatest restricted likelihood.

    `X` (R, n, b): columns that are told apart, of about one length, over `sigma` (n,), where the search begins.
    """
    n, b = X.shape[1:]
    both = used[1:] & used[:-1]
    first = used.copy()  # windows without a used one before: of them the noise has the variance s²/(1 − φ²)
    first[1:] &= ~both
    count, firsts = used.sum(axis=0), first.sum(axis=0)
    if count.sum() <= b:
        return np.zeros(n), sigma, np.eye(2 * n) / LEAST_TOLD
    # of [X τ]/σ: of windows with themselves, those before, of those, of firsts
    moments = np.zeros((n, 4, b + 1, b + 1))
    for j in range(n):
        rows = np.column_stack([X[:, j], torque[:, j]]) / sigma[j]
        now, before, alone = rows[1:][both[:, j]], rows[:-1][both[:, j]], rows[first[:, j]]
        cross, of_first = _product(now, before), _product(alone, alone)
        moments[j] = _product(now, now) + of_first, cross + cross.T, _product(before, before), of_first

    def unlikely(z: Array) -> tuple[float, Array]:
        """Return −2 log of the likelihood of φ and log (s/σ)², and its derivative."""
        phi, log = z[:n], z[n:]
        weights, square = np.exp(-log), phi * phi
        powers = np.stack([np.ones(n), -phi, square, -square], axis=1)
        A = np.einsum("j,jk,jkab->ab", weights, powers, moments)
        C = linalg.inv(A[:b, :b])
        left = np.append(-C @ A[:b, b], 1.0)
        squares = np.einsum("a,jkab,b->jk", left, moments, left) + np.einsum("ab,jkab->jk", C, moments[:, :, :b, :b])
        slope = 2.0 * phi * (squares[:, 2] - squares[:, 3]) - squares[:, 1]
        rise = np.concatenate([
            weights * slope + 2.0 * firsts * phi / (1.0 - square), count - weights * (powers * squares).sum(axis=1)
        ])  # fmt: skip
        value = count @ log - firsts @ np.log(1.0 - square) + np.linalg.slogdet(A[:b, :b])[1] + left @ A @ left
        return float(value), rise

    bounds = [CORRELATED] * n + [(-SPREAD, SPREAD)] * n
    best = optimize.minimize(unlikely, np.zeros(2 * n), jac=True, method="L-BFGS-B", bounds=bounds).x
    bend = np.array([(unlikely(best + e)[1] - unlikely(best - e)[1]) / (2.0 * STEP) for e in STEP * np.eye(2 * n)])
    values, vectors = linalg.eigh(0.25 * (bend + bend.T))  # of the information
    return best[:n], sigma * np.exp(0.5 * best[n:]), (vectors / np.maximum(values, LEAST_TOLD)) @ vectors.T


def told_apart(square: Array) -> tuple[Mask, list[tuple[int, ...]]]:
    """Return which columns of X are told from all others, by XᵀX (b, b), and for each that is not, what it looks like.

    A column is not told if what the others do not explain is below `UNIQUE` of it; the least told is taken out first.
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


def whiteness(residual: Array, used: Mask) -> Array:
    """Return the probability that white residuals (R, n) are as correlated as these, (n,) (Ljung and Box)."""
    statistic = np.zeros(residual.shape[1])
    for lag in range(1, WHITENESS_LAGS + 1):
        both = used[lag:] & used[:-lag]
        x, y = residual[lag:] * both, residual[:-lag] * both
        scale = (x**2).sum(axis=0) * (y**2).sum(axis=0)
        statistic += both.sum(axis=0) * (x * y).sum(axis=0) ** 2 / np.where(scale > 0.0, scale, 1.0)
    return np.asarray(stats.chi2.sf(statistic, WHITENESS_LAGS))
