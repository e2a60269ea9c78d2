"""Where the force loop is stable: ranges of a key, limits along it, the boundary over two keys.

A limit is solved for, as the value at which a pole reaches the unit circle. All loops of a study are linear about one
motion, that of the scenario as it is: a loop that is unstable has none of its own. On a surface of another stiffness
the tip is put as deep as carries the same force.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.signal import detrend

from closedloop.base.arrays import Array, evenly, number_at, share_of
from closedloop.base.errors import ClosedLoopError, ScenarioError, SimulationError
from closedloop.base.second_process import Beside, possible
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.scenario.load import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.assembly import instant_of, loop_at, of_fixed_steps
from closedloop.studies.analysis.here import Here, Instant, refuse_outside, run_on
from closedloop.studies.analysis.linear_loop import LinearLoop, Pole
from robot_models import RobotModel

# A key's value: a number, or a list with a number for each joint.
Value = float | list[float]


@dataclass(frozen=True)
class Range:
    """A key of the scenario, and the range of numbers in which limits are sought."""

    key: str  # dotted key
    # low, high: ends, in either order: limits are found from `low` on
    low: float
    high: float
    log: bool = False  # whether it is looked at evenly in its logarithm
    held: tuple[float, ...] = ()  # where the key is a list, as it is in the scenario; else empty
    # the entry of that list which the numbers are of, the others as they are; if left out they are of the first that is
    # not zero, and the others change by the same factor
    index: int | None = None

    def value(self, number: float) -> float | list[float]:
        """Return the key's value for a number of the range."""
        if not self.held:
            return number
        if self.index is not None:
            return [*self.held[: self.index], number, *self.held[self.index + 1 :]]
        first = next(entry for entry in self.held if entry != 0.0)
        return [number / first * entry for entry in self.held]

    def at(self, share: float) -> float:
        """Return the value at `share`, 0 to 1, of the way."""
        return number_at(self.low, self.high, self.log, share)

    def share(self, value: float) -> float:
        """Return how far along the way a value is."""
        return share_of(self.low, self.high, self.log, value)


