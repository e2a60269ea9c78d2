"""Derivatives of whole runs by differences, with Richardson's extrapolation.

Three steps h, h/2, h/4 on either side. Central differences have errors in h², h⁴ ..., one-sided ones in h, h², h³ ...;
the extrapolation removes all but the last. The estimate is by how much the last extrapolation changed the result. It is
that of the result before, so it is on the safe side.

A run is a smooth function of its scenario as long as the same events happen in the same order: they are located to
rounding. What is counted in rows is one as long as each event stays between the same two rows. So the steps are
shortened until both are so, and each quantity has the derivative of the table whose estimate of the error is smallest.
A direction in which other events happen on one side, however short the step, has one-sided derivatives alone.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import as_run, check_engine, run_loop
from closedloop.studies.gradient.quantities import Direction, Keys
from robot_models import RobotModel

# What `difference` says of runs that differ in nothing but that an event is between other rows.
PAST_A_ROW = "an event moves past a row"


class Happening(NamedTuple):
    """An event, without its instant."""

    kind: str
    contact: int
    row: int  # the last row at or before it


@dataclass(frozen=True)
class Sample:
    """What is kept of a run."""

    values: Array  # (M,): all quantities, one after the other; empty if it could not be run to its end
    happened: tuple[Happening, ...]  # its events, in order
    instants: tuple[float, ...]  # their instants, s
    why: str = ""  # why it could not be run to its end; "" if it could
    # (M,): of the run itself: the largest entry of the quantity that each is of
    scale: Array = field(default_factory=lambda: np.empty(0))


def simulated(scenario: Scenario, model: RobotModel | None, cache: Cache | None = None) -> Run:
    """Run a scenario on the compiled engine, or on Pinocchio's if its integrator chooses its steps."""
    engine = PINOCCHIO if scenario.time.integrator in ADAPTIVE else COMPILED
    check_engine(scenario, engine, None)
    problem = prepare(scenario, model, cache)
    rows, events, failure, seconds = run_loop(problem, engine=engine)
    run = as_run(
        problem, rows, events, seconds, engine, law=("scenario", ""), with_states=True,
        stopped=str(failure) if failure else None,
    )  # fmt: skip
    if failure is not None:
        failure.run = run
        raise failure
    return run


def sample(run: Run, read: Callable[[Run], Array]) -> Sample:
    """Return what is kept of a run."""
    step = run.scenario.time.step
    events = run.events
    happened = tuple(Happening(event.kind, event.contact, int(event.time / step * (1.0 + 1e-15))) for event in events)
    return Sample(read(run), happened, tuple(event.time for event in events))


def samples(
    scenarios: Sequence[Callable[[], Scenario]], read: Callable[[Run], Array], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None = None,
) -> list[Sample]:  # fmt: skip
    """Run scenarios side by side; one that cannot be, or stops, says why."""
    if not scenarios:
        return []
    found: list[Sample | None] = [None] * len(scenarios)
    done, shared = Done(), Cache()

    def one(cache: Cache, i: int) -> None:
        try:
            found[i] = sample(simulated(scenarios[i](), model, cache), read)
        except ClosedLoopError as error:
            found[i] = Sample(np.empty(0), (), (), str(error).splitlines()[0])
        done.add()

    side_by_side(
        one, len(scenarios), threads_for(COMPILED, workers), lambda: Cache(shared=shared),
        lambda: report(done.count, len(scenarios)), done,
    )  # fmt: skip
    return [each for each in found if each is not None]


def difference(base: Sample, other: Sample) -> str:
    """Return what happens in one run and not in the other, in words; "" if nothing does, `PAST_A_ROW` see there."""
    if other.why:
        return other.why
    for i, (mine, its) in enumerate(zip(base.happened, other.happened, strict=False)):
        if mine[:2] != its[:2]:
            return (
                f"event {i}, {mine.kind} at {base.instants[i]:.6g} s, becomes {its.kind} at {other.instants[i]:.6g} s"
            )
    here, there = len(base.happened), len(other.happened)
    if here > there:
        return f"event {there}, {base.happened[there].kind} at {base.instants[there]:.6g} s, no longer happens"
    if there > here:
        return f"{other.happened[here].kind} at {other.instants[here]:.6g} s happens besides"
    if base.values.shape != other.values.shape:
        return "there are other values"
    rows = ([each.row for each in run.happened] for run in (base, other))
    return "" if next(rows) == next(rows) else PAST_A_ROW


# Steps of one table, each half of the one before.
LEVELS = 3
# Two one-sided derivatives that differ by more than this share of the larger are of a kink, if it is also more than
# `SURE` times what their errors explain.
KINK, SURE = 1e-3, 20.0
# What a difference cannot see of a run's values, as a share of them: rounding, and with events that their instants are
# located to some 1e-12 s.
ROUNDING, LOCATED = 16.0 * np.finfo(float).eps, 1e3 * np.finfo(float).eps


