"""What an adaptive run evaluates at any instant: the reference, an event's instant, the loop's memory and its calls.

An integrator of high order must not step over a discontinuity, and needs the reference at any instant. So the run is
divided where the reference, its derivatives or the law are discontinuous. On each interval the desired motion and force
are interpolated at Chebyshev nodes inside it: at the end of an interval they have the left limit, at its beginning the
right limit.
"""

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebfit, chebpts1, chebval
from scipy.optimize import brentq, minimize_scalar

from closedloop.base.arrays import Array
from closedloop.base.errors import DivergenceError
from closedloop.control.reference.desired import Desired, Reference
from closedloop.control.reference.path import SineForceSection, StepForceSection, WaypointForceSection
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events import locate
from closedloop.loop.events.proceed import BEGIN_STEP, DERIVE, EVENT_VALUE, RECORD
from closedloop.loop.step.advance import turn_rate
from closedloop.loop.step.closed_loops import CLOSE, closed_loops
from closedloop.loop.step.external import BEGIN, END, SHARE
from closedloop.loop.step.memory import RIGID_STICK
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.closure.solve import LAW_FAILED, OK
from closedloop.simulation.engines.failures import raised_by_member
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.loop_calls import Driver, drive

# Intervals of a step at whose ends the event function is evaluated: enough for its extrema within a step of an
# integrator of order eight with a small tolerance.
SAMPLES = 8
# A minimum is searched for if the parabola through three samples falls below this share of the lowest.
DEEP = 0.3

EventFunction = Callable[[float], float]


def root(event_function: EventFunction, low: float, high: float) -> float:
    """Return where a continuous event function changes its sign between low and high, to rounding (Brent)."""
    return float(brentq(event_function, low, high, xtol=1e-17, rtol=9e-16, maxiter=200))


def first_crossing(
    event_function: EventFunction, length: float, floor: float = 0.0, rate: EventFunction | None = None
) -> float | None:
    """Return the first instant in 0 .. length at which the event function falls through zero, None if it does not.

    `event_function`: not negative at 0 but for rounding.
    `length`: of the step.
    `floor`: a value no further than this below zero is rounding.
    `rate`: derivative of the event function. With it a minimum between two samples is found, and a rise from zero that
        ends before the first sample.
    """
    times: list[float] = np.linspace(0.0, length, SAMPLES + 1).tolist()
    values = [event_function(t) for t in times]
    for t in _extremes(event_function, rate, times, values):
        times.append(t)
        values.append(event_function(t))
    order = np.argsort(times, kind="stable").tolist()
    before, above = 0.0, values[0]
    for i in order[1:]:
        if values[i] < -floor:
            return root(event_function, before, times[i]) if above > 0.0 else before
        before, above = times[i], values[i]
    return None


def _extremes(
    event_function: EventFunction, rate: EventFunction | None, times: list[float], values: list[float]
) -> list[float]:
    """Return instants between the samples at which the event function has extrema."""
    if rate is not None:
        slopes = [rate(t) for t in times]
        return [root(rate, times[i], times[i + 1]) for i in range(SAMPLES) if slopes[i] * slopes[i + 1] < 0.0]
    found = []
    for i in range(1, SAMPLES):
        left, here, right = values[i - 1 : i + 2]
        bend = left - 2.0 * here + right
        dips = here <= min(left, right) and bend > 0.0 and here > 0.0
        if dips and here - (right - left) ** 2 / (8.0 * bend) < DEEP * here:
            around = (times[i - 1], times[i + 1])
            lowest = minimize_scalar(event_function, bounds=around, method="bounded", options={"xatol": 1e-12})
            found.append(float(lowest.x))
    return found


