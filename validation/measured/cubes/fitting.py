"""Parameters of an engine fitted to tosses: for every engine the same tosses, the same optimiser, the same budget."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from closedloop.base.arrays import Array
from validation.measured.cubes.engine import CubeEngine
from validation.measured.cubes.tosses import Toss, first_row, mean_errors

# Every so many tosses one is fitted to, so many in all; the others judge.
EVERY, TOSSES = 10, 40
# Simulations of these tosses that an optimiser may ask for, and that it may ask for before it begins anew.
BUDGET, ROUND = 200, 70
# The first simplex goes so far from the start in each parameter: by this factor.
SIZE = 1.25
# What a toss counts that was not completed, in % of the side and in degrees.
NOT_COMPLETED = 100.0


@dataclass(frozen=True)
class Fit:
    """Fitted values of an engine's parameters, the cost there, and the simulations that it took."""

    values: tuple[float, ...]
    cost: float
    simulations: int


def training(tosses: Sequence[Toss]) -> list[Toss]:
    """Return the tosses to fit to."""
    return list(tosses[::EVERY][:TOSSES])


def fit(
    engine: CubeEngine, tosses: Sequence[Toss], budget: int = BUDGET, told: Callable[[str], None] | None = None
) -> Fit:
    """Fit an engine to tosses: Nelder and Mead's method, in the logarithms of the parameters.

    What becomes least is the mean position error in % of the side plus the mean rotation error in degrees. The cost is
    rough, since tosses tumble one way or the other, and a simplex can collapse on a slope of it: after `ROUND`
    simulations a new one begins at the best values so far.

    tosses: see `training`
    budget: simulations of all of them
    told: gets a line after each simulation
    """
    starts = [first_row(toss) for toss in tosses]
    low, high = (np.log([getattr(p, end) for p in engine.parameters]) for end in ("low", "high"))
    first = np.log([p.start for p in engine.parameters])

    def cost(x: Array) -> float:
        values = [float(value) for value in np.exp(x)]
        means = mean_errors(tosses, engine.simulate(values, starts, tosses))
        found = float(np.where(np.isnan(means), NOT_COMPLETED, means).mean(axis=0).sum())
        if told is not None:
            told(f"{engine.name} {found:8.4f}  " + " ".join(f"{value:.5g}" for value in values))
        return found

    best, used, least = first, 0, np.inf
    while budget - used > len(first) + 1:
        simplex = np.vstack([best, best + np.diag(_sizes(engine))])
        found = minimize(
            cost, best, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)),
            options={
                "maxfev": min(ROUND, budget - used), "initial_simplex": np.clip(simplex, low, high), "xatol": 1e-4,
                "fatol": 1e-4,
            },
        )  # fmt: skip
        used += int(found.nfev)
        if found.fun < least:
            best, least = found.x, float(found.fun)
    return Fit(tuple(float(value) for value in np.exp(best)), least, used)


def _sizes(engine: CubeEngine) -> Array:
    """Return the first simplex's edges: a side is known to a per cent, the others are not."""
    return np.array([0.01 if p.name == "side" else np.log(SIZE) for p in engine.parameters])
