"""The loop's memory for an integrator that asks for any state at any instant, and the calls on it."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED
from closedloop.closure.solve import LAW_FAILED, OK
from closedloop.engines.adaptive.kernels import (
    DERIVE,
    EVENT_VALUE,
    SET_OUT,
    evaluate_on_pinocchio,
    evaluate_with_more_on_pinocchio,
)
from closedloop.engines.adaptive.smooth import Stretch
from closedloop.engines.loops import PINOCCHIO, loop_for
from closedloop.engines.pinocchio import addresses_of, set_events
from closedloop.engines.problem import Problem
from closedloop.engines.user_law import Law, UserLaw
from closedloop.errors import DivergenceError
from closedloop.events.phases import (
    ARRIVING,
    AT_EVENT,
    BEGINNING,
    FAILED,
    IMPACT_LAW_WANTED,
    PROJECTING,
    ROOM,
    ROOM_FOR_EVENTS,
    TERMS,
)
from closedloop.events.table import EVENT_WIDTH
from closedloop.events.transitions import collide
from closedloop.jit.background import make_ready
from closedloop.jit.pointers import address_of
from closedloop.step.memory import RIGID_STICK
from closedloop.step.record_row import Row

Array = NDArray[np.float64]

# Nearer to the end of a stretch than this share of a row, the law's clock stands still: it has not switched yet.
BEFORE = 1e-6


class Stopped(Exception):
    """A state that cannot be evaluated: a status of `closedloop.closure.solve`, or in words what is wrong."""

    def __init__(self, status: int, fault: str = "") -> None:
        super().__init__(fault)
        self.status, self.fault = status, fault


class Memory:
    """The loop's memory, and the calls on it. A state y is q, q̇, z and the energy supplied in one array (2 n + k +
    1,).

    Attributes
    ----------
    constants, state, w
        See `closedloop.step.memory`.
    hold : int
        Rows for which a sampled torque is held, 0: none.
    rows : (steps + 1, width) array
        The record.
    events : (M, EVENT_WIDTH) array
        The table of events, which grows as needed.
    """

    def __init__(self, problem: Problem, law: Law | None) -> None:
        robot = problem.robot
        self.robot, self.n, self.h = robot, robot.n, problem.h
        self.loop = problem.loop(own_law=law is not None)
        self.state, self.constants, self.w = self.loop
        self.user_law = None if law is None else UserLaw(law, self.loop)
        (self.user_law.connect if self.user_law else partial(problem.connect, self.loop))()
        self.state.steps = -1  # it chooses its own, and they are short where slip turns fast
        self.hold = int(self.state.hold)
        self.rows = np.zeros((problem.steps + 1, Row.count(robot.n)))
        self.events = np.zeros((ROOM_FOR_EVENTS, EVENT_WIDTH))
        self._terms = robot.evaluator(self.w.q, self.w.v)
        more = problem.more or law is not None
        self._machine: Callable[..., int] = loop_for(PINOCCHIO, more)
        self._evaluate: Callable[..., int] = evaluate_with_more_on_pinocchio if more else evaluate_on_pinocchio
        make_ready(self._machine, self._evaluate)
        self._table, self._tableau = problem.table, problem.integrator.tableau()
        # What is desired at the instant evaluated: a table of one row.
        self._wanted = problem.table[:1].copy()
        self._addresses = addresses_of(robot.views, self.loop, self._wanted, self._tableau, self.rows, self.events)

    def put(self, y: Array) -> None:
        """Make y the state in the memory."""
        self.w.q[:], self.w.v[:], self.w.z[:] = y[: self.n], y[self.n : 2 * self.n], y[2 * self.n : -1]
        self.w.supplied = y[-1]

    def get(self) -> Array:
        """Return a copy of the state in the memory."""
        return np.concatenate([self.w.q, self.w.v, self.w.z, [self.w.supplied]])

    def evaluate(self, t: float, y: Array, stretch: Stretch, use: int) -> None:
        """Evaluate law, friction, contact and Eq. 24 at y at the instant t, s.

        Parameters
        ----------
        t, y, stretch
            Instant, s, state, and the stretch in which the instant is.
        use : int
            DERIVE, SET_OUT, EVENT_VALUE (the event function is in w.event_value) or RECORD (in row state.row).

        Raises
        ------
        Stopped
            If there is no solution, or a law of one's own gives no torque.
        """
        self.put(y)
        self.wait(t, stretch)
        self._evaluate_for(use)

    def wait(self, t: float, stretch: Stretch) -> None:
        """Set the clock, and what is desired, to the instant t, s, of the stretch."""
        self._wanted[0, :-1] = stretch.at(t)
        instant = min(t, max(stretch.start, stretch.end - BEFORE * self.h))
        # The table's spacing is such that its one row is the one for this instant.
        self.w.time, self.constants.node = instant, instant if instant > 0.0 else 1.0

    def rate(self, t: float, y: Array, stretch: Stretch) -> Array:
        """Return ẏ (2 n + k + 1,)."""
        self.evaluate(t, y, stretch, DERIVE)
        return np.concatenate([self.w.v, self.w.qdd, self.w.dz, [self.w.start_power]])

    def start(self) -> float:
        """Write the row of t = 0 with whatever happens there, as the machine does for steps of fixed length.

        Returns
        -------
        float
            The instant by the clock, s, from which on everything is compiled.
        """
        answer = TERMS
        while self.state.row == 0:
            self._serve(answer)
            answer = self._proceed()
        # The machine has set out on a step already.
        self.put(np.append(self.w.begin, self.w.supplied))
        self.w.gained = 0.0
        self._evaluate_for(SET_OUT)
        return clock.perf_counter()

    def begin(self, t: float) -> None:
        """Let the machine look at the contact at the state evaluated last, at t, s, and change its mode if it must."""
        self.w.time = t
        self._work(BEGINNING)

    def happen(self, t: float, y: Array, stretch: Stretch) -> float:
        """Let the machine do what happens at y at t, s, and return the instant at which it did, s.

        Slip is followed down to STICK_SPEED. From there it takes some 1e-6 s to stop, in which its direction and the
        acceleration are constant but for 1e-12; the equations are not: in the last of it the direction is rounding.
        """
        self.evaluate(t, y, stretch, EVENT_VALUE)
        w, rigid = self.w, self.state.sticking == RIGID_STICK and self.state.mode == PRESSED
        slip = w.u[1:]
        if rigid and 0.0 < np.hypot(*slip) <= 2.0 * self.constants.stick_speed and w.rigid_force > 0.0:
            braking = -(w.A[1:] @ w.qdd + w.drift_c[1:])
            left = float(slip @ braking) / float(braking @ braking)
            if left > 0.0:
                t += left
                mean = w.v + 0.5 * left * w.qdd
                self.evaluate(t, self.get() + left * np.concatenate([mean, w.qdd, w.dz, [0.0]]), stretch, EVENT_VALUE)
        w.time = t
        self._work(AT_EVENT)
        return t

    def closed(self, y: Array) -> Array:
        """Return the state put back on the closure, if the scenario has a projection and the tip is on the surface."""
        if self.state.project == 0 or self.state.mode == FREE:
            return y
        self.put(y)
        self.state.moves, self.state.next_phase = 0, ARRIVING
        self._work(PROJECTING)
        return self.get()

    def _work(self, phase: int) -> None:
        """Let the machine do all that is to be done at this instant, until it arrives at what it takes for a row."""
        sampled, row = int(self.state.sampled), int(self.state.row)
        self.state.phase, self.state.row, self.state.events_in_step = phase, 1, 0
        self.constants.h = self.w.time
        answer = TERMS  # the torque has been evaluated
        while self.state.phase != ARRIVING:
            self._serve(answer)
            answer = self._proceed()
        self.state.sampled, self.state.row, self.constants.h = sampled, row, self.h

    def _serve(self, answer: int) -> None:
        """Do what the machine asks for."""
        if answer == ROOM:
            self.events = np.vstack([self.events, np.zeros_like(self.events)])
            set_events(self._addresses, self.events)
        elif answer == IMPACT_LAW_WANTED:
            collide(self.loop.address)
        else:
            self._terms()

    def _evaluate_for(self, use: int) -> None:
        """Evaluate the state in the memory."""
        self._terms()
        self._check(self._evaluate(address_of(self._addresses.memory), self._table, use))

    def _proceed(self) -> int:
        answer = self._machine(address_of(self._addresses.memory))
        if answer == FAILED:
            self._check(int(self.state.status))
        return answer

    def _check(self, status: int) -> None:
        """Refuse to go on with a status other than OK."""
        if status == LAW_FAILED and self.user_law is not None:
            error = self.user_law.failure()
            if isinstance(error, DivergenceError):  # no number: a shorter step may do
                raise Stopped(OK, self.user_law.fault)
            raise error
        if status != OK:
            raise Stopped(status)