NODES = 16
_NODES = chebpts1(NODES)
_DEGREES = np.arange(NODES, dtype=np.float64)
# Points of −1 .. 1 at which the interpolation error is checked, and its bounds, relative to 1 or to the value. Halving
# an interval divides the error by 2¹⁶; an error below ROUNDING that does not fall is rounding. Two instants nearer than
# that, relative to 1 s or to themselves, are one: i·h and a decimal number differ by rounding.
_CHECKS = np.array([-0.995, -0.3, 0.55, 0.999])
MISFIT, ROUNDING = 1e-13, 1e-10
MOST_HALVINGS = 50


@dataclass(frozen=True)
class Interval:
    """The reference from `start` to `end`, s: coefficients (NODES, 2 n + 10) of Chebyshev polynomials."""

    start: float
    end: float
    coefficients: Array

    def at(self, t: float) -> Array:
        """Return the row of `Desired.table` (2 n + 10,) at an instant of the interval, s."""
        x = (2.0 * (t - self.start)) / (self.end - self.start) - 1.0
        # T_k(x) = cos(k arccos x); `chebval` takes ten times as long, at every evaluation.
        return np.cos(_DEGREES * math.acos(min(1.0, max(-1.0, x)))) @ self.coefficients


def interval_from(wanted: Desired, start: float, end: float) -> Interval:
    """Return the interval from `start` to `end`, s, or a shorter one on which the polynomial is accurate."""
    worst = math.inf
    for _ in range(MOST_HALVINGS):
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        values = wanted.table(middle + half * np.concatenate([_NODES, _CHECKS]))
        coefficients: Any = chebfit(_NODES, values[:NODES], NODES - 1)
        interval = Interval(start, end, coefficients)
        fitted = chebval(_CHECKS, coefficients).T
        off = float(np.max(np.abs(fitted - values[NODES:]) / (1.0 + np.abs(values[NODES:]))))
        if off <= MISFIT or (off <= ROUNDING and off > 0.5 * worst):
            break
        worst, end = off, middle
    return interval


def jumps(wanted: Desired, others: Array, rows: Array) -> Array:
    """Return the instants between which the right-hand side is smooth, s, increasing.

    `wanted`: its knots, the ends of the segments of the tip's path, and the corners of the force profile.
    `others`: further instants, s.
    `rows` (N,): instants of the recorded rows, s, the first and the last of which bound the run; a discontinuity that
        differs from one of them by rounding is set to it.
    """
    segments = [x for segment in wanted.tip.segments for x in (segment.start, segment.stop)]
    instants = np.concatenate([rows[[0, -1]], wanted.joints.times, segments, _force_jumps(wanted), others])
    instants = instants[(instants >= rows[0]) & (instants <= rows[-1])]
    nearest = rows[np.clip(np.round(instants / (rows[1] - rows[0])), 0, rows.size - 1).astype(np.int64)]
    same = np.abs(instants - nearest) <= ROUNDING * np.maximum(1.0, instants)
    instants = np.unique(np.where(same, nearest, instants))
    apart = np.diff(instants, prepend=-1.0) > ROUNDING * np.maximum(1.0, instants)
    return instants[apart]


def _force_jumps(wanted: Desired) -> list[float]:
    profile = wanted.profile
    if isinstance(profile, StepForceSection):
        return [profile.at]
    if isinstance(profile, SineForceSection):
        return [profile.start]
    if isinstance(profile, WaypointForceSection):
        return list(profile.times)
    return []


# Within this share of a row before the instant from which the PD part of the paper's law acts, the law's time stays at
# that instant: it does not act yet.
BEFORE = 1e-6

rate_of_turn: Any = interpreted(turn_rate)


class Stopped(Exception):
    """A state that cannot be evaluated: a status of `closedloop.mechanics.closure.solve`, or in words what is wrong."""

    def __init__(self, status: int, fault: str = "") -> None:
        super().__init__(fault)
        self.status, self.fault = status, fault


