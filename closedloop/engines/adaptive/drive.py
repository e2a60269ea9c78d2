"""Stretches, steps, events and rows: a problem run by scipy's DOP853."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853, Radau

from closedloop.closure.contact_force import FREE
from closedloop.closure.solve import OK
from closedloop.engines.adaptive.crossing import first_crossing
from closedloop.engines.adaptive.kernels import BEGIN_SUBSTEP, EVENT_VALUE, RECORD
from closedloop.engines.adaptive.memory import Memory, Stopped
from closedloop.engines.adaptive.slow import KEPT, PLAIN, SETTLED, STIFF, jacobian, manner_of, tolerance_for
from closedloop.engines.adaptive.smooth import Stretch, jumps, stretch_from
from closedloop.engines.failures import failure_of, interrupted, when
from closedloop.engines.problem import Problem
from closedloop.engines.user_law import Law
from closedloop.errors import DivergenceError, InterruptedRunError, LawError, SimulationError
from closedloop.events.phases import INSTANT, SHALLOW
from closedloop.step.memory import RIGID_STICK, SMOOTH, State
from closedloop.step.record_row import complete_record, rows_there

Array = NDArray[np.float64]

# Joint positions and velocities are of the order of one: of a smaller one, this share of the tolerance is enough.
ABSOLUTE = 0.1
# The first step, as a share of the time between rows, from where it may grow tenfold a step, and the longest step, s.
FIRST, LONGEST = 0.01, 0.1
# What the implicit scheme is told of the tolerance at first, and ends Newton's method by: at 1e-2 of the true one.
STIFF_RTOL = 1e-4
# A step in which a state cannot be evaluated is tried again, ever shorter, down to this, s.
SHORTEST = 1e-13
# So many steps without a row, or so many in so little time, s, are no progress.
MOST_STEPS = 100_000
STALL_STEPS, STALL_TIME = 500, 5e-7
# What is left of the force at a liftoff is rounding if it is gone so much later, s.
LATE = 1e-12

STALLED = (
    "the step of the adaptive integrator has shrunk to nothing: the motion has no smooth continuation here; look for a "
    "torque that jumps with the state, or take an integrator of fixed step"
)


def run_adaptive(
    problem: Problem, law: Law | None, report: Callable[[int, int], None], keep_interrupted: bool = False
) -> tuple[Array, Array, SimulationError | None, float]:
    """Run the problem to its end, or to where it cannot go on; see `closedloop.simulation.simulate.run_loop`."""
    journey = _Journey(problem, law, report)
    memory, steps = journey.memory, problem.steps
    failure: SimulationError | None = None
    began = clock.perf_counter()
    try:
        report(0, steps)
        began = journey.start()
        journey.go()
        report(steps, steps)
        complete_record(memory.loop.address, memory.rows, journey.row)
    except Stopped as stop:
        t = journey.time
        if stop.fault:
            failure = DivergenceError(f"{when(t)}: {stop.fault}", t)
        else:
            failure = failure_of(stop.status, t, problem.robot, problem, law, memory.w.q, memory.w.v)
    except LawError as error:
        failure = error
    except KeyboardInterrupt as stop:
        if not keep_interrupted:
            raise
        failure = interrupted(stop, journey.time)
    seconds = clock.perf_counter() - began
    done = journey.row
    if isinstance(failure, InterruptedRunError):
        done = rows_there(memory.state, done, problem.robot.n)
    complete_record(memory.loop.address, memory.rows, done)
    return memory.rows[:done], memory.events[: int(memory.state.events)], failure, seconds


class _Journey:
    """How far a run has come: `time`, s, the state y (2 n + k + 1,) there, and `row`, the next to be recorded."""

    def __init__(self, problem: Problem, law: Law | None, report: Callable[[int, int], None]) -> None:
        self.problem, self.report = problem, report
        self.memory = Memory(problem, law)
        sticking = self.memory.state.sticking
        self.rubs = sticking != SMOOTH
        self.turns = self.memory.state.unilateral != 0 or sticking == RIGID_STICK
        self.instants = problem.h * np.arange(problem.steps + 1, dtype=np.float64)
        self.row, self.time, self.y = 0, 0.0, self.memory.get()
        self.tolerance = cast(float, problem.tolerance)
        self.next_step, self.steps_since_row, self.looked = FIRST * problem.h, 0, 0.0
        self.manner = PLAIN
        others = [problem.pd_start + 1e-9 * problem.h]
        if self.memory.hold:
            others += self.instants[:: self.memory.hold].tolist()
        elif law is not None or problem.scenario.law.force_feedback != 0.0 or problem.sensor.sampled:
            # At a row the force is measured; and whatever a law of one's own does at an instant, it does at a row.
            others += self.instants.tolist()
        bounds = jumps(problem.wanted, np.array(others), self.instants)
        self.bounds = np.append(bounds, bounds[-1] + problem.h)

    def start(self) -> float:
        """Record the row of t = 0, and return the instant by the clock, s, from which on everything is compiled."""
        began = self.memory.start()
        self.row, self.y = 1, self.memory.get()
        return began

    def go(self) -> None:
        """Go from t = 0 to the end."""
        stretch = self.stretch()
        while True:
            self.begin(stretch)
            if self.row > self.problem.steps:
                return
            self.advance(stretch)
            if self.time >= stretch.end:
                stretch = self.stretch()

    def stretch(self) -> Stretch:
        """Return the stretch that begins here."""
        following = int(np.searchsorted(self.bounds, self.time, side="right"))
        return stretch_from(self.problem.wanted, self.time, float(self.bounds[following]))

    def begin(self, stretch: Stretch) -> None:
        """Look at the contact, and record a row that is due, at the beginning of a stretch or after an event."""
        memory, i = self.memory, self.row
        hold = memory.hold
        due = self.instants[i] <= self.time + INSTANT
        memory.state.sampled = hold == 0 or (due and i % hold == 0)
        self.check_stage(stretch)
        if self.turns:
            memory.begin(self.time)
            self.y = memory.get()
            self.check_stage(stretch)
        memory.state.sampled = hold == 0
        if due:
            self.y = memory.closed(self.y)
            self.record(self.y, self.time, stretch)

    def check_stage(self, stretch: Stretch) -> None:
        """Evaluate the state here, to set out from it, and choose how to go on."""
        memory, before = self.memory, self.manner
        memory.evaluate(self.time, self.y, stretch, BEGIN_SUBSTEP)
        if self.rubs:
            self.manner = manner_of(memory.w, memory.state, before)
            if (self.manner == KEPT) != (before == KEPT):
                memory.w.straight_speed = math.inf if self.manner == KEPT else 0.0
                memory.evaluate(self.time, self.y, stretch, BEGIN_SUBSTEP)

    def advance(self, stretch: Stretch) -> None:
        """Go on to the end of the stretch, or to just after the next event."""
        while self.time < stretch.end:
            manner, solver = self.manner, self.solver(stretch)
            while solver.status == "running":
                if self.rubs:
                    self.check_stage(stretch)
                    if self.manner != manner:
                        break
                    self.allow(solver)
                self.step(solver)
                within, length = solver.dense_output(), solver.t - self.time
                event = self.crossing(within, length, stretch) if self.turns else None
                grown = self.grown(within, length if event is None else event, stretch) if manner == KEPT else None
                if grown is not None:
                    self.record_until(self.time + grown, within, stretch)
                    self.time, self.next_step = self.time + grown, grown
                    self.y = within(self.time)
                    break
                self.record_until(self.time + (length if event is None else event), within, stretch)
                if event is not None:
                    self.happen(within, event, stretch)
                    return
                self.time, self.y = solver.t, solver.y
                closed = self.memory.closed(self.y)
                if closed is not self.y:
                    self.y = closed
                    break  # the solver starts anew from there

    def solver(self, stretch: Stretch) -> Any:
        """Return scipy's solver, ready to step from here."""

        def rate(t: float, y: Array) -> Array:
            return self.memory.rate(t, y, stretch)

        scheme: Any = Radau if self.manner == STIFF else DOP853
        more = {"jac": lambda t, y: jacobian(rate, t, y, self.memory.w), "rtol": STIFF_RTOL} if scheme is Radau else {}
        solver = scheme(
            rate, self.time, self.y, stretch.end, max_step=LONGEST,
            first_step=min(self.next_step, stretch.end - self.time), **more,
        )  # fmt: skip
        self.allow(solver)
        return solver

    def allow(self, solver: Any) -> None:
        """Tell the solver which error its steps may make."""
        # Set here, because scipy would take no relative tolerance below 2e-14.
        solver.rtol = tolerance_for(self.memory.w, self.manner, self.tolerance)
        solver.atol = np.full(self.y.size, ABSOLUTE * solver.rtol)
        solver.atol[-1] = np.inf  # the energy supplied is a sum over the motion, and does not choose its steps

    def step(self, solver: Any) -> None:
        """Take one step of the solver, as long as its error allows and as every state on the way can be evaluated."""
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
            stalled, self.looked = stalled or self.time - self.looked < STALL_TIME, self.time
        if stalled:
            raise Stopped(OK, STALLED)
        # The end of a stretch may have cut the step short.
        self.next_step = max(solver.h_abs, self.next_step) if solver.status == "finished" else solver.h_abs

    def grown(self, within: Callable[[float], Array], length: float, stretch: Stretch) -> float | None:
        """Return how long after the beginning of the step slip has a direction of its own, s, None if not yet."""
        memory, begin = self.memory, self.time

        def short(after: float) -> float:
            memory.evaluate(begin + after, within(begin + after), stretch, EVENT_VALUE)
            return SETTLED - float(np.hypot(*memory.w.u[1:]))

        return first_crossing(short, length)

    def crossing(self, within: Callable[[float], Array], length: float, stretch: Stretch) -> float | None:
        """Return how long after the beginning of the step the next event is, s, None if there is none in it."""
        memory, begin = self.memory, self.time
        w, state = memory.w, memory.state

        def value(name: str) -> Callable[[float], float]:
            def at(after: float) -> float:
                memory.evaluate(begin + after, within(begin + after), stretch, EVENT_VALUE)
                return float(getattr(w, name))

            return at

        if state.mode != FREE:
            return first_crossing(value("event_value"), length)
        # A tip that has been let go rises with the cube of time at first, no faster than errors do.
        leaving = max(SHALLOW, 10.0 * self.tolerance)
        event = first_crossing(value("event_value"), length, SHALLOW if state.risen != 0 else leaving, value("rate"))
        if event is None and value("event_value")(length) > leaving:
            state.risen = 1
        return event

    def happen(self, within: Callable[[float], Array], event: float, stretch: Stretch) -> None:
        """Let the event happen, and stand just after it."""
        memory, begin, later = self.memory, self.time, 0.0
        before = State(memory.state.memory.copy()), memory.w.memory.copy()
        while True:
            self.time = begin + event + later
            self.time = memory.happen(self.time, within(self.time), stretch)
            if before[0].mode == FREE or later > LATE or not self.refused(before[0]):
                break
            # The force is zero but for rounding, and the surface does not let go yet: it will an instant later.
            later = max(2.0 * later, float(np.spacing(self.time)))
            memory.state.memory[:], memory.w.memory[:] = before[0].memory, before[1]
        self.y = memory.get()

    def refused(self, before: State) -> bool:
        """Whether the machine found nothing to do, or let the tip go and took it back."""
        state = self.memory.state
        return bool(state.mode == before.mode and state.events == before.events)

    def record_until(self, end: float, within: Callable[[float], Array], stretch: Stretch) -> None:
        """Record the rows of the step before `end`, s."""
        while self.row <= self.problem.steps and self.instants[self.row] < end - INSTANT:
            t = float(self.instants[self.row])
            self.record(self.memory.closed(within(t)), t, stretch)

    def record(self, y: Array, t: float, stretch: Stretch) -> None:
        """Record the next row: the state, and what acts in it."""
        self.memory.state.row = self.row
        self.memory.evaluate(t, y, stretch, RECORD)
        self.row, self.steps_since_row = self.row + 1, 0
        if self.row % 100 == 0:
            self.report(self.row - 1, self.problem.steps)
