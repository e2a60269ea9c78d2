"""Derivatives of whole runs by dual numbers: one run gives the values and their derivatives in seven directions.

Everything that a run reads is an array of floats once it is prepared (`closedloop.simulation.engines.dual_loop`):
gains and masses, the posture, the path. Most numbers of a scenario enter linearly, some through an inverse kinematics
or a projection. Central differences of the preparation alone, without a run, are exact for the former; for the latter
Richardson's extrapolation takes them to rounding (`seeds_of`).

A step of the plain run calculates with dual numbers, see `closedloop.jit.dual8`; instants of events get their
derivatives by a Newton step at the instant found, so that what an event does to a derivative needs no formula. Two
plain runs, beside the scenario in a direction between all of those asked for, must have the same events, and the
derivatives must be the difference between them (`agreeing`). What does not is found by differences of runs.

Four feet of a box that slides have one normal force more than a rigid body determines, and two points that stick bear
any force along the line between them. Forces of least norm are smooth functions of the scenario while contacts last as
they are. Where a slip ends, or a time step finds the modes of the contacts, the solver's way decides which they are:
derivatives beyond it are less exact (`not_unique`).
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError
from closedloop.jit.background import make_ready, refused
from closedloop.jit.background import start as start_compiling
from closedloop.jit.cache_folder import why_not_kept
from closedloop.jit.dual import NotCompiledError, NotDualError
from closedloop.jit.kernel import jit_disabled, needs_compiling
from closedloop.loop.events.table import KINDS, STICK, TANGENTIAL_IMPACT, TIME_STEP, TIME_STEPPING, event_columns
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.mechanics.robot.tree import energies_of_rows
from closedloop.record.columns.record import POSITIONS
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES, Values
from closedloop.record.report.summary import shares_at
from closedloop.record.run import Run
from closedloop.scenario.tables import names_of
from closedloop.simulation.engines.dual_loop import DIRECTIONS, DualRun, Prepared, kernels, prepared, structure
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import columns_of_rows, positions_told
from closedloop.studies.gradient import differences
from closedloop.studies.gradient.differences import EVENTS, SHARE, Direction, Keys, Output, slices_of, values_of
from robot_models import RobotModel

# Two differences of steps that are a factor 2 apart agree to this share of themselves where a number enters linearly,
# or to this many roundings of what they are of: entries of one array may differ by orders of magnitude.
LINEAR, ROUNDINGS = 1e-9, 64.0


class Seeds(NamedTuple):
    """Derivatives of the prepared floats along one direction."""

    parts: list[Array | None]  # in the order of `Prepared.floats`; None where there is none
    linear: bool  # whether the number enters linearly
    # (Problem, Problem, float): the problems on both sides, and how far off along the direction each is
    beside: tuple[Problem, Problem, float]


def seeds_of(keys: Keys, direction: Direction, base: Prepared, model: RobotModel | None, cache: Cache) -> Seeds | None:
    """Return the derivatives along a direction; None if beside the scenario there is another sort of run, or none."""
    frame = structure(base)
    sides: list[list[list[Array]]] = [[], []]
    nearest: list[Problem] = [base.problem, base.problem]

    def sample(level: int) -> bool:
        for i, (side, sign) in enumerate(zip(sides, (-1.0, 1.0), strict=True)):
            try:
                scenario = keys.scenario_at({direction: sign * direction.step * 0.5**level})
                beside = prepared(prepare(scenario, model, cache))
            except ClosedLoopError:
                return False
            if structure(beside) != frame:
                return False
            side.append([array.copy() for array in beside.floats])
            nearest[i] = beside.problem
        return True

    def difference(level: int, i: int) -> Array:
        minus, plus = (side[level][i] for side in sides)
        same = (minus == plus) | np.isnan(minus) & np.isnan(plus)  # infinities too
        with np.errstate(invalid="ignore"):
            found: Array = np.where(same, 0.0, plus - minus) / (2.0 * direction.step * 0.5**level)
        return found

    if not (sample(0) and sample(1)):
        return None
    parts: list[Array | None] = []
    curved = []
    for i in range(len(base.floats)):
        wide, near = difference(0, i), difference(1, i)
        if not np.any(wide) and not np.any(near):
            parts.append(None)
            continue
        parts.append(wide)
        rounding = ROUNDINGS * np.finfo(float).eps * np.abs(np.nan_to_num(base.floats[i])) / direction.step
        if np.any(np.abs(wide - near) > LINEAR * np.abs(wide) + rounding):
            curved.append(i)
    if curved:
        if not all(sample(level) for level in range(2, differences.LEVELS)):
            return None
        for i in curved:
            at = np.nan_to_num(base.floats[i], posinf=0.0, neginf=0.0).ravel()
            minus, plus = (np.nan_to_num([each[i].ravel() for each in side], posinf=0.0, neginf=0.0) for side in sides)
            parts[i] = differences.two_sided(direction.step, at, minus, plus).value.reshape(base.floats[i].shape)
    return Seeds(parts, not curved, (nearest[0], nearest[1], direction.step * 0.5 ** (len(sides[0]) - 1)))


notices = logging.getLogger(__name__)

# The two plain runs are off the scenario by the first of these shares of the keys' sizes. A derivative must be that of
# their difference to a share, or to what of the difference is rounding. Where other events happen in them, or one does
# not agree because it bends or is all but rounding, so it may with the next two, if rounding is no more than a share of
# the difference there: else a smaller step would hide what the first has shown.
BESIDE, AGREE, NOISE, TELLS = (1e-5, 1e-7, 1e-4), 1e-4, 50.0, 1e-3
# The runs on both sides differ from the scenario's by as much, but for this share: else there is a kink.
KINKED = 1e-3


def agreeing(
    keys: Keys, run: Run, base: differences.Sample, outputs: Sequence[Output],
    rows: dict[Direction, list[Array | None]], there: list[bool], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None,
) -> list[bool]:  # fmt: skip
    """Return which outputs have the derivatives that two plain runs have between them."""
    weights = np.random.default_rng(0).uniform(0.5, 1.0, len(rows))
    slices, good = slices_of(outputs, run), np.zeros(len(outputs), dtype=bool)
    noise = NOISE * (differences.LOCATED if base.happened else differences.ROUNDING)

    whys = []
    for beside in BESIDE:
        changes = {d: beside * weight * d.step / SHARE for d, weight in zip(rows, weights, strict=True)}
        sides = [{d: sign * change for d, change in changes.items()} for sign in (-1.0, 1.0)]
        minus, plus = differences.samples(
            [partial(keys.scenario_at, side) for side in sides], partial(values_of, outputs), model, report, workers
        )
        whys.append(differences.difference(base, minus) or differences.difference(base, plus))
        if whys[-1]:
            continue
        for i, part in enumerate(slices):
            if there[i] and not good[i]:
                expected = sum((changes[d] * np.ravel(np.asarray(each[i])) for d, each in rows.items()), np.zeros(1))
                three = minus.values[part], base.values[part], plus.values[part]
                agrees, tells = changes_as(expected, *three, noise * rounded(run, outputs[i]))
                good[i] = agrees and (beside == BESIDE[0] or tells)
                if not good[i]:
                    notices.debug("no dual numbers: %s, %g beside: %s %s", outputs[i].name, beside, expected, three)
        if np.all(good | ~np.array(there)):
            break
    if all(whys):
        raise NotDualError(whys[-1])
    return [bool(each) for each in good]


def changes_as(expected: Array, minus: Array, at: Array, plus: Array, noise: float) -> tuple[bool, bool]:
    """Return whether a quantity changes by what is expected, and by as much on both sides; and whether it changes by
    well more than rounding.

    `minus`, `at`, `plus`: its values in the two runs and between them.
    `noise`: what is rounding.
    """
    change, both_differ = 0.5 * (plus - minus), np.abs(plus + minus - 2.0 * at)
    size = max(float(np.max(np.abs(each), initial=0.0)) for each in (change, expected))
    agrees = (
        np.all(np.isfinite(expected))
        and np.all(np.abs(change - expected) <= AGREE * size + noise)
        and np.all(both_differ <= KINKED * np.abs(expected) + AGREE * size + noise)
    )
    return bool(agrees), noise <= TELLS * size


def rounded(run: Run, output: Output) -> float:
    """Return how large what a quantity is made of is, the columns with its unit: their rounding is the quantity's."""
    sizes = [float(np.max(np.abs(output.of(run)), initial=np.finfo(float).tiny))]
    for name, column in run.columns.items():
        if column.dtype.kind == "f" and run.units(name) == output.units:
            sizes.append(float(np.max(np.abs(column[np.isfinite(column)]), initial=0.0)))
    return max(sizes)


