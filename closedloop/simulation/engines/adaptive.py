"""The adaptive integrator of high order: the reference for integrators of fixed step.

scipy's DOP853 integrates each interval on which the right-hand side is smooth, with steps chosen by `time.tolerance`.
Law, contact and Eq. 24 are those of `closedloop.loop.step.evaluate`. Inside a step the state is the solver's dense
output: events are located on it, and rows are taken from it, with force and acceleration evaluated again at the row's
state. Events are applied by `closedloop.loop.events`, as though they were at a row; so is the projection, where the
scenario has one, at every step and every row.

In slow slip dry friction makes the equation of motion stiff. Dry friction μ|f| against a slip u turns the direction of
u at the rate

    λ = μ|f| (S_11 + S_22)/|u|

towards the direction in which the contact accelerates, S its mobility. Just after break-away λ is unbounded: where
static friction goes over into kinetic without a jump, |u| = j t²/2 with j the rate of the applied acceleration, and an
explicit scheme, whose steps are a few 1/λ, needs some μ|f| S/(3 j t₀) of them from t₀ on: 10⁶, if t₀ is where u exceeds
rounding. The solution is smooth: the direction follows the applied force. So

    FIXED_DIRECTION  up to the speed SETTLED, friction of the tip acts against the direction of break-away. The slip
                     turns by no more than 1e-5 rad in that time, with an effect below 1e-14 m/s. That of contacts of
                     links points to where the slip goes (`closedloop.mechanics.contacts.turning`)
    IMPLICIT         from there on, as long as λ is large and slip changes slowly in 1/λ: Radau IIA of order five
                     (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.8, as in scipy)
    EXPLICIT         everywhere else: DOP853

A tip that is braked to rest has a large λ too, but briefly: the speed falls as fast as λ grows, and the explicit scheme
needs a step or two for each halving of it.
"""

import math
import time as clock
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.integrate import DOP853, Radau

from closedloop.base.arrays import Array
from closedloop.base.errors import DivergenceError, InterruptedRunError, LawError, SimulationError
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.proceed import BEGIN_STEP, EVENT_VALUE, RECORD
from closedloop.loop.step.memory import RIGID_STICK, SMOOTH, State, Work
from closedloop.loop.step.record_row import complete_record, rows_there
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.limits import BREAKING_AWAY, CLOSED, INSTANT, ITERATIONS, OUTPACED, STICK_SPEED
from closedloop.simulation.engines.adaptive_parts import Interval, Memory, Stopped, first_crossing, interval_from, jumps
from closedloop.simulation.engines.failures import failure_of, interrupted, when
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law

stops_slip: Any = interpreted(stops_slipping)
Rate = Callable[[float, Array], Array]

EXPLICIT, IMPLICIT, FIXED_DIRECTION = range(3)

# Slip faster than this, m/s, has a well-defined direction: the rounding of a velocity is 1e-7 of it.
SETTLED = 1e-9
# From this λ on, 1/s, an explicit step of a few 1/λ is shorter than accuracy requires; slip changes slowly if by less
# than this share of itself in 1/λ.
STIFF_RATE, SLOW_CHANGE = 2e4, 0.1
# Tolerance of the slip in a step, relative to the slip itself: of its direction, rad.
DIRECTION_ERROR = 1e-4


class Slip(NamedTuple):
    """A contact that slides, at the state evaluated last."""

    speed: float  # |u|, m/s; of contacts of links no less than that at which friction is all against the slip
    turning: float  # λ |u|, m/s²
    gaining: float  # |d|u|/dt|, m/s²
    rows: Array  # (2, n), u = G q̇
    rises: bool = False  # whether friction rises with the slip, so that slips that differ little have like friction


