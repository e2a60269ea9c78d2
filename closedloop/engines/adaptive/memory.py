"""The loop's memory for an integrator that asks for any state at any instant, and the calls on it."""

from __future__ import annotations

import time as clock
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED
from closedloop.closure.solve import OK
from closedloop.control import Law
from closedloop.engines.adaptive.kernels import (
    DERIVE,
    GAUGE_IT,
    SET_OUT,
    evaluate_on_pinocchio,
    evaluate_with_more_on_pinocchio,
)
from closedloop.engines.adaptive.smooth import Stretch
from closedloop.engines.loops import PINOCCHIO, loop_for
from closedloop.engines.pinocchio import places_of
from closedloop.engines.problem import Problem
from closedloop.engines.user_law import checked_law
from closedloop.events.phases import (
    ARRIVING,
    BEGINNING,
    CLOSING,
    FAILED,
    IMPACT_LAW_WANTED,
    ROOM,
    ROOM_FOR_EVENTS,
    TERMS,
    TERMS_AND_LAW,
    TRANSITING,
)
from closedloop.events.table import EVENT_WIDTH
from closedloop.events.transitions import collide
from closedloop.jit.background import make_ready
from closedloop.jit.pointers import address_of
from closedloop.step.memory import (
    GAINED,
    H_STEP,
    HOLD,
    IN_STEP,
    MODE,
    MOVES,
    NEXT,
    NODE,
    PHASE,
    PROJECT,
    RIGID,
    RIGID_STICK,
    ROW,
    SAMPLED,
    START_POWER,
    STATUS,
    STEPS,
    STICK_SPEED,
    STICKING,
    SUPPLIED,
    TIME,
)
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
    k, state, numbers, w
        Constants, whole numbers, numbers, and the names of their parts, see `closedloop.step.memory`.
    hold : int
        Rows for which a sampled torque is held, 0: none.
    rows : (steps + 1, width) array
        The record.
    events : (M, EVENT_WIDTH) array
        The table of events, which grows as needed.
    """

    def __init__(self, problem: Problem, law: Law | None) -> None:
        robot, given = problem.robot, law is not None
        self.robot, self.n, self.h = robot, robot.n, problem.h
        self.k, self.state, self.numbers = problem.constants(), problem.state(given), problem.memory(given)
        self.state[STEPS] = -1  # it chooses its own, and they are short where slip turns fast
        self.w = problem.views(self.numbers, self.state)
        self.hold = int(self.state[HOLD])
        self.rows = np.zeros((problem.steps + 1, Row.of(robot.n).width))
        self.events = np.zeros((ROOM_FOR_EVENTS, EVENT_WIDTH))
        self._terms = robot.evaluator(self.w.q, self.w.v)
        self._given = None if law is None else checked_law(law, robot, self.w.q, self.w.v)
        self._machine: Callable[..., int] = loop_for(PINOCCHIO, problem.more)
        self._evaluate: Callable[..., int] = evaluate_with_more_on_pinocchio if problem.more else evaluate_on_pinocchio
        make_ready(self._machine, self._evaluate)
        self._table, self._tableau = problem.table, problem.integrator.tableau()
        # What is desired at the instant evaluated: a table of one row.
        self._wanted = problem.table[:1].copy()

    def put(self, y: Array) -> None:
        """Make y the state in the memory."""
        self.w.q[:], self.w.v[:], self.w.z[:] = y[: self.n], y[self.n : 2 * self.n], y[2 * self.n : -1]
        self.w.now[SUPPLIED] = y[-1]

    def get(self) -> Array:
        """Return a copy of the state in the memory."""
        return np.concatenate([self.w.q, self.w.v, self.w.z, self.w.now[SUPPLIED : SUPPLIED + 1]])

    def evaluate(self, t: float, y: Array, stretch: Stretch, use: int) -> None:
        """Evaluate law, friction, contact and Eq. 24 at y at the instant t, s.

        Parameters
        ----------
        t, y, stretch
            Instant, s, state, and the stretch in which the instant is.
        use : int
            DERIVE, SET_OUT, GAUGE_IT (the gauge is in now[GAUGE]) or RECORD (in row state[ROW]).

        Raises
        ------
        Stopped
            If there is no solution, or a law of one's own gives no torque.
        """
        self.put(y)
        self.wait(t, stretch)
        if self.state[SAMPLED] != 0:
            self._ask_law(min(t, float(np.nextafter(stretch.end, 0.0))))
        self._terms()
        status = self._evaluate(
            *self.robot.views, self.k, self.state, self.numbers, self._wanted, self._table, self.rows, use
        )
        if status != OK:
            raise Stopped(status)

    def wait(self, t: float, stretch: Stretch) -> None:
        """Set the clock, and what is desired, to the instant t, s, of the stretch."""
        self._wanted[0, :-1] = stretch.at(t)
        instant = min(t, max(stretch.start, stretch.end - BEFORE * self.h))
        # The table's spacing is such that its one row is the one for this instant.
        self.w.now[TIME], self.k[NODE] = instant, instant if instant > 0.0 else 1.0

    def rate(self, t: float, y: Array, stretch: Stretch) -> Array:
        """Return ẏ (2 n + k + 1,)."""
        self.evaluate(t, y, stretch, DERIVE)
        return np.concatenate([self.w.v, self.w.qdd, self.w.dz, self.w.now[START_POWER : START_POWER + 1]])

    def start(self) -> float:
        """Write the row of t = 0 with whatever happens there, as the machine does for steps of fixed length.

        Returns
        -------
        float
            The instant by the clock, s, from which on everything is compiled.
        """
        answer = TERMS_AND_LAW
        while self.state[ROW] == 0:
            self._serve(answer)
            answer = self._proceed()
        # The machine has set out on a step already.
        self.put(np.append(self.w.begin, self.w.now[SUPPLIED]))
        self.w.now[GAINED] = 0.0
        self._terms()
        self._evaluate(
            *self.robot.views, self.k, self.state, self.numbers, self._wanted, self._table, self.rows, SET_OUT
        )
        return clock.perf_counter()

    def begin(self, t: float) -> None:
        """Let the machine look at the contact at the state evaluated last, at t, s, and change its mode if it must."""
        self.w.now[TIME] = t
        self._work(BEGINNING)

    def happen(self, t: float, y: Array, stretch: Stretch) -> float:
        """Let the machine do what happens at y at t, s, and return the instant at which it did, s.

        Slip is followed down to STICK_SPEED. From there it takes some 1e-6 s to stop, in which its direction and the
        acceleration are constant but for 1e-12; the equations are not: in the last of it the direction is rounding.
        """
        self.evaluate(t, y, stretch, GAUGE_IT)
        w, rigid = self.w, self.state[STICKING] == RIGID_STICK and self.state[MODE] == PRESSED
        slip = w.u[1:]
        if rigid and 0.0 < np.hypot(*slip) <= 2.0 * self.k[STICK_SPEED] and w.now[RIGID] > 0.0:
            braking = -(w.A[1:] @ w.qdd + w.drift_c[1:])
            left = float(slip @ braking) / float(braking @ braking)
            if left > 0.0:
                t += left
                mean = w.v + 0.5 * left * w.qdd
                self.evaluate(t, self.get() + left * np.concatenate([mean, w.qdd, w.dz, [0.0]]), stretch, GAUGE_IT)
        w.now[TIME] = t
        self._work(TRANSITING)
        return t

    def closed(self, y: Array) -> Array:
        """Return the state put back on the closure, if the scenario has a projection and the tip is on the surface."""
        if self.state[PROJECT] == 0 or self.state[MODE] == FREE:
            return y
        self.put(y)
        self.state[MOVES], self.state[NEXT] = 0, ARRIVING
        self._work(CLOSING)
        return self.get()

    def _work(self, phase: int) -> None:
        """Let the machine do all that is to be done at this instant, until it arrives at what it takes for a row."""
        sampled, row = int(self.state[SAMPLED]), int(self.state[ROW])
        self.state[PHASE], self.state[ROW], self.state[IN_STEP] = phase, 1, 0
        self.k[H_STEP] = self.w.now[TIME]
        answer = TERMS  # the torque has been evaluated
        while self.state[PHASE] != ARRIVING:
            self._serve(answer)
            answer = self._proceed()
        self.state[SAMPLED], self.state[ROW], self.k[H_STEP] = sampled, row, self.h

    def _serve(self, answer: int) -> None:
        """Do what the machine asks for."""
        if answer == ROOM:
            self.events = np.vstack([self.events, np.zeros_like(self.events)])
        elif answer == IMPACT_LAW_WANTED:
            collide(self.k, self.state, self.numbers, self.n)
        else:
            if answer == TERMS_AND_LAW:
                self._ask_law(float(self.w.now[TIME]))
            self._terms()

    def _ask_law(self, t: float) -> None:
        """Evaluate a law of one's own, if there is one."""
        fault = self._given(t, self.w.torque) if self._given is not None else ""
        if fault:
            raise Stopped(OK, fault)

    def _proceed(self) -> int:
        places = places_of(
            self.robot.views, self.k, self.state, self.numbers, self._wanted, self._tableau, self.rows, self.events
        )
        answer = self._machine(address_of(places))
        if answer == FAILED:
            raise Stopped(int(self.state[STATUS]))
        return answer