class Memory:
    """The loop's memory, and the calls on it; a state y (2 n + k + 1,) is q, q̇, z and the energy supplied.

    `constants`, `state`, `w`: see `closedloop.loop.step.memory`.
    `hold`, int: rows for which a sampled torque is held, 0: none.
    `rows`, (steps + 1, width) array: the record.
    `driver`, Driver: what steps the loop.
    """

    def __init__(self, problem: Problem, law: Law | None) -> None:
        robot, self._problem = problem.robot, problem
        self.robot, self.n, self.h = robot, robot.n, problem.h
        self.rows = np.zeros((problem.steps + 1, problem.row_width))
        # The reference at the instant evaluated: a table of one row.
        self._wanted = problem.table[:1].copy()
        self.driver = Driver(problem, self.rows, law=law, table=self._wanted)
        self.loop = self.driver.loop
        self.state, self.constants, self.w = self.loop
        self.state.settings.adaptive, self.state.settings.nodes_per_step = 1, 0  # there is one row of the table
        self.hold = int(self.state.settings.hold)

    def put(self, y: Array) -> None:
        """Make y the state in the memory, moved to the nearest one that closes the loops if there are any."""
        self.w.q[:], self.w.v[:], self.w.z[:] = y[: self.n], y[self.n : 2 * self.n], y[2 * self.n : -1]
        self.w.supply.energy = y[-1]
        if self.state.loops.entry != 0:  # rows that depend on others do so only where the loops are closed
            self._check(closed_loops(int(self.state.loops.at), CLOSE))

    def get(self) -> Array:
        """Return a copy of the state in the memory."""
        return np.concatenate([self.w.q, self.w.v, self.w.z, [self.w.supply.energy]])

    def evaluate(self, t: float, y: Array, interval: Interval, use: int) -> None:
        """Evaluate law, friction, contact and Eq. 24 at y at the instant t, s.

        `use`: DERIVE, BEGIN_STEP, EVENT_VALUE (the event function is in w.search.value) or RECORD (in row state.row).
        Raises Stopped if there is no solution, or a user's law returns no torque.
        """
        self._wanted[0, : Reference.count(self._problem.robot.n)] = interval.at(t)
        instant, begins = t, self._problem.pd_start
        if interval.start < begins <= interval.end + BEFORE * self.h:
            instant = min(t, max(interval.start, interval.end - BEFORE * self.h))
        if "external" in self.w.kept:
            span, middle = self.w.kept["external"].rows.value, 0.5 * (interval.start + interval.end)
            span[:, SHARE] = (span[:, BEGIN] <= middle) & (middle < span[:, END])
        # The table's spacing is such that its one row is the one for this instant.
        self.w.time, self.constants.node = instant, instant if instant > 0.0 else 1.0
        self.put(y)
        self._evaluate_for(use)

    def rate(self, t: float, y: Array, interval: Interval) -> Array:
        """Return ẏ (2 n + k + 1,)."""
        self.evaluate(t, y, interval, DERIVE)
        return np.concatenate([self.position_rates(), self.w.qdd, self.w.dz, [self.w.supply.power]])

    def position_rates(self) -> Array:
        """Return the rates of the positions in the memory (n,): q̇, but for the rotation vectors of ball joints."""
        if self.state.settings.balls == 0:
            return self.w.v
        rates = self.w.v.copy()
        for j in self.robot.model.balls:
            rate_of_turn(*self.w.q[j : j + 3].tolist(), self.w.v, j, rates, j)
        return rates

    def start(self) -> float:
        """Record the row of t = 0 and apply the events there, as for steps of fixed length."""
        drive(self._call, self.driver.answers.give, lambda: bool(self.state.row == 0))
        # The loop has begun a step already: its beginning is the state at t = 0.
        self.w.time = self.w.start.time
        self.put(np.append(self.w.start.state, self.w.supply.energy))
        self.w.supply.work = 0.0
        self._evaluate_for(BEGIN_STEP)
        return clock.perf_counter()

    def begin(self, t: float) -> None:
        """Check the contact mode at the state evaluated last, at t, s, and change it if it is inconsistent."""
        self.w.time = t
        self._run_events(locate.AFTER_EVENT)

    def copied(self) -> Callable[[], None]:
        """Return what writes the memory as it is now back, contacts of links included."""
        written = self.loop.written
        copies = [memory.copy() for memory in written]

        def write_back() -> None:
            for memory, copy in zip(written, copies, strict=True):
                memory[:] = copy

        return write_back

    def apply_event(self, t: float, y: Array, interval: Interval) -> float:
        """Apply the event at y at t, s, and return the instant at which it was applied, s.

        Slip is integrated down to STICK_SPEED. From there it stops within some 1e-6 s, in which its direction and the
        acceleration are constant to 1e-12, so the stop is extrapolated; near rest the direction of slip is rounding.
        """
        self.evaluate(t, y, interval, EVENT_VALUE)
        w, alone = self.w, self.state.coupled == 0
        rigid = alone and self.state.friction.sticking == RIGID_STICK and self.state.mode == PRESSED
        slip = w.tip.u[1:]
        if rigid and 0.0 < np.hypot(*slip) <= 2.0 * self.constants.stick_speed and w.tip.rigid_force > 0.0:
            braking = -(w.tip.A[1:] @ w.qdd + w.tip.drift_c[1:])
            left = float(slip @ braking) / float(braking @ braking)
            if left > 0.0:
                t += left
                mean = w.v + 0.5 * left * w.qdd
                mean += self.position_rates() - w.v  # to the order of the rest
                self.evaluate(t, self.get() + left * np.concatenate([mean, w.qdd, w.dz, [0.0]]), interval, EVENT_VALUE)
        w.time = t
        self._run_events(locate.AT_EVENT)
        return t

    def projected(self, y: Array) -> Array:
        """Return the state with its loops closed, and projected onto the tip's closure if the scenario asks for it.

        The rotation vectors of ball joints come back to less than half a turn: beyond a whole one they have no rates.
        """
        for j in self.robot.model.balls:
            turn = float(np.linalg.norm(y[j : j + 3]))
            if turn > np.pi:
                y = y.copy()
                y[j : j + 3] *= 1.0 - 2.0 * np.pi / turn
        if self.state.loops.entry != 0:
            self.put(y)
            y = self.get()
        if self.state.settings.project == 0 or self.state.mode == FREE:
            return y
        self.put(y)
        self.state.projection.moves, self.state.projection.next_phase = 0, locate.STEP_END
        self._run_events(locate.PROJECTION)
        return self.get()

    def _run_events(self, phase: int) -> None:
        """Handle the events or the projection at this instant, from a phase on until the state could be recorded."""
        sampled, row = int(self.state.sampled), int(self.state.row)
        self.state.phase, self.state.row = phase, 1
        self.constants.h = self.w.time
        drive(self._call, self.driver.answers.give, lambda: bool(self.state.phase != locate.STEP_END))
        self.state.sampled, self.state.row, self.constants.h = sampled, row, self.h

    def _call(self, request: int) -> int:
        """Call the loop, with terms if they were requested."""
        answer = self.driver.once() if request == locate.TERMS else self.driver.again()
        if answer == locate.FAILED:
            self._check(int(self.state.status))
        return answer

    def _evaluate_for(self, use: int) -> None:
        phase, self.state.phase, self.state.query = int(self.state.phase), locate.QUERY, use
        if use == RECORD:
            drawn = slice(Reference.count(self._problem.robot.n), None)  # what the sensor draws
            self._wanted[0, drawn] = self._problem.table[self.state.row * self._problem.nodes, drawn]
        self._call(locate.TERMS)
        self._check(OK)
        self.state.phase = phase

    def _check(self, status: int) -> None:
        user_law = self.driver.user_law
        if user_law is not None and (status == LAW_FAILED or user_law.interruption is not None):
            error = user_law.failure()
            if isinstance(error, DivergenceError):  # no number: a shorter step may do
                raise Stopped(OK, user_law.fault)
            raise error
        if self.state.raised != 0:
            raise raised_by_member(self._problem, self.loop)
        if status != OK:
            raise Stopped(status)
