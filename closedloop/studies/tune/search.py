"""The search for the least value under constraints: several starts, each by scipy's SLSQP.

With variations the least *worst* value is looked for as the least s with s >= value of each variation, which has
derivatives where the worst itself has a kink; or the mean. What ends a search is checked: Karush, Kuhn and Tucker's
conditions are solved for multipliers, and the part of the gradient that they do not explain is `Found.slope`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize, nnls
from scipy.stats import qmc

from closedloop.base.arrays import Array

# Takes points (P, n), each number from 0 to 1; returns the values (P, V) of V variations, and by how much each of K
# constraints is violated (P, V, K), as a share of its limit, negative where it is met; NaN where there is no run.
Evaluate = Callable[[Array], tuple[Array, Array]]

WORST, MEAN = "worst", "mean"
# Step of the differences, as a share of the range.
STEP = 1e-4
# Points that are looked at for each start, and how often a search that ended too early begins again.
LOOKS, AGAIN = 8, 4
# A search for a point that meets the constraints ends where they are met by this share of their limits.
ROOM = 1e-3
# Violations below this share of the limit are none; a constraint or a bound binds within this.
MET, BINDS = 1e-6, 1e-4
# A point is an optimum if no direction improves the value by more than this share of it over the whole range.
FLAT = 1e-3
TOLERANCE = 1e-10


@dataclass
class Found:
    """The outcome of a search."""

    x: Array  # (n,): the best point
    value: float  # its value: the worst of all variations, or the mean
    values: Array  # (V,): that of each variation
    violations: Array  # (V, K): of the constraints, as shares of their limits; negative where they are met
    # share by which the value would still fall over the whole range, where no constraint or bound prevents it
    slope: float = np.inf
    # (V, K): by how much the value falls if a limit is moved by its own size
    multipliers: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # lower, upper (n,): the same for the ends of the ranges, by the length of the range
    lower: Array = field(default_factory=lambda: np.zeros(0))
    upper: Array = field(default_factory=lambda: np.zeros(0))
    ends: list[float] = field(default_factory=list)  # where each start ended; infinite where it met no constraint

    @property
    def feasible(self) -> bool:
        """Whether all constraints are met."""
        return _feasible(self.violations)

    @property
    def optimal(self) -> bool:
        """Whether it is an optimum, of its surroundings at least."""
        return self.feasible and self.slope <= FLAT


class Search:
    """A search; it remembers every point.

    `evaluate`: see `Evaluate`.
    `n`: numbers that vary.
    `iterations`: largest number of iterations of each start.
    """

    def __init__(self, evaluate: Evaluate, n: int, robust: str = WORST, iterations: int = 60) -> None:
        self._evaluate, self.n, self.robust, self.iterations = evaluate, n, robust, iterations
        self._points: dict[bytes, tuple[Array, Array]] = {}
        self._slopes: dict[bytes, tuple[Array, Array]] = {}

    def look(self, points: Array) -> list[tuple[Array, Array]]:
        """Return values and violations of points (P, n)."""
        points = np.ascontiguousarray(points, dtype=float)
        new = list({x.tobytes(): x for x in points if x.tobytes() not in self._points}.values())
        if new:
            values, violations = self._evaluate(np.array(new))
            for x, value, violation in zip(new, values, violations, strict=True):
                self._points[x.tobytes()] = value, violation
        return [self._points[x.tobytes()] for x in points]

    def merit(self, values: Array) -> float:
        """Return the number that is minimised; infinite without a run."""
        if np.any(np.isnan(values)):
            return np.inf
        return float(np.max(values) if self.robust == WORST else np.mean(values))

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Return the derivatives of values (V, n) and violations (V, K, n); 0 where they cannot be known."""
        key = x.tobytes()
        if key not in self._slopes:
            beside = np.repeat(x[None], 2 * self.n, axis=0)
            for i in range(self.n):  # at an end of its range those of a point a step inside
                beside[2 * i : 2 * i + 2, i] = min(max(x[i], STEP), 1.0 - STEP) + STEP * np.array([-1.0, 1.0])
            seen = self.look(beside)
            values, violations = (
                np.stack([(seen[2 * i + 1][k] - seen[2 * i][k]) / (2.0 * STEP) for i in range(self.n)], axis=-1)
                for k in range(2)
            )
            self._slopes[key] = np.nan_to_num(values), np.nan_to_num(violations)
        return self._slopes[key]

    def best(self) -> tuple[Array, Array, Array]:
        """Return the best point of all, its values and violations: the least value, or else the least violation."""

        def rank(item: tuple[bytes, tuple[Array, Array]]) -> tuple[bool, float]:
            values, violations = item[1]
            if np.any(np.isnan(values)) or np.any(np.isnan(violations)):
                return True, np.inf
            met = _feasible(violations)
            return not met, self.merit(values) if met else _worst(violations)

        key, (values, violations) = min(self._points.items(), key=rank)
        return np.frombuffer(key).copy(), values, violations

    def run(self, x0: Array, starts: int, seed: int) -> Found:
        """Search from a point, and from the best of points that are drawn, and return the best of all."""
        drawn = qmc.LatinHypercube(self.n, rng=np.random.default_rng(seed)).random(LOOKS * starts)
        points = np.vstack([x0, drawn])
        seen = self.look(points)
        order = sorted(range(1, len(points)), key=lambda i: self._penalised(*seen[i]))
        ends = []
        for i in [0, *order[: starts - 1]]:
            end = points[i]
            if not self._met(end):
                end = self._descend(end, feasibility=True)
            if self._met(end):
                end = self._descend(end)
            ends.append(self.merit(self.look(end[None])[0][0]) if self._met(end) else np.inf)
        x, values, violations = self.best()
        if not np.isfinite(self.merit(values)):
            return Found(x, np.inf, values, violations, ends=ends)
        for _ in range(AGAIN):
            if not _feasible(violations) or self._explained(x)[0] <= FLAT:
                break
            self._descend(x)
            before = x
            x, values, violations = self.best()
            if np.array_equal(x, before):
                break
        slope, multipliers, lower, upper = self._explained(x)
        return Found(x, self.merit(values), values, violations, slope, multipliers, lower, upper, ends)

    def _met(self, x: Array) -> bool:
        return _feasible(self.look(x[None])[0][1])

    def _penalised(self, values: Array, violations: Array) -> float:
        if np.any(np.isnan(values)) or np.any(np.isnan(violations)):
            return np.inf
        return self.merit(values) + 10.0 * max(_worst(violations), 0.0) * (1.0 + abs(self.merit(values)))

    def _descend(self, x0: Array, feasibility: bool = False) -> Array:
        """Return where SLSQP comes to; of `feasibility` the least violation is looked for, not the least value."""
        n = self.n
        values, violations = self.look(x0[None])[0]
        if np.any(np.isnan(values)):
            return x0
        size = abs(self.merit(values)) or 1.0
        bad = 10.0 * (1.0 + np.max(np.abs(values))) / size
        worst = feasibility or (self.robust == WORST and values.size > 1)

        def rows(x: Array) -> tuple[Array, Array]:
            """Return values and violations, and numbers that no search goes to where there is no run."""
            x = np.clip(x, 0.0, 1.0)
            got, broken = self.look(x[None])[0]
            if np.any(np.isnan(got)) or np.any(np.isnan(broken)):
                return np.full(got.shape, bad), np.full(broken.shape, 1.0)
            return got / size, broken

        def objective(z: Array) -> tuple[float, Array]:
            slope = np.zeros(z.size)
            if worst:
                slope[n] = 1.0
                return float(z[n]), slope
            got, _ = rows(z)
            slope[:] = self.slopes(np.clip(z, 0.0, 1.0))[0].mean(axis=0) / size
            return float(got.mean()), slope

        def margins(z: Array) -> Array:
            got, broken = rows(z[:n])
            if feasibility:
                return np.asarray(z[n] - broken.ravel())
            return np.concatenate([z[n] - got, -broken.ravel()]) if worst else -broken.ravel()

        def of_margins(z: Array) -> Array:
            of_values, of_broken = self.slopes(np.clip(z[:n], 0.0, 1.0))
            of_broken = -of_broken.reshape(-1, n)
            if feasibility:
                return np.hstack([of_broken, np.ones((of_broken.shape[0], 1))])
            if not worst:
                return of_broken
            above = np.hstack([-of_values / size, np.ones((values.size, 1))])
            return np.vstack([above, np.hstack([of_broken, np.zeros((of_broken.shape[0], 1))])])

        z0 = np.append(x0, _worst(violations) if feasibility else np.max(values) / size) if worst else x0
        bounds = [(0.0, 1.0)] * n + [(-ROOM if feasibility else None, None)] * (z0.size - n)
        given = [{"type": "ineq", "fun": margins, "jac": of_margins}] if margins(z0).size else []
        most, close = (self.iterations // 2, 1e-6) if feasibility else (self.iterations, TOLERANCE)
        found = minimize(
            objective, z0, jac=True, method="SLSQP", bounds=bounds, constraints=given,
            options={"maxiter": most, "ftol": close},
        )  # fmt: skip
        return np.clip(found.x[:n], 0.0, 1.0)

    def _explained(self, x: Array) -> tuple[float, Array, Array, Array]:
        """Return the slope that multipliers of what binds leave over, as a share of the value, and the multipliers."""
        values, violations = self.look(x[None])[0]
        of_values, of_broken = self.slopes(x)
        size = max(abs(self.merit(values)), 1e-9)
        n, K = self.n, violations.size
        if self.robust == WORST:
            near = np.flatnonzero(values >= np.max(values) - BINDS * size)
            gradients = of_values[near] / size
        else:
            gradients = of_values.mean(axis=0, keepdims=True) / size
        binds = np.flatnonzero(violations.ravel() > -BINDS)
        low, high = np.flatnonzero(x < BINDS), np.flatnonzero(x > 1.0 - BINDS)
        eye = np.eye(n)
        columns = np.vstack([gradients, of_broken.reshape(-1, n)[binds], -eye[low], eye[high]]).T
        weight = 1e3 * (1.0 + np.max(np.abs(columns), initial=0.0))  # the weights of the values sum to 1
        ones = np.zeros(columns.shape[1])
        ones[: len(gradients)] = weight
        solved, _ = nnls(np.vstack([columns, ones]), np.append(np.zeros(n), weight))
        left = float(np.linalg.norm(columns @ solved))
        rest = solved[len(gradients) :] * size
        multipliers, lower, upper = np.zeros(K), np.zeros(n), np.zeros(n)
        multipliers[binds] = rest[: binds.size]
        lower[low], upper[high] = rest[binds.size : binds.size + low.size], rest[binds.size + low.size :]
        return left, multipliers.reshape(violations.shape), lower, upper


def _feasible(violations: Array) -> bool:
    return bool(np.all(violations <= MET))


def _worst(violations: Array) -> float:
    return float(np.max(violations, initial=-np.inf))