def slips(w: Work, state: State) -> list[Slip]:
    """Return the contacts whose dry friction turns a slip: the tip while it is alone, else those of links with it."""
    if state.coupled == 0:
        if state.friction.sticking != RIGID_STICK or state.mode != PRESSED:
            return []
        friction, tip = float(np.hypot(*w.friction.c) * abs(w.tip.F[0])), w.tip
        return [_slip(tip.u[1:], friction, tip.S[1, 1] + tip.S[2, 2], tip.A[1:], tip.A[1:] @ w.qdd + tip.drift_c[1:])]
    links, c = w.kept["contacts"]
    found = []
    for i in range(int(links.joints)):
        t = slice(3 * i + 1, 3 * i + 3)
        if c.mode[i] == PRESSED and stops_slip(c, i) and c.friction.bound[i] == 0.0:
            mobility, rows, shared = c.S[i, 1, 1] + c.S[i, 2, 2], c.G[t], float(c.friction.shared[i])
            friction = shared * abs(c.F[3 * i]) or float(np.hypot(*c.F[t]))
            slip = _slip(c.u[t], friction, mobility, rows, rows @ w.qdd + c.drift[t])
            # What friction is against is the slip after a time, or it rises with the slip.
            least = STICK_SPEED if shared > 0.0 else max(SETTLED, BREAKING_AWAY * slip.turning)
            found.append(slip._replace(speed=max(slip.speed, least), rises=shared > 0.0))
    return found


def _slip(u: Array, friction: float, mobility: float, rows: Array, acceleration: Array) -> Slip:
    speed = float(np.hypot(*u))
    return Slip(speed, friction * mobility, abs(float(u @ acceleration)) / max(speed, 1e-300), rows)


def choose_scheme(sliding: list[Slip], before: int) -> int:
    """Return the scheme for the next step, from the state evaluated last; `before` is the scheme of the last step.

    The implicit scheme ends at a λ four times smaller than that at which it begins, so that the two do not alternate.
    """
    ease = 4.0 if before == IMPLICIT else 1.0
    for slip in sliding:
        if slip.speed < 0.99 * SETTLED:  # not at it, where the step that has come so far ends
            return FIXED_DIRECTION
        if ease * slip.turning > STIFF_RATE * slip.speed and ease * SLOW_CHANGE * slip.turning > slip.gaining:
            return IMPLICIT
    return EXPLICIT


def jacobian(rate: Rate, t: float, y: Array, w: Work, state: State) -> Array:
    """Return ∂ẏ/∂y (N, N) by forward differences, with steps small against the slips, on which it depends most.

    `rate`: ẏ(t, y).
    `t`, `y`: instant, s, and state (N,).
    `w`, `state`: the memory in which `rate` writes the slips of the state evaluated.
    """
    n = w.q.shape[0]
    slope = rate(t, y)
    steps = np.maximum(1.0, np.abs(y)) * 1e-7
    for slip in slips(w, state):
        change = DIRECTION_ERROR * max(SETTLED, slip.speed)
        steps[n : 2 * n] = np.minimum(steps[n : 2 * n], change / np.maximum(np.hypot(*slip.rows), 1e-3))
        steps[:n] = np.minimum(steps[:n], change / max(float(np.max(np.abs(w.v))), 1e-3 * DIRECTION_ERROR))
    columns = []
    for j, step in enumerate(steps):
        near = y.copy()
        near[j] += step
        columns.append((rate(t, near) - slope) / (near[j] - y[j]))
    return np.stack(columns, axis=1)


# Absolute tolerance as a share of the relative one: joint positions and velocities are of the order of one.
ABSOLUTE = 0.1
# The first step, as a share of the time between rows, and the longest step, s.
FIRST, LONGEST = 0.01, 0.1
# Relative tolerance that the implicit scheme is created with; it sets the end of Newton's method, to 1e-2 of the true
# tolerance.
STIFF_RTOL = 1e-4
# A step in which a state cannot be evaluated is repeated with shorter length, down to this, s.
SHORTEST = 1e-13
# So many steps without a row, or so many in so short an interval, s, end the run.
MOST_STEPS = 100_000
STALL_STEPS, STALL_TIME = 500, 5e-7
# A force at liftoff that vanishes within this time, s, is rounding.
LATE = 1e-12

STALLED = (
    "the step of the adaptive integrator has become zero: the motion has no smooth continuation here; look for a "
    "torque that jumps with the state, or take an integrator of fixed step"
)


