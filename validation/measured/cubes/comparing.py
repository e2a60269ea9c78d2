"""Engines with fitted parameters, judged on tosses that they were not fitted to.

Parameters of an engine fitted to tosses: for every engine the same tosses, the same optimiser, the same budget.
"""

import importlib.util
import json
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from closedloop.base.arrays import Array
from validation.measured.cubes.engine import ClosedLoopCube, CubeEngine, DrakeCube, MuJoCoCube
from validation.measured.cubes.flight import fitted_start, flight, heights
from validation.measured.cubes.tosses import RATE, Toss, errors, first_row, mean_errors
from validation.measured.judged import DATA

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


FITTED = DATA / "cube_fits.json"
# The package that an engine needs.
PACKAGES = {ClosedLoopCube: "closedloop", MuJoCoCube: "mujoco", DrakeCube: "pydrake"}
RESAMPLES, SEED = 4000, 28
# Instants of the table of errors over time, s, and the width of the mean about each.
INSTANTS, ABOUT = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), 0.05
MOST_IMPACTS = 5


@dataclass(frozen=True)
class Tried:
    """What an engine made of the tosses.

    paths: (rows, 7), from the first row
    means: (tosses, 2), mean position error, % of the side, and rotation error, degrees, of each; NaN where not
        completed
    started: (tosses, 2), the same, from the state fitted to the flight
    seconds: wall time of a toss
    """

    engine: CubeEngine
    paths: list[Array]
    means: Array
    started: Array
    seconds: float


def engines() -> list[CubeEngine]:
    """Return the engines that are installed."""
    return [engine() for engine, package in PACKAGES.items() if importlib.util.find_spec(package)]


def fits() -> dict[str, Any]:
    """Return what `python -m validation.measured.cubes` has written: values and cost by engine."""
    return json.loads(FITTED.read_text(encoding="utf-8"))


def fitted(engine: CubeEngine) -> list[float]:
    """Return the fitted values of an engine's parameters."""
    values = fits()[engine.name]["values"]
    return [float(values[p.name]) for p in engine.parameters]


def held_out(tosses: Sequence[Toss], shipped: Sequence[Toss]) -> list[Toss]:
    """Return the tosses that no engine was fitted to: those that do not begin as one of the training set does."""
    known = {toss.states[0].astype(np.float32).tobytes() for toss in training(shipped)}
    return [toss for toss in tosses if toss.states[0].astype(np.float32).tobytes() not in known]


def tried(engine: CubeEngine, tosses: Sequence[Toss]) -> Tried:
    """Simulate the tosses from both starts."""
    values = fitted(engine)
    engine.simulate(values, [first_row(tosses[0])], tosses[:1])  # what is compiled or read once is not timed
    began = clock.perf_counter()
    paths = engine.simulate(values, [first_row(toss) for toss in tosses], tosses)
    seconds = (clock.perf_counter() - began) / len(tosses)
    started = engine.simulate(values, [fitted_start(toss) for toss in tosses], tosses)
    return Tried(engine, paths, mean_errors(tosses, paths), mean_errors(tosses, started), seconds)


def interval(values: Array) -> list[float]:
    """Return the 95 % interval of the mean of values, by bootstrap."""
    rng = np.random.default_rng(SEED)
    means = values[rng.integers(0, len(values), (RESAMPLES, len(values)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return [float(low), float(high)]


def numbers_of(one: Tried) -> dict[str, Any]:
    """Return the figures of an engine, of the tosses that it completed."""
    done = np.asarray(~np.isnan(one.means).any(axis=1))
    both = ~np.isnan(one.started).any(axis=1)
    told: dict[str, Any] = {
        "completed": int(done.sum()), "tosses": len(done), "seconds_per_toss": one.seconds,
        "parameters": {p.name: x for p, x in zip(one.engine.parameters, fitted(one.engine), strict=True)},
    }  # fmt: skip
    for column, name in enumerate(("position_percent", "rotation_degrees")):
        if not done.any():
            told[name] = None
            continue
        told[name] = float(one.means[done, column].mean())
        told[f"{name}_interval"] = interval(one.means[done, column])
        told[f"{name}_median"] = float(np.median(one.means[done, column]))
        told[f"{name}_start_fitted"] = float(one.started[both, column].mean()) if both.any() else None
    return told


def against(ours: Tried, theirs: Tried) -> dict[str, Any]:
    """Return by how much our mean error is below another engine's, with the interval over the tosses both completed."""
    both = ~np.isnan(ours.means).any(axis=1) & ~np.isnan(theirs.means).any(axis=1)
    told: dict[str, Any] = {}
    rng = np.random.default_rng(SEED)
    drawn = rng.integers(0, both.sum(), (RESAMPLES, both.sum()))
    for column, name in enumerate(("position", "rotation")):
        a, b = ours.means[both, column], theirs.means[both, column]
        shares = 1.0 - a[drawn].mean(axis=1) / b[drawn].mean(axis=1)
        low, high = np.percentile(shares, [2.5, 97.5])
        told[name] = {"below": float(1.0 - a.mean() / b.mean()), "interval": [float(low), float(high)]}
    return told


def over_time(tosses: Sequence[Toss], one: Tried) -> list[tuple[float, float, float]]:
    """Return instant, s, and mean position and rotation error of the rows about it that were simulated."""
    found = [errors(toss, path) for toss, path in zip(tosses, one.paths, strict=True)]
    at = np.concatenate([np.arange(len(position)) for position, _ in found]) / RATE
    position, rotation = (np.concatenate([each[k] for each in found]) for k in (0, 1))
    rows = [(t, np.abs(at - t) <= ABOUT / 2.0) for t in INSTANTS]
    return [(t, float(position[near].mean()), float(rotation[near].mean())) for t, near in rows if near.any()]


def impacts_before(toss: Toss) -> NDArray[np.int64]:
    """Return how many impacts there were until each row, told from the lowest corner: where its fall ends at the board.

    Impacts within two rows of each other are counted once.
    """
    lowest = heights(toss)
    falls = np.diff(lowest) < -0.3 / RATE  # m: a fall of 0.3 m/s
    ends = np.flatnonzero(falls[:-1] & ~falls[1:]) + 1
    counted = np.zeros(len(lowest), dtype=np.int64)
    counted[flight(toss) :] = 1
    for end in ends[ends > flight(toss) + 2]:
        counted[end:] += 1
    return counted


def over_impacts(tosses: Sequence[Toss], one: Tried) -> list[tuple[int, float, float]]:
    """Return number of impacts, and mean position and rotation error of the rows that have had so many."""
    found = [errors(toss, path) for toss, path in zip(tosses, one.paths, strict=True)]
    counted = np.concatenate(
        [impacts_before(toss)[: len(each[0])] for toss, each in zip(tosses, found, strict=True)]
    ).clip(max=MOST_IMPACTS)
    position, rotation = (np.concatenate([each[k] for each in found]) for k in (0, 1))
    rows = [(k, counted == k) for k in range(MOST_IMPACTS + 1)]
    return [(k, float(position[some].mean()), float(rotation[some].mean())) for k, some in rows if some.any()]


def source_of(given: Path | None) -> str:
    """Return where tosses come from, for a reader."""
    return "DAIRLab, dair_pll (ContactNets), BSD-3" if given is None else str(given)