@dataclass(frozen=True)
class Estimate:
    """Derivatives of M quantities along one direction."""

    # value, error (M,): the derivative, and the estimate of its error
    value: Array
    error: Array
    # below, above (M,): one-sided ones; NaN on a side that there is not
    below: Array
    above: Array
    kink: NDArray[np.bool_]  # (M,): whether they differ


def two_sided(h: float, at: Array, minus: Array, plus: Array, scatter: Array | None = None) -> Estimate:
    """Return the derivatives from values at 0, (M,), and at −h, −h/2, −h/4 and h, h/2, h/4, (3, M).

    The values scatter by `scatter`, (M,), and by `ROUNDING` of themselves if it is left out.
    """
    steps = h * 0.5 ** np.arange(LEVELS)[:, None]
    value, error = _extrapolated((plus - minus) / (2.0 * steps), 2)
    scatter = ROUNDING * np.abs(at) if scatter is None else scatter
    below, off_below = one_sided(-h, at, minus, scatter)
    above, off_above = one_sided(h, at, plus, scatter)
    apart = np.abs(above - below)
    kink = (apart > SURE * (off_below + off_above)) & (apart > KINK * np.maximum(np.abs(above), np.abs(below)))
    return Estimate(value, error + floor(h, scatter), below, above, kink)


def one_sided(h: float, at: Array, beside: Array, scatter: Array) -> tuple[Array, Array]:
    """Return the derivatives on the side of h, which may be negative, and the estimates of their errors, (M,)."""
    steps = h * 0.5 ** np.arange(LEVELS)[:, None]
    value, error = _extrapolated((beside - at) / steps, 1)
    return value, error + 2.0 * floor(h, scatter)


def floor(h: float, scatter: Array) -> Array:
    """Return what the scatter of the values alone makes of the smallest difference."""
    return scatter / (abs(h) * 0.5 ** (LEVELS - 1))


def _extrapolated(differences: Array, order: int) -> tuple[Array, Array]:
    """Return the limit of (3, M) differences whose errors have the powers order, 2 order ... of the step."""
    table = differences
    for k in range(1, LEVELS):
        before = table[-1]
        factor = 2.0 ** (order * k)
        table = (factor * table[1:] - table[:-1]) / (factor - 1.0)
    return table[0], np.abs(table[0] - before)


DIFFERENCES = "central differences, Richardson"
# Tables of one direction, and by how much each has shorter steps than the one before. Of a run with events the first is
# left out: at its steps events move past rows.
TABLES, SHORTER = 4, 16.0
# An estimate is good enough at this share of the derivative, or of the quantity's largest entry over the key's size.
ENOUGH = 1e-8
# Integrators that choose their steps choose others beside, so a run scatters: by so large a share of the largest entry
# of a quantity, of which the first is rounding, and the second a multiple of the tolerance. (1e-12 was seen at a
# tolerance of 1e-13.)
SCATTER, OF_TOLERANCE = 5e3 * float(np.finfo(float).eps), 3.0
# Where an event is at a row, however short the steps, a quantity that is counted in rows jumps: it has no derivative if
# the estimate of the error is more than this share.
AT_A_ROW = 1e-3
# A one-sided derivative whose estimate of the error is more than this share has no bound.
SETTLES = 0.02


class Part(NamedTuple):
    """Derivatives of some quantities along one direction."""

    # derivative, error, below, above (k,): NaN where there is none
    derivative: Array
    error: Array
    below: Array
    above: Array
    kink: NDArray[np.bool_]  # (k,): whether there is none because those below and above differ
    method: str  # how they were found


@dataclass
class Along:
    """What is known of one direction."""

    best: Estimate | None = None  # two-sided derivatives, the best of all tables, quantity by quantity
    at_a_row: Estimate | None = None  # the same of tables in which an event moves past a row
    # below, above (M,): one-sided derivatives and the estimates of their errors, where there are no two-sided ones
    below: tuple[Array, Array] | None = None
    above: tuple[Array, Array] | None = None
    why: str = ""  # why there are no two-sided ones
    count: int = 0  # number of quantities, M
    method: str = DIFFERENCES  # how they were found
    settled: bool = field(default=False, repr=False)  # whether they are known well enough
    methods: NDArray[np.str_] | None = None  # (M,): how each quantity was found, if not all in one way

    def part(self, some: slice) -> Part:
        """Return what is known of some of the quantities."""
        nothing = np.full(self.count, math.nan)
        if self.best is None:
            below, above = ((side[0] if side else nothing)[some] for side in (self.below, self.above))
            none = np.zeros(self.count, dtype=bool)
            return Part(nothing[some], nothing[some], below, above, none[some], self.method)
        best, kink = self.best, self.best.kink[some]
        value, error = (np.where(kink, math.nan, each[some]) for each in (best.value, best.error))
        method = self.method if self.methods is None or not kink.size else str(self.methods[some][0])
        return Part(value, error, best.below[some], best.above[some], kink, method)