class AdaptiveRun:
    """The state of a run: `time`, s, y (2 n + k + 1,) at that time, and `row`, the next to be recorded."""

    def __init__(self, problem: Problem, law: Law | None, report: Callable[[int, int], None]) -> None:
        self.problem, self.report = problem, report
        self.memory = Memory(problem, law)
        state = self.memory.state
        sticking, several = state.friction.sticking, state.contacts.at != 0
        self.may_slide = sticking != SMOOTH
        ends = problem.surface.ends or several
        self.has_events = state.settings.unilateral != 0 or sticking == RIGID_STICK or ends
        self.instants = problem.h * np.arange(problem.steps + 1, dtype=np.float64)
        self.row, self.time, self.y = 0, 0.0, self.memory.get()
        self.tolerance = cast(float, problem.tolerance)
        self.next_step, self.steps_since_row, self.checked_at = FIRST * problem.h, 0, 0.0
        self.scheme, self.sliding = EXPLICIT, list[Slip]()
        others = [problem.pd_start + 1e-9 * problem.h]
        at_rows = law is not None or problem.scenario.law.force_feedback != 0.0
        if problem.sensor.sampled or problem.scenario.belief.normal_noise > 0.0 or (at_rows and not self.memory.hold):
            # The force is measured, and the normal drawn, at rows, and a user's law may change its output at rows.
            others += self.instants.tolist()
        elif self.memory.hold:
            others += self.instants[:: self.memory.hold].tolist()
        for force in problem.scenario.external_force or ():
            others += [force.start, force.end]
        bounds = jumps(problem.wanted, np.array(others), self.instants)
        self.bounds = np.append(bounds, bounds[-1] + problem.h)

    def start(self) -> float:
        """Record the row of t = 0, and return the clock's time, s, after which everything is compiled."""
        began = self.memory.start()
        self.row, self.y = 1, self.memory.get()
        return began

    def run_to_end(self) -> None:
        """Integrate from t = 0 to the end."""
        interval = self.interval()
        while True:
            self.begin(interval)
            if self.row > self.problem.steps:
                return
            self.advance(interval)
            if self.time >= interval.end:
                interval = self.interval()

    @property
    def has_dry_friction(self) -> bool:
        """Whether there is friction, at the tip or at contacts of links."""
        return self.may_slide or self.memory.state.coupled != 0

    def interval(self) -> Interval:
        """Return the interval that begins at the present time."""
        following = int(np.searchsorted(self.bounds, self.time, side="right"))
        return interval_from(self.problem.wanted, self.time, float(self.bounds[following]))

    def begin(self, interval: Interval) -> None:
        """Update the contact mode, and record a row that is due, at the beginning of an interval or after an event."""
        memory, i = self.memory, self.row
        hold = memory.hold
        due = self.instants[i] <= self.time + INSTANT
        memory.state.sampled = hold == 0 or (due and i % hold == 0)
        self.evaluate_here(interval)
        if self.has_events:
            memory.begin(self.time)
            self.y = memory.get()
            self.evaluate_here(interval)
        memory.state.sampled = hold == 0
        if due:
            self.y = memory.projected(self.y)
            self.record(self.y, self.time, interval)

    def evaluate_here(self, interval: Interval) -> None:
        """Evaluate the present state, to begin a step from it, and choose the scheme."""
        memory, before = self.memory, self.scheme
        memory.evaluate(self.time, self.y, interval, BEGIN_STEP)
        if self.has_dry_friction:
            self.sliding = slips(memory.w, memory.state)
            self.scheme = choose_scheme(self.sliding, before)
            if (self.scheme == FIXED_DIRECTION) != (before == FIXED_DIRECTION):
                memory.w.friction.straight_speed = math.inf if self.scheme == FIXED_DIRECTION else 0.0
                memory.evaluate(self.time, self.y, interval, BEGIN_STEP)

    def advance(self, interval: Interval) -> None:
        """Integrate to the end of the interval, or to just after the next event."""
        while self.time < interval.end:
            scheme, solver = self.scheme, self.solver(interval)
            while solver.status == "running":
                if self.has_dry_friction:
                    self.evaluate_here(interval)
                    if self.scheme != scheme:
                        break
                    self.set_tolerance(solver)
                try:
                    self.step(solver)
                except Stopped as stop:
                    if stop.fault != STALLED or self.memory.state.coupled == 0:
                        raise
                    self.give_up_modes(interval)
                    return
                within, length = solver.dense_output(), solver.t - self.time
                event = self.crossing(within, length, interval) if self.has_events else None
                settled = None
                if scheme == FIXED_DIRECTION:
                    settled = self.slip_settled(within, length if event is None else event, interval)
                if settled is not None:
                    self.record_until(self.time + settled, within, interval)
                    self.time, self.next_step = self.time + settled, settled
                    self.y = within(self.time)
                    break
                self.record_until(self.time + (length if event is None else event), within, interval)
                if event is not None:
                    self.apply_event(within, event, interval)
                    return
                self.time, self.y = solver.t, solver.y
                projected = self.memory.projected(self.y)
                if projected is not self.y:
                    self.y = projected
                    break  # the solver starts again from the projected state

    def solver(self, interval: Interval) -> Any:
        """Return scipy's solver, ready to step from the present state."""

        def rate(t: float, y: Array) -> Array:
            return self.memory.rate(t, y, interval)

        scheme: Any = Radau if self.scheme == IMPLICIT else DOP853
        options = (
            {"jac": lambda t, y: jacobian(rate, t, y, self.memory.w, self.memory.state), "rtol": STIFF_RTOL}
            if scheme is Radau
            else {}
        )
        solver = scheme(
            rate, self.time, self.y, interval.end, max_step=LONGEST,
            first_step=min(self.next_step, interval.end - self.time), **options,
        )  # fmt: skip
        self.set_tolerance(solver)
        return solver

    def set_tolerance(self, solver: Any) -> None:
        """Set the tolerances of the solver: those of the scenario, or less where slip is slow."""
        slow = [] if self.scheme == EXPLICIT else [max(SETTLED, slip.speed) for slip in self.sliding if not slip.rises]
        # Set here, because scipy would take no relative tolerance below 2e-14.
        solver.rtol = min([self.tolerance, *(DIRECTION_ERROR * speed for speed in slow)])
        solver.atol = np.full(self.y.size, ABSOLUTE * solver.rtol)
        solver.atol[-1] = np.inf  # the energy supplied does not choose the steps

    def step(self, solver: Any) -> None:
        """Take one step of the solver, shortened if a state in it cannot be evaluated."""
        self.steps_since_row += 1
        while True:
            try:
                solver.step()
                break
            except Stopped:
                room = min(solver.h_abs, solver.t_bound - solver.t)
                if room < SHORTEST:
                    raise
                solver.h_abs = 0.25 * room
                solver.LU_real = None  # the implicit scheme's, of the longer step
        stalled = solver.status == "failed" or self.steps_since_row > MOST_STEPS
        if self.steps_since_row % STALL_STEPS == 0:
            stalled, self.checked_at = stalled or self.time - self.checked_at < STALL_TIME, self.time
        if stalled:
            raise Stopped(OK, STALLED)
        # The end of an interval may have cut the step short.
        self.next_step = max(solver.h_abs, self.next_step) if solver.status == "finished" else solver.h_abs

    def slip_settled(self, within: Callable[[float], Array], length: float, interval: Interval) -> float | None:
        """Return when, s after the beginning of the step, slip exceeds `SETTLED`; None if it does not in this step."""
        memory, begin = self.memory, self.time

        def short(after: float) -> float:
            memory.evaluate(begin + after, within(begin + after), interval, EVENT_VALUE)
            return SETTLED - float(np.hypot(*memory.w.tip.u[1:]))

        return first_crossing(short, length)

    def crossing(self, within: Callable[[float], Array], length: float, interval: Interval) -> float | None:
        """Return when, s after the beginning of the step, the next event is; None if there is none in it."""
        memory, begin = self.memory, self.time
        w, state = memory.w, memory.state

        def value(name: str) -> Callable[[float], float]:
            def at(after: float) -> float:
                memory.evaluate(begin + after, within(begin + after), interval, EVENT_VALUE)
                return float(attrgetter(name)(w))

            return at

        # After liftoff the gap grows with the cube of time at first, no faster than the error.
        leaving, closes = max(CLOSED, 10.0 * self.tolerance), None
        if state.contacts.entry != 0 and state.coupled == 0:
            closes = first_crossing(value("contacts.margin"), length)
            length = length if closes is None else closes
        if state.mode != FREE or state.coupled != 0:
            event = first_crossing(value("search.value"), length)
            return closes if event is None else event
        event = first_crossing(
            value("search.value"), length, CLOSED if state.cleared != 0 else leaving, value("tip.rate")
        )
        if event is None and value("search.value")(length) > leaving:
            state.cleared = 1
            if state.settings.unilateral != 0 and w.tip.gap > leaving:
                state.past_edge = 0
        return closes if event is None else event

    def apply_event(self, within: Callable[[float], Array], event: float, interval: Interval) -> None:
        """Apply the event; the state is then that just after it."""
        memory, begin, later = self.memory, self.time, 0.0
        before, write_back = State(memory.state.memory.copy()), memory.copied()
        again = before.mode != FREE or before.contacts.entry != 0
        while True:
            self.time = begin + event + later
            self.time = memory.apply_event(self.time, within(self.time), interval)
            if not again or later > LATE or not self.refused(before):
                break
            # The force is zero but for rounding, and the tip has not lifted off: try a little later.
            later = max(2.0 * later, float(np.spacing(self.time)))
            write_back()
        self.y = memory.get()

    def give_up_modes(self, interval: Interval) -> None:
        """Let a step of impulses follow, as where modes change too often at one instant: no motion is smooth."""
        memory = self.memory
        memory.state.event.rapid, memory.w.last_event = 2 * ITERATIONS, self.time
        self.time = memory.apply_event(self.time, self.y, interval)
        self.y, self.steps_since_row, self.next_step = memory.get(), 0, FIRST * self.problem.h

    def refused(self, before: State) -> bool:
        """Whether the event handling left the mode as it was: no event, or a liftoff taken back."""
        state = self.memory.state
        return bool(state.mode == before.mode and state.event.rows == before.event.rows)

    def record_until(self, end: float, within: Callable[[float], Array], interval: Interval) -> None:
        """Record the rows of the step before `end`, s."""
        while self.row <= self.problem.steps and self.instants[self.row] < end - INSTANT:
            t = float(self.instants[self.row])
            self.record(self.memory.projected(within(t)), t, interval)

    def record(self, y: Array, t: float, interval: Interval) -> None:
        """Record the next row at the state y at t, s."""
        state = self.memory.state
        state.row, state.event.in_step = self.row, max(state.event.in_step - OUTPACED, 0)
        self.memory.evaluate(t, y, interval, RECORD)
        self.row, self.steps_since_row = self.row + 1, 0
        if self.row % 100 == 0:
            self.report(self.row - 1, self.problem.steps)


