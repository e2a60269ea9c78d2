"""The numbers of a machine fitted to tests: for every engine the same tests, the same search, the same budget.

The cost is a sum of squares over the tests: of the logarithms of first peak, frequency of the swing and settling time,
of the time without contact, and of the force itself in the first second. Nelder and Mead's simplex finds a minimum over
the logarithms of the numbers. Derivatives do not help it: the largest line of a spectrum and the last crossing of a
band jump. Intervals are those of the residuals made linear at the minimum.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Protocol

import numpy as np
from scipy.optimize import least_squares, minimize

from closedloop.base.arrays import Array
from validation.measured.pressing.machine import CYCLE, Parameter
from validation.measured.pressing.touchdowns import LOST as LOST_BELOW
from validation.measured.pressing.touchdowns import SMOOTH, STEP, Figures, Touchdown, figures, smoothed

# A test counts in the fit by its place in this list; files with other tests are predicted.
TRAINING = (
    "direct_F100_g0.5_v0.10", "direct_F100_g0.5_v0.25", "straight_F15_g0.5_v0.25", "straight_F15_g1_v0.25",
    "straight_F55_g0.5_v0.25", "straight_F55_g1_v0.25", "ramp_F15_g1_v0.10", "ramp_F15_g1_v0.25", "ramp_F55_g0.5_v0.25",
    "ramp_F55_g1_v0.10",
)  # fmt: skip
# Simulations of all tests for each number that is fitted, the first simplex, and a new one after this share of them.
BUDGET, SIZE, AGAIN = 6, 1.15, 0.6
# What a residual is divided by: a share of the peak, of the frequency, of the settling time, s without contact, and of
# the RMS of the force about the commanded one.
PEAK, FREQUENCY, SETTLING, LOST, FORCE = 0.1, 0.1, 0.3, 0.3, 1.0
LONGEST, WORST = 1.0, 3.0  # s of the force that count; the largest residual of a figure
DIFFERENCE, CONFIDENCE = 0.05, 1.96


class Engine(Protocol):
    """What simulates a test."""

    name: ClassVar[str]
    parameters: ClassVar[Sequence[Parameter]]

    def simulate(self, values: Mapping[str, float], test: Touchdown) -> tuple[Array, Array]:
        """Return time (N,), s, 0 at the first contact, and force (N,), N."""


@dataclass(frozen=True)
class Fit:
    """Values by name, their intervals (low, high), the cost, and how often all tests were simulated."""

    values: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    cost: float
    simulations: int


@cache
def measured_figures(test: Touchdown) -> Figures:
    """Return the figures of what was measured."""
    return figures(test.time, test.measured, test.force, test.rest)


def residuals(engine: Engine, values: Mapping[str, float], tests: Sequence[Touchdown]) -> Array:
    """Return the residuals of all tests."""
    parts = []
    for test in tests:
        time, force = engine.simulate(values, test)
        have, want = figures(time, force, test.force, test.rest), measured_figures(test)
        each = np.array([
            np.log(max(have.peak, 1.0) / want.peak) / PEAK, np.log(have.frequency / want.frequency) / FREQUENCY,
            np.log((have.settling + SMOOTH) / (want.settling + SMOOTH)) / SETTLING, (have.lost - want.lost) / LOST,
        ])  # fmt: skip
        t = np.arange(0.0, LONGEST, STEP)
        both = [smoothed(np.interp(t, at, f), SMOOTH)[:: round(SMOOTH / STEP)] for at, f in
                ((time, force), (test.time, test.measured))]  # fmt: skip
        size = np.sqrt(np.mean((both[1] - test.force) ** 2) * len(both[0]))
        parts += [np.clip(each, -WORST, WORST), np.clip((both[0] - both[1]) / size / FORCE, -WORST, WORST)]
    return np.concatenate(parts)


def fit(engine: Engine, tests: Sequence[Touchdown], budget: int | None = None, told: Callable[[str], Any] | None = None,
        first: Mapping[str, float] | None = None) -> Fit:  # fmt: skip
    """Return the values that simulate the tests best, from `first` on, or from the first values of the parameters."""
    names = [p.name for p in engine.parameters]
    low, high = (np.log([getattr(p, end) for p in engine.parameters]) for end in ("low", "high"))
    best = np.log([(first or {}).get(p.name, p.first) for p in engine.parameters])
    used, least = 0, np.inf
    budget = int(BUDGET * len(names)) if budget is None else budget

    def values_at(x: Array) -> dict[str, float]:
        return dict(zip(names, map(float, np.exp(x)), strict=True))

    def cost(x: Array) -> float:
        r = residuals(engine, values_at(x), tests)
        return float(r @ r) / len(tests)

    while budget > used:
        simplex = np.vstack([best, best + np.diag(np.full(len(best), np.log(SIZE)))])
        options = {
            "maxfev": min(int(AGAIN * budget) + 1, budget - used),
            "initial_simplex": np.clip(simplex, low, high),
        }
        found = minimize(cost, best, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)), options=options)
        used += int(found.nfev)
        if found.fun < least:
            best, least = found.x, float(found.fun)
        if told is not None:
            told(f"{engine.name} {used:4} {least:9.4f}  " + " ".join(f"{v:.4g}" for v in values_at(best).values()))
    return Fit(values_at(best), intervals(engine, values_at(best), tests), least, used)


def intervals(
    engine: Engine, values: Mapping[str, float], tests: Sequence[Touchdown]
) -> dict[str, tuple[float, float]]:
    """Return an interval of each value, of the residuals made linear in the logarithms by differences of 5 %."""
    at = residuals(engine, values, tests)
    rows = [
        (residuals(engine, {**values, name: x * (1.0 + DIFFERENCE)}, tests) - at) / np.log1p(DIFFERENCE)
        for name, x in values.items()
    ]
    J = np.array(rows).T
    variance = float(at @ at) / max(1, len(at) - len(rows))
    half = CONFIDENCE * np.sqrt(variance * np.maximum(np.diag(np.linalg.pinv(J.T @ J, rcond=1e-10)), 0.0))
    half = np.where(np.any(J != 0.0, axis=0), np.minimum(half, np.log(1e6)), np.log(1e6))
    return {n: (x * float(np.exp(-h)), x * float(np.exp(h))) for (n, x), h in zip(values.items(), half, strict=True)}


def set_point_speed(test: Touchdown, mass: float, damping: float, lag: float) -> tuple[Array, Array]:
    """Return time (N,), s, from the first contact on, and the speed (N,), m/s, that the measured force asks for.

    That of `servo_admittance`, M v̇ = g (f_s − f_des − B v), B in contact only, with f_s behind the force by a low-pass.
    It starts at the logged speed.
    """
    edges = np.arange(0.0, test.rest, CYCLE)
    area = np.concatenate([[0.0], np.cumsum(np.diff(test.time) * 0.5 * (test.measured[1:] + test.measured[:-1]))])
    force = np.diff(np.interp(edges, test.time, area)) / CYCLE
    assert test.desired is not None
    speed, reading, found = -float(np.interp(0.0, *test.desired)), 0.0, []
    for f in force:
        reading += (1.0 - np.exp(-CYCLE / lag)) * (f - reading)
        held = damping if f > LOST_BELOW else 0.0
        # The damper is taken at the new speed, so that no damper makes the step unstable.
        speed = (speed + CYCLE * test.gain * (reading - test.force) / mass) / (1.0 + CYCLE * test.gain * held / mass)
        speed = min(max(speed, -test.limit), test.limit)
        found.append(speed)
    return edges[1:], np.array(found)


def force_mode(test: Touchdown) -> tuple[float, float, float, float]:
    """Return mass, kg, damper, N s/m, and lag, s, by the logged desired speed of a test, and the share not explained.

    No simulated arm is in it: the measured force goes in, the logged speed of the set point comes out.
    """
    assert test.desired is not None
    at, logged = test.desired

    def misses(x: Array) -> Array:
        time, speed = set_point_speed(test, *np.exp(x))
        wanted = np.interp(time, at, logged)
        return np.asarray((np.abs(speed) - wanted) / np.sqrt(np.sum(wanted * wanted)))

    bounds = np.log([[5.0, 20.0, 1e-3], [500.0, 2e4, 0.2]])
    found = min(
        (least_squares(misses, np.log([45.0, b, 0.01]), bounds=bounds) for b in (300.0, 2000.0)), key=lambda f: f.cost
    )
    mass, damping, lag = map(float, np.exp(found.x))
    return mass, damping, lag, float(np.sqrt(2.0 * found.cost))