def along(
    keys: Keys, directions: list[Direction], base: Sample, read: Callable[[Run], Array], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None = None,
) -> dict[Direction, Along]:  # fmt: skip
    """Return the derivatives of all quantities along each direction.

    `base`: the run itself.
    `read`: returns all quantities of a run, (M,).
    `report`: gets (runs done, runs in all) of the table at hand.
    """
    found = {direction: Along(count=base.values.size) for direction in directions}
    scatter = (LOCATED if base.happened else ROUNDING) * np.abs(base.values)
    if keys.scenario.time.integrator in ADAPTIVE and directions:
        scatter = max(SCATTER, OF_TOLERANCE * (prepare(keys.scenario, model).tolerance or 0.0)) * base.scale
    for table in range(1 if base.happened else 0, TABLES):
        todo = [direction for direction in directions if not found[direction].settled]
        if not todo:
            break
        steps = {d: d.step * SHORTER**-table for d in todo}
        points = [(d, sign * steps[d] * 0.5**level) for d in todo for sign in (-1.0, 1.0) for level in range(LEVELS)]
        ran = samples([partial(keys.scenario_at, {d: change}) for d, change in points], read, model, report, workers)
        for i, d in enumerate(todo):
            mine = ran[2 * LEVELS * i : 2 * LEVELS * (i + 1)]
            _take(found[d], steps[d], d.step, base, mine[:LEVELS], mine[LEVELS:], scatter)
    for d, known in found.items():
        natural = base.scale / (100.0 * d.step)
        known.below, known.above = (side and _bounded(side, natural) for side in (known.below, known.above))
        if known.best is None and known.at_a_row is not None:
            estimate = known.at_a_row
            jumps = estimate.error > AT_A_ROW * np.maximum(
                np.abs(estimate.value), np.abs(base.values) / (100.0 * d.step)
            )
            known.best = replace(estimate, kink=estimate.kink | jumps)
    return found


def _take(
    known: Along, h: float, size: float, base: Sample, minus: list[Sample], plus: list[Sample], scatter: Array
) -> None:
    """Take a table of runs, whose values scatter by `scatter`, into what is known of a direction."""
    whys = [_first_difference(base, side) for side in (minus, plus)]
    below, above = (
        np.array([each.values for each in side]) if why in ("", PAST_A_ROW) else None
        for side, why in zip((minus, plus), whys, strict=True)
    )
    if below is not None and above is not None:
        estimate = two_sided(h, base.values, below, above, scatter)
        if PAST_A_ROW in whys:
            known.at_a_row = estimate if known.at_a_row is None else better(known.at_a_row, estimate)
            return
        known.best = estimate if known.best is None else better(known.best, estimate)
        enough = ENOUGH * np.maximum(np.abs(known.best.value), base.scale / (100.0 * size))
        # Where half of the error is rounding, that of shorter steps is larger.
        enough = np.maximum(enough, 2.0 * floor(h, scatter))
        known.settled = bool(np.all((known.best.error <= enough) & ~known.best.kink))
        return
    known.why = " and ".join(
        f"{side} it, {why}" for side, why in zip(("below", "above"), whys, strict=True) if why not in ("", PAST_A_ROW)
    )
    if below is not None:
        known.below = _better_side(known.below, one_sided(-h, base.values, below, scatter))
    if above is not None:
        known.above = _better_side(known.above, one_sided(h, base.values, above, scatter))


def _first_difference(base: Sample, side: list[Sample]) -> str:
    whys = [why for each in side if (why := difference(base, each))]
    return next((why for why in whys if why != PAST_A_ROW), PAST_A_ROW if whys else "")


def better(one: Estimate, other: Estimate) -> Estimate:
    """Return the better of two estimates, quantity by quantity; the other is of shorter steps.

    A kink that shorter steps do not see is beside the point, not at it.
    """
    take = (other.error < one.error) | (one.kink & ~other.kink)
    parts = ("value", "error", "below", "above", "kink")
    return Estimate(*(np.where(take, getattr(other, part), getattr(one, part)) for part in parts))


def _bounded(side: tuple[Array, Array], natural: Array) -> tuple[Array, Array]:
    """Return one-sided derivatives, NaN where they have no bound, as that of a square root at 0: its differences grow.

    A derivative of a size that is natural to its quantity is `natural`, (M,).
    """
    value, error = side
    return np.where(error <= SETTLES * np.maximum(np.abs(value), natural), value, np.nan), error


def _better_side(known: tuple[Array, Array] | None, new: tuple[Array, Array]) -> tuple[Array, Array]:
    if known is None:
        return new
    take = new[1] < known[1]
    return np.where(take, new[0], known[0]), np.where(take, new[1], known[1])