# Events that such forces decide over.
DECIDED = (KINDS[STICK], KINDS[TIME_STEP], KINDS[TANGENTIAL_IMPACT])


# What follows is as exact as the runs beside a run tell, and they scatter by as much.
SHARE_OFF = 2.0 * AGREE


class NotUnique(NamedTuple):
    """The first event over which forces that are not unique decide: its instant, s, and what it is, in words."""

    instant: float
    event: str

    @property
    def problem(self) -> str:
        """What is to be said of derivatives."""
        return (
            f"not smooth at {self.instant:.6g} s ({self.event}): forces of contacts are not unique there; derivatives "
            f"of what follows may be off by {SHARE_OFF:g} of their size"
        )

    def follows(self, output: Output, run: Run) -> NDArray[np.bool_]:
        """Return which entries of an output, flat, are of what a run comes to at the event or later."""
        if not output.column:
            return np.ones(output.of(run).size, dtype=bool)
        column = np.asarray(getattr(run, output.column))
        times = run.event_time if output.column.startswith(EVENTS) else run.time
        late = np.broadcast_to((times >= self.instant).reshape(-1, *(1,) * (column.ndim - 1)), column.shape)
        as_it_is: Any = SimpleNamespace(**{output.column: late})
        return np.ravel(output.read(as_it_is))