@dataclass(frozen=True)
class Limit:
    """A value at which the loop becomes unstable, or stable again."""

    # key, value: what is changed, and to what
    key: str
    value: float
    upwards: bool  # whether it is unstable above it, rather than below it
    pole: Pole  # the pole that lies on the unit circle there

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers."""
        return {
            "key": self.key, "value": self.value, "unstable": "above" if self.upwards else "below",
            "frequency": self.pole.frequency, "part": self.pole.part,
        }  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """Two runs of the whole nonlinear loop beside the boundary, from the instant on, that begin a little apart."""

    values: dict[str, Value]  # what is changed, from the instant on
    # expected, seen: the rate of the linear loop's slowest pole, and that with which the two runs grow apart, 1/s;
    # infinite if one of them stops
    expected: float
    seen: float

    @property
    def agrees(self) -> bool:
        """Whether both say the same of its stability."""
        return (self.expected > 0.0) == (self.seen > 0.0)


# Values at which a range is looked at, before the limits between them are solved for.
LOOKS = 25
# And at how many values of the other key of a map it is looked at, before the map is given up.
FIRST_LOOKS = 7
# From so many values on a boundary is solved for by two processes: the second looks at the whole range once more.
SHARED = 8
# Tolerance of a limit, as a share of its range.
LIMIT_TOLERANCE = 1e-11
# Beside the boundary by this share whole runs are tried, for so many periods of the critical pole, and at least so many
# samples; they begin apart by this share of the force, in f_des. Where they are so many times that apart, they have
# grown apart: further on the loop is not linear. In each of two parts there must be so many periods. Below
# the last share of the whole an oscillation is not there.
BESIDE, PERIODS, LEAST_SAMPLES, KICK, FAR, FEWEST_PERIODS, NEGLIGIBLE = 0.1, 12.0, 100, 1e-6, 1e4, 2.0, 1e-4
# Of the rows of such a run the first quarter passes before the kick is over; in the middle of the rest, of them all.
KICKED, MIDDLE = 0.25, 0.625


class Stability:
    """The loops of a scenario with other numbers, about one motion.

    `at`: the instant, s; half of the duration if left out.
    `model`: the robot to use instead of loading `scenario.robot.model`.
    Raises ClosedLoopError as `linearise`.
    """

    def __init__(self, scenario: Scenario, at: float | None = None, *, model: RobotModel | None = None) -> None:
        self.scenario, self._model, self._cache = scenario, model, Cache()
        at = 0.5 * scenario.time.duration if at is None else at
        refuse_outside(scenario, at)
        self._problem = prepare(scenario, model)
        self._instant = instant_of(self._problem, at, model)
        self.base = loop_at(self._problem, self._instant)
        self._variants = cache(partial(Variants, scenario))
        self._moved: dict[str, Instant] = {}

    def changed(self, values: Mapping[str, Value]) -> Scenario:
        """Return the scenario with other numbers."""
        return self._variants(tuple(values)).scenario(tuple(values.values()))

    def loop(self, values: Mapping[str, Value]) -> LinearLoop:
        """Return the loop with other numbers, about the same motion."""
        if not values:
            return self.base
        return loop_at(*self._at(values))

    def _at(self, values: Mapping[str, Value]) -> tuple[Problem, Instant]:
        """Return the scenario with other numbers, and its state at the instant."""
        scenario = self.changed(values)
        problem = prepare(scenario, self._model, self._cache)
        instant = self._instant
        surface = scenario.compliance
        if surface != self.scenario.compliance:
            depth = 0.0 if isinstance(surface, Rigid) else surface.static_depth(max(instant.force, 0.0))
            place = repr([item for item in values.items() if not item[0].startswith("law.")])  # no law moves the tip
            if place not in self._moved:
                self._moved[place] = Here(problem, instant).moved(depth)
            instant = self._moved[place]
        return problem, instant

    def growth(self, values: Mapping[str, Value]) -> float:
        """Return the rate of the loop's slowest pole, 1/s: above 0 it is unstable."""
        loop = self.loop(values)
        return math.log(max(loop.radius, 1e-300)) / loop.dt

    def limits(
        self, over: Range, given: Mapping[str, Value] | None = None, looks: int = LOOKS,
        tolerance: float = LIMIT_TOLERANCE,
    ) -> tuple[list[Limit], str]:  # fmt: skip
        """Return every limit in a range, and why values of it are refused, "" if none is.

        Beyond a value that there can be no scenario with, the range ends. A value at which there is no linear loop, as
        where a drive is at its limit, is named, and the search goes on behind it.

        `looks`: at how many values the range is looked at: two limits between neighbours are not seen.
        """
        given = dict(given or {})
        shares = np.linspace(0.0, 1.0, looks)
        seen: list[tuple[float, float] | None] = []
        refused: dict[str, str] = {}

        def no_loop(error: SimulationError, share: float) -> None:
            refused.setdefault(str(error), f"{over.key} = {over.at(share):.4g}: {error}")

        for share in shares:
            try:
                seen.append((float(share), self.growth(given | {over.key: over.value(over.at(float(share)))})))
            except SimulationError as error:
                no_loop(error, float(share))
                seen.append(None)
            except ScenarioError as error:
                refused[str(error)] = str(error)
                if any(seen):
                    break
        if not any(seen):
            raise ScenarioError(next(iter(refused.values())))
        found = []
        for below, above in pairwise(seen):
            if below is None or above is None or (below[1] > 0.0) == (above[1] > 0.0):
                continue
            try:
                found.append(self._solved(over, given, below, above, tolerance))
            except SimulationError as error:
                no_loop(error, 0.5 * (below[0] + above[0]))
        return found, "; ".join(refused.values())

    def _solved(
        self, over: Range, given: Mapping[str, Value], below: tuple[float, float], above: tuple[float, float],
        tolerance: float,
    ) -> Limit:  # fmt: skip
        """Return the limit between two shares of a range, given with their growth, which has two signs."""
        known = dict((below, above))

        def growth(share: float) -> float:
            if share not in known:
                known[share] = self.growth({**given, over.key: over.value(over.at(share))})
            return known[share]

        share = float(brentq(growth, below[0], above[0], xtol=tolerance, rtol=tolerance))
        value = over.at(share)
        loop = self.loop({**given, over.key: over.value(value)})
        moving = [pole for pole in loop.poles() if not pole.at_rest]
        upwards = (above[1] > 0.0) == (over.high > over.low)
        return Limit(over.key, value, upwards, moving[0] if moving else loop.poles()[0])

    def boundary(
        self, over: Range, along: Range, points: int = 60, tolerance: float = LIMIT_TOLERANCE,
        stop: Callable[[], bool] = lambda: False,
    ) -> list[tuple[float, Limit]]:  # fmt: skip
        """Return the boundary over two keys: for values of `along`, the limits of `over`.

        At the first value the whole range is looked at; then each limit is followed from value to value, and the
        range is looked at again where one ends. If it can be, every other value is left to a second process. Where
        none of `FIRST_LOOKS` values over the whole way has a limit, the others are not looked at.

        `over`, `along`: the key that is solved for, and the one that is stepped along.
        `stop`: asked at each value of `along`: if it is true, what is found until then is returned.
        """
        shares = np.linspace(0.0, 1.0, points)
        first = shares[evenly(points, FIRST_LOOKS)]
        if not any(self._along(over, along, np.array([share]), tolerance, stop) for share in first):
            return []
        if points < SHARED or not possible():
            return self._along(over, along, shares, tolerance, stop)
        rest = Beside(lambda: self._along(over, along, shares[1::2], tolerance, stop))
        try:
            found = self._along(over, along, shares[::2], tolerance, stop)
            return found if stop() else sorted(found + rest.result(), key=lambda item: abs(item[0] - along.low))
        finally:
            rest.stop()

    def _along(
        self, over: Range, along: Range, shares: Array, tolerance: float, stop: Callable[[], bool]
    ) -> list[tuple[float, Limit]]:
        """Return the boundary at shares of the way of `along`; see `boundary`."""
        found: list[tuple[float, Limit]] = []
        last: list[float] = []
        width = 1.0 / LOOKS
        for share in shares:
            if stop():
                break
            value = along.at(float(share))
            given = {along.key: along.value(value)}
            now: list[Limit] = []
            for before in last:
                limit = self._followed(over, given, before, width, tolerance)
                if limit is None:
                    now = []
                    break
                now.append(limit)
            if not now:
                try:
                    now, _ = self.limits(over, given, tolerance=tolerance)
                except ClosedLoopError:
                    now = []
            last = [over.share(limit.value) for limit in now]
            found += [(value, limit) for limit in now]
        return found

    def _followed(
        self, over: Range, given: Mapping[str, Value], share: float, width: float, tolerance: float
    ) -> Limit | None:
        """Return the limit near a share of a range; None if there is none."""
        width *= 0.25
        for _ in range(4):
            ends = max(0.0, share - width), min(1.0, share + width)
            try:
                low, high = ((x, self.growth({**given, over.key: over.value(over.at(x))})) for x in ends)
                if (low[1] > 0.0) != (high[1] > 0.0):
                    return self._solved(over, given, low, high, tolerance)
            except ClosedLoopError:
                return None
            width *= 3.0
        return None

    def try_beside(self, limit: Limit, given: Mapping[str, Value] | None = None) -> list[Trial]:
        """Run the whole nonlinear loop on from the instant below and above a limit; see `Trial`.

        The linear loop beside it is that of the middle of these runs: on the way the arm's posture changes. Left out is
        what becomes stable or unstable by that, what the scenario may not be, what has no linear loop, and a pole too
        slow for what is left of the run.
        """
        trials = []
        for factor in (1.0 - BESIDE, 1.0 + BESIDE):
            values = {**(given or {}), limit.key: limit.value * factor}
            try:
                problem, instant = self._at(values)
                problem = of_fixed_steps(problem, self._model, self._cache)
                span = PERIODS / max(limit.pole.frequency, 1e-3)
                span = max(span, LEAST_SAMPLES * problem.h * max(problem.hold, 1))  # no further than the end
                rows = min(round(span / problem.h), problem.steps - round(instant.time / problem.h))
                middle, end = (
                    Stability(self.scenario, instant.time + share * rows * problem.h, model=self._model).growth(values)
                    for share in (MIDDLE, 1.0)
                )
                if not (self.growth(values) > 0.0) == (middle > 0.0) == (end > 0.0):
                    continue  # no whole run is needed
                seen = self._seen(problem, instant, limit.pole.frequency, rows)
                if not math.isnan(seen):
                    trials.append(Trial(values, middle, seen))
            except ClosedLoopError:  # beyond what the scenario may be, or without a linear loop
                continue
        return trials

    def _seen(self, problem: Problem, instant: Instant, frequency: float, rows: int) -> float:
        """Return the rate with which two runs grow apart that begin a little apart, 1/s.

        It is that of what oscillates at the pole's frequency, Hz, while both runs are near each other: modes that are
        slower and die out may be larger. NaN if too few periods are left of the run.
        """
        kick = KICK * max(1.0, abs(instant.force))
        with_it, without = (run_on(problem, instant, rows, size) for size in (kick, -kick))
        if min(with_it.size, without.size) < rows:
            return math.inf
        apart = with_it - without
        far = np.flatnonzero(np.abs(apart) > FAR * kick)
        if far.size:
            return math.log(FAR) / (far[0] * problem.h)
        kicked, apart = np.split(apart, [round(KICKED * rows)])
        half = apart.size // 2
        if frequency * half * problem.h < FEWEST_PERIODS:
            return math.nan
        parts = apart[:half], apart[half : 2 * half]
        window = np.hanning(half)
        wave = window * np.exp(-2j * np.pi * frequency * problem.h * np.arange(half)) / np.sum(window)
        early, late = (float(abs(wave @ detrend(part))) for part in parts)
        first, *whole = (float(np.sqrt(np.mean(part**2))) for part in (kicked, *parts))
        if whole[0] < NEGLIGIBLE * first:  # what is left is rounding
            early, late = first, whole[0]
        elif early < NEGLIGIBLE * whole[0]:
            early, late = whole
        if late == 0.0:
            return -math.inf
        return math.log(late / max(early, 1e-300)) / (half * problem.h)