def run_adaptive(
    problem: Problem, law: Law | None, report: Callable[[int, int], None], keep_interrupted: bool = False
) -> tuple[Array, Array, SimulationError | None, float]:
    """Run the problem to its end, or to where it fails; see `closedloop.simulation.simulate.run_loop`."""
    run = AdaptiveRun(problem, law, report)
    memory, steps = run.memory, problem.steps
    failure: SimulationError | None = None
    began = clock.perf_counter()
    try:
        report(0, steps)
        began = run.start()
        run.run_to_end()
        report(steps, steps)
        complete_record(memory.loop.address, memory.rows, run.row)
    except Stopped as stop:
        t = run.time
        if stop.fault:
            failure = DivergenceError(f"{when(t)}: {stop.fault}", t)
        else:
            failure = failure_of(stop.status, t, problem.robot, problem, law, memory.w.q, memory.w.v)
    except LawError as error:
        failure = error
    except KeyboardInterrupt as stop:
        if not keep_interrupted:
            raise
        failure = interrupted(stop, run.time)
    finally:
        memory.driver.close()
    seconds = clock.perf_counter() - began
    done = run.row
    if isinstance(failure, InterruptedRunError):
        done = rows_there(memory.state, done, problem.robot.n)
    complete_record(memory.loop.address, memory.rows, done)
    return memory.rows[:done], memory.driver.answers.events[: int(memory.state.event.rows)], failure, seconds