def not_unique(run: Run) -> NotUnique | None:
    """Return the first event of a run that forces which are not unique decide over; None if there is none."""
    sections = run.scenario.contact
    if not sections:
        return None
    rough = np.array([c.compliance is None and (c.friction > 0.0 or c.friction_law is not None) for c in sections])
    seen = set[bytes]()
    for event in run.events:
        if event.contact > 0 and event.kind in DECIDED:
            row = int(np.searchsorted(run.time, event.time, side="right")) - 1
            modes = run.link_modes[row].tobytes()
            if modes not in seen and np.any(shares_at(run, row)[0] & rough):
                return NotUnique(event.time, f"{event.kind} of {names_of(sections)[event.contact - 1]}")
            seen.add(modes)
    return None


def grazes(run: Run) -> list[str]:
    """Return in words where a step does not tell whether an open contact of a link touches between two rows.

    With the gap's second derivative a, a parabola through three rows has its least value up to a h²/8 below the rows. A
    contact that is nearer than that may touch and part again, or not, and the run has no event. A tip's least gap is
    located in the run itself, and an integrator that chooses its steps finds all of them.
    """
    if not run.scenario.contact or len(run) < 3 or run.scenario.time.integrator in ADAPTIVE:
        return []
    before, at, after = run.link_gaps[:-2], run.link_gaps[1:-1], run.link_gaps[2:]
    bend, slope = before - 2.0 * at + after, 0.5 * (after - before)
    turns = (bend > 0.0) & (np.abs(slope) <= 0.5 * bend)
    least = at - 0.5 * slope * slope / np.where(turns, bend, 1.0)
    free = run.link_modes == FREE
    found = turns & (least <= 0.125 * bend) & free[:-2] & free[1:-1] & free[2:]
    names = names_of(run.scenario.contact)
    happened = [(event.contact - 1, event.time) for event in run.events]
    return [
        f"not smooth at {run.time[k + 1]:.6g} s: between two rows the gap of {names[i]} is {least[k, i]:.2g} m, and "
        "the step does not tell whether it touches; a grazing contact has no derivative"
        for k, i in np.argwhere(found)
        if not any(which == i and run.time[k] <= t <= run.time[k + 2] for which, t in happened)
    ]


DUALS, PREPARED, OF_COLUMNS = "dual numbers", "differences of the preparation", "differences of the columns"
# Values of the summary that are not counted in row by row: they follow from what the rows came to.
LATE = ("torque_limited_share", "torque_limited_at")
# A value that the rows are counted to must be the summary's to this share.
SAME = 1e-9
# Differences of the columns take steps of this share of those of differences of runs.
OF_STEP = 0.1


class Exact(NamedTuple):
    """The derivatives of outputs along directions that dual numbers give."""

    found: dict[Direction, differences.Along]  # of the outputs in `outputs`, one after the other
    outputs: list[Output]  # those that have all their derivatives, in order; there may be none
    problems: list[str]  # why some are less exact


NOTHING = Exact({}, [], [])


def exact(
    keys: Keys, run: Run, base: differences.Sample, outputs: Sequence[Output], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None = None,
) -> Exact:  # fmt: skip
    """Return what derivatives dual numbers give, of outputs whose values in the run are those of `base`."""
    if run.scenario.time.integrator in ADAPTIVE or jit_disabled():  # that loop is Python's
        return NOTHING
    try:
        return _exact(keys, run, base, outputs, model, report, workers)
    except (NotDualError, ClosedLoopError) as error:
        notices.debug("no dual numbers: %s", error)
        return NOTHING


# What numba cannot compile for dual numbers, such as a user's law that calls what they do not have, and why.
_refused: dict[tuple[Any, ...], str] = {}


def _exact(
    keys: Keys, run: Run, base: differences.Sample, outputs: Sequence[Output], model: RobotModel | None,
    report: Callable[[int, int], None], workers: int | None,
) -> Exact:  # fmt: skip
    start, cache = prepared(prepare(keys.scenario, model)), Cache()
    if start.problem.robot.moved:
        raise NotDualError("the memory of a [[mocap]] is of plain numbers")
    if start.problem.integrator.time_stepping or np.any(run.event_kind == TIME_STEPPING):
        raise NotDualError("the impulses of time stepping are found in rounds that end by their values")
    seeds = {d: seeds_of(keys, d, start, model, cache) for d in keys.directions}
    known = {d: each for d, each in seeds.items() if each is not None}
    if not known:
        return NOTHING
    rows: dict[Direction, list[Array | None]] = {}
    errors: dict[Direction, dict[int, Array]] = {}
    directions = list(known)
    constants = _tree_constants(start)
    called = tuple(kernels(start, any(each.parts[constants] is not None for each in known.values())))
    if called in _refused:
        raise NotDualError(_refused[called])
    missing = [each for each in called if needs_compiling(each)]
    if missing and not refused() and not why_not_kept():  # behind this process, or here if none may
        start_compiling(missing)
        raise NotDualError("the kernels of dual numbers are being compiled")
    make_ready(*called)
    for begin in range(0, len(directions), DIRECTIONS):
        some = directions[begin : begin + DIRECTIONS]
        try:
            duals = DualRun(start, [known[d].parts for d in some], [known[d].beside for d in some])
            went_on = duals.run()
        except NotCompiledError as fault:
            _refused[called] = str(fault)
            raise
        if not went_on or not _the_same(run, start, duals):
            raise NotDualError("the run of dual numbers is another")
        reader = _Reader(run, start, duals, outputs, known)
        for lane, d in enumerate(some, 1):
            rows[d] = reader.derivatives(lane, d)
        errors |= reader.errors
    there = [all(each[i] is not None for each in rows.values()) for i in range(len(outputs))]
    agree = agreeing(keys, run, base, outputs, rows, there, model, report, workers)
    kept = [i for i, good in enumerate(agree) if good]
    rounding = differences.LOCATED if base.happened else differences.ROUNDING
    slices = slices_of(outputs, run)
    found, less = {}, not_unique(run)
    late = np.concatenate([np.zeros(0, dtype=bool), *(less.follows(outputs[i], run) for i in kept if less)])
    for d, parts in rows.items():
        value = np.concatenate([np.zeros(0), *(np.ravel(np.asarray(parts[i])) for i in kept)])
        scale = np.concatenate([np.zeros(0), *(base.scale[slices[i]] for i in kept)])
        of_columns = [np.broadcast_to(errors.get(d, {}).get(i, 0.0), base.scale[slices[i]].shape) for i in kept]
        error = rounding * (np.abs(value) + scale * SHARE / d.step) + np.concatenate([np.zeros(0), *of_columns])
        if less:
            error[late] = np.maximum(error, SHARE_OFF * _largest(value, [outputs[i].of(run).size for i in kept]))[late]
        method = DUALS if known[d].linear else f"{DUALS}, {PREPARED}"
        methods = [f"{method}, {OF_COLUMNS}" if _by_columns(outputs[i], run) else method for i in kept]
        none = np.zeros(value.size, dtype=bool)
        found[d] = differences.Along(
            differences.Estimate(value, error, value, value, none), count=value.size, method=method, settled=True,
            methods=np.repeat(methods, [slices[i].stop - slices[i].start for i in kept]) if kept else None,
        )  # fmt: skip
    return Exact(found, [outputs[i] for i in kept], [less.problem] if less and np.any(late) else [])


def _largest(values: Array, sizes: Sequence[int]) -> Array:
    """Return for each of the values of some quantities, one after the other, the largest of the same quantity."""
    ends = np.cumsum(sizes)[:-1]
    return np.concatenate(
        [np.zeros(0), *(np.full_like(x, np.max(np.abs(x), initial=0.0)) for x in np.split(values, ends))]
    )


def _tree_constants(start: Prepared) -> int:
    """Return which of the prepared arrays are the constants of the robot."""
    return next(i for i, array in enumerate(start.floats) if array is start.tree.constants)


def _the_same(run: Run, start: Prepared, duals: DualRun) -> bool:
    """Whether the values of a run of dual numbers are those of the plain run, events too, but for rounding.

    They are to the last bit, but where a search ends with another Newton step for the derivatives, as that which closes
    the loops of a mechanism.
    """
    columns = columns_of_rows(start.problem, duals.rows[..., 0], duals.table[..., 0])
    columns |= positions_told(start.problem, columns) | event_columns(duals.events[..., 0])
    pairs = [(run.columns[name], columns[name]) for name in ("q", "v", "event_time")]
    return all(
        its.shape == mine.shape and bool(np.all(np.abs(its - mine) <= SAME * np.max(np.abs(its), initial=0.0)))
        for its, mine in pairs
    )


def _by_columns(output: Output, run: Run) -> bool:
    """Whether an output follows from the columns by more than being a part of them, or of what rows are counted to."""
    if output.column:
        others = ("potential_energy", *(POSITIONS if run.model.balls else ()))
        return output.column not in run.columns or output.column in others
    late = (*LATE, "energy_lost_to_friction") if run.scenario.contact else LATE
    return output.name in late or output.name not in (*MEASURES, *JOINT_MEASURES)


class _Reader:
    """Reads derivatives of outputs from a run of dual numbers."""

    def __init__(
        self, run: Run, start: Prepared, duals: DualRun, outputs: Sequence[Output], seeds: dict[Direction, Seeds]
    ) -> None:
        self._run, self._start, self._duals, self._outputs, self._seeds = run, start, duals, outputs, seeds
        self._values: Any = None
        self.errors: dict[Direction, dict[int, Array]] = {}
        if any(not each.column and not _by_columns(each, run) for each in outputs):
            self._values = Values(duals.values(), run.model.n)

    def derivatives(self, lane: int, direction: Direction) -> list[Array | None]:
        """Return the derivative of each output along a direction, None where there is none; see `errors`, too."""
        columns = columns_of_rows(self._start.problem, self._duals.rows[..., lane], self._duals.table[..., lane])
        columns |= event_columns(self._duals.events[..., lane])
        columns["time"] = np.zeros_like(columns["time"])
        as_they_are: Any = SimpleNamespace(**columns)
        late: list[int] = []
        found: list[Array | None] = []
        for i, output in enumerate(self._outputs):
            if _by_columns(output, self._run):
                late.append(i)
                found.append(None)
            elif output.column:
                found.append(np.asarray(output.read(as_they_are)))
            else:
                found.append(self._counted(output, lane))
        if late:
            mine = self.errors.setdefault(direction, {})
            some = self._by_columns([self._outputs[i] for i in late], columns, direction)
            for i, both in zip(late, some, strict=True):
                if both is not None:
                    found[i], mine[i] = both
        return found

    def _counted(self, output: Output, lane: int) -> Array | None:
        """Return the derivative of a value that the rows are counted to; None if the summary has another value."""
        both = np.asarray(getattr(self._values, output.name))
        value, derivative = both[..., 0], both[..., lane]
        its = output.of(self._run)
        rounding = NOISE * differences.ROUNDING * rounded(self._run, output)
        same = np.abs(value - its) <= SAME * np.maximum(np.abs(its), np.abs(value)) + rounding
        return np.array(derivative) if np.all(same) and np.all(np.isfinite(derivative)) else None

    def _by_columns(
        self, outputs: list[Output], columns: dict[str, NDArray[Any]], direction: Direction
    ) -> list[tuple[Array, Array] | None]:
        """Return the derivatives of what follows from the columns, by differences of them, and their errors."""
        run, problem = self._run, self._start.problem
        if self._seeds[direction].parts[_tree_constants(self._start)] is not None:  # the energies are of another arm
            return [None] * len(outputs)
        of_loop = columns_of_rows(problem, self._duals.rows[..., 0], self._duals.table[..., 0])

        def beside(change: float) -> Array:
            moved = {
                name: column + change * columns[name] if name in columns and column.dtype.kind == "f" else column
                for name, column in run.columns.items()
                if name not in POSITIONS
            }
            positions = {name: of_loop[name] + change * columns[name] for name in POSITIONS}
            moved["potential_energy"] = energies_of_rows(self._start.tree, positions["q"])
            moved |= positions | positions_told(problem, positions)
            made = replace(run, columns={name: moved[name] for name in run.columns})
            return values_of(outputs, made)

        step = OF_STEP * direction.step
        steps = step * 0.5 ** np.arange(differences.LEVELS)
        minus, plus = (np.array([beside(sign * each) for each in steps]) for sign in (-1.0, 1.0))
        estimate = differences.two_sided(step, beside(0.0), minus, plus)
        value = np.where(estimate.kink, np.nan, estimate.value)
        return [
            None if np.any(np.isnan(value[part])) else (value[part].reshape(each.of(run).shape), estimate.error[part])
            for each, part in zip(outputs, slices_of(outputs, run), strict=True)
        ]
