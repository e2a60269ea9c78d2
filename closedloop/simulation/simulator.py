"""A simulation that is driven from outside, step by step, and what it shows at an instant.

sim = cl.Simulator(cl.load_scenario("wam_slide"))
state = sim.reset()
while not sim.done:
    state = sim.step(my_controller(state))
run = sim.run()
"""

import math
import time as clock
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.loop.events.table import EventRow, event_columns
from closedloop.loop.step.record_row import ArmRow, Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.mechanics.surface.kinds.none import NoSurface
from closedloop.record.columns.record import Event, events_of
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.failures import interrupted
from closedloop.simulation.engines.law_source import law_digest
from closedloop.simulation.engines.loops import PINOCCHIO
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.loop_calls import Mark, Stepper
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import as_run, check_engine, law_name
from robot_models import RobotModel
from robot_models.coordinates import with_quaternions

MODE_NAMES = {FREE: "free", PRESSED: "pressed", STUCK: "stuck"}

_place = cache(Row.place)


class StepState:
    """The state at an instant, as `closedloop.Simulator` returns it: copies, which later steps do not change.

    `f`, `torque` and `acceleration` belong together. With the scenario's own law, or a user's, the torque is the law's
    at this instant. After a step with a torque from outside it is that torque, which has acted until this instant; the
    next one acts from here, and replaces it in the record.

    Arrays are read-only. Joint quantities are in rad, rad/s, rad/s² and N m (m, m/s, m/s² and N of a joint that
    slides), vectors in space in the base frame.

    Attributes
    ----------
    time : float
        Time since the start of the run, s.
    row : int
        The row of the record that is this instant's.
    measured : float
        The force sensor's reading as a control law has it at this instant, N: `closedloop.LawInput.f_measured`.
    """

    __slots__ = ("_events", "_n", "_reads", "_row", "_types", "measured", "row", "time")

    def __init__(
        self, time: float, row: int, n: int, recorded: Array, measured: float, events: Array | None,
        reads: bool = False, types: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        recorded.flags.writeable = False
        self.time, self.row, self.measured = time, row, measured
        self._n, self._row, self._events, self._reads, self._types = n, recorded, events, reads, types

    @property
    def recorded(self) -> Array:
        """The row of the record, as it is now: the columns of `closedloop.loop.step.record_row.Row` come first."""
        return self._row

    def _part(self, name: str) -> Array:
        return self._row[_place(name, self._n)]

    @property
    def q(self) -> Array:
        """Joint positions (nq,): (n,), but for joints that turn freely, see `robot_models.coordinates`."""
        return with_quaternions(self._part("q"), self._types)

    @property
    def v(self) -> Array:
        """Joint velocities (n,)."""
        return self._part("v")

    @property
    def measured_position(self) -> Array:
        """Joint positions as the encoders read them (n,), see docs/real_arm.md; without encoders the true ones."""
        return self._read("measured_position") if self._reads else self.q

    @property
    def measured_velocity(self) -> Array:
        """Joint velocities as the controller has them (n,); without encoders the true ones."""
        return self._read("measured_velocity") if self._reads else self.v

    def _read(self, name: str) -> Array:
        return self._row[Row.count(self._n) :][ArmRow.place(name, self._n)]

    @property
    def acceleration(self) -> Array:
        """Joint accelerations (n,)."""
        return self._part("acceleration")

    @property
    def torque(self) -> Array:
        """Torque Q on the joints (n,)."""
        return self._part("torque")

    @property
    def position(self) -> Array:
        """Tip position r (3,), m."""
        return self._part("position")

    @property
    def velocity(self) -> Array:
        """Tip velocity (3,), m/s."""
        return self._part("velocity")

    @property
    def f(self) -> float:
        """Contact force along the surface's normal, N; positive pushes the tip away."""
        return float(self._part("contact_force"))

    @property
    def contact_force(self) -> float:
        """The same as `f`, by the name of a run's column."""
        return self.f

    @property
    def f_measured(self) -> float:
        """The same as `measured`, by the name of a law's input."""
        return self.measured

    @property
    def measured_force(self) -> float:
        """The same as `measured`, by the name of a run's column."""
        return self.measured

    @property
    def normal(self) -> Array:
        """Unit normal of the surface at the tip (3,)."""
        return self._part("surface_normal")

    @property
    def friction_force(self) -> Array:
        """Tangential force of the surface on the tip (3,), N."""
        return self._part("friction_force")

    @property
    def gap(self) -> float:
        """Closure error e = n·r − d, m; off the surface the gap; inf without a surface."""
        gap = float(self._part("closure_error"))
        return gap if gap < 0.5 * NoSurface.distance else math.inf

    @property
    def gap_rate(self) -> float:
        """Time derivative of the gap, m/s; 0 without a surface."""
        return float(self._part("closure_rate")) if self.gap < math.inf else 0.0

    @property
    def mode(self) -> int:
        """0 free, 1 pressed (sliding or at rest), 2 stuck, as in `Run.mode`."""
        return int(self._part("mode"))

    # By the names of a run's columns and symbols.
    closure_error = e = gap
    r, n, Q, surface_normal = position, normal, torque, normal

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened to the contact since the state before, in order of time."""
        return events_of(event_columns(self._events)) if self._events is not None else ()

    def __repr__(self) -> str:
        what = ", ".join(event.kind for event in self.events)
        return (
            f"<StepState at {self.time:.6g} s: {MODE_NAMES[self.mode]}, f = {self.f:.6g} N, gap = {self.gap:.3g} m"
            f"{', ' if what else ''}{what}>"
        )


# Name of what drove a run, in the record: beside it that of a user's law, or "scenario".
FROM_OUTSIDE = "torque from outside"
# A time within this share of a step of a row is that row's.
NEAR = 1e-6
_OWN = object()


class _Now:
    """A row that has been recorded, and where the loop can go back to: replaced whole, so that Ctrl-C finds it so."""

    __slots__ = ("events", "mark", "row", "state")

    def __init__(self, mark: Mark, row: int, events: int, state: StepState) -> None:
        self.mark, self.row, self.events, self.state = mark, row, events, state


class SavedState:
    """The whole state of a `Simulator` at an instant, from `Simulator.save`, for `Simulator.restore`."""

    __slots__ = ("_batch", "_drivers", "_now", "_owner", "_stepper")

    def __init__(self, owner: "Simulator", stepper: Stepper, now: _Now, drivers: dict[str, str]) -> None:
        self._owner, self._stepper, self._now, self._drivers = owner, stepper, now, drivers
        self._batch = stepper.batch()

    def __repr__(self) -> str:
        return f"<SavedState at {self._now.state.time:.6g} s>"


class Simulator:
    """A simulation that the caller steps; its rows equal those of `closedloop.simulate` to the last bit.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`; its integrator has steps of fixed length.
    engine : "pinocchio" or "compiled"
        See `closedloop.simulate`.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario or the robot is at fault, as by `closedloop.simulate`, or if the integrator chooses its steps.
    """

    @arguments_checked()
    def __init__(self, scenario: Scenario, *, engine: str = PINOCCHIO, model: RobotModel | None = None) -> None:
        name = scenario.time.integrator
        if name in ADAPTIVE:
            raise ScenarioError(
                f"time.integrator = {name!r}: its steps do not end at the rows, so that an external torque cannot "
                f"act from a row on; use {', '.join(map(repr, INTEGRATORS))}, or closedloop.simulate"
            )
        check_engine(scenario, engine, None)
        self.problem = prepare(scenario, model)
        self._engine, self._n, self._h = engine, self.problem.robot.n, self.problem.h
        self._reads, self._types = scenario.reads_encoders, self.problem.robot.model.joint_types
        self._now: _Now | None = None
        self._failure: SimulationError | None = None
        self._drivers: dict[str, str] = {}  # names of what has driven the run, and digests of users' laws
        self._seconds = 0.0

    def reset(self) -> StepState:
        """Begin anew and return the state at t = 0, with the force and torque of the scenario's own law.

        Raises
        ------
        SimulationError
            If there is no solution at the start.
        """
        self._now, self._failure, self._seconds, self._drivers = None, None, 0.0, {}
        self._stepper = Stepper(self.problem, self._engine)
        # What drives: `_OWN`, a user's law, or None after a torque, which acts no further than its step, or Ctrl-C.
        self._driver: object = None
        self._stepper.let(None)
        try:
            self._to_row(None, 0)
        except SimulationError as error:
            error.run = self._run(self._stepper.rows_done, str(error))
            raise
        self._driver = _OWN
        return self.state

    @property
    def state(self) -> StepState:
        """The present state; before `reset` there is none."""
        if self._now is None:
            self.reset()
        assert self._now is not None
        return self._now.state

    @property
    def done(self) -> bool:
        """Whether the end of the scenario is reached, or the simulation failed."""
        return self._now is not None and (self._failure is not None or self._now.row == self.problem.steps)

    def step(self, torque: ArrayLike | None = None) -> StepState:
        """Advance by one step and return the state after it.

        Parameters
        ----------
        torque : (n,) array, optional
            Torque Q on the joints, N m (N of a joint that slides), that acts from the present state on and is held over
            the step, in place of the law's. None: the scenario's own law acts, as often as it says. The states of this
            law and of its compensation are integrated also while a torque from outside acts. A joint without a drive
            has no torque, see `closedloop.mechanics.loops.reactions`.

        Raises
        ------
        ValueError
            If the torque is not n finite numbers; nothing was stepped.
        SimulationError
            If the simulation cannot go on; its `run` holds the rows until then. After Ctrl-C it is an
            `InterruptedRunError`, and the simulation may be stepped on.
        """
        began = clock.perf_counter()
        now = self._now
        if now is None or self._failure is not None or now.row >= self.problem.steps:
            now = self._open()
        if torque is None:
            self._step(_OWN, now.events)
        else:
            self._step(None, now.events, torque=self._checked(torque))
        self._seconds += clock.perf_counter() - began
        assert self._now is not None
        return self._now.state

    def run_until(self, t: float, law: Law | None = None) -> StepState:
        """Step to the first row at t or later, and return the state there.

        Parameters
        ----------
        t : float
            Time, s, not before the present one nor after the end. At the present row nothing is done.
        law : callable, optional
            A user's law, as for `closedloop.simulate`, in place of the scenario's until then. It is evaluated as often
            as the scenario's law would be. If it has a `reset`, that is called first, unless the same law computed the
            step before.

        Raises
        ------
        ValueError
            If t is not between the present time and the end.
        ScenarioError
            If the compiled engine is to call a law that numba has not compiled.
        SimulationError
            As by `step`.
        """
        h, steps = self.problem.h, self.problem.steps
        present = self.state.time
        if not present - (1.0 - NEAR) * h < t <= (steps + NEAR) * h:
            raise ValueError(
                f"run_until: t = {t!r} s: must be between the present time, {present:.10g} s, and the end, "
                f"time.duration = {steps * h:.10g} s; reset() begins anew"
            )
        if law is not None:
            check_engine(self.problem.scenario, self._engine, law)
        last, driver = math.ceil(t / h - NEAR), _OWN if law is None else law
        if isinstance(law, type):
            law = law()
        began = clock.perf_counter()
        now = self._open() if last > self.state.row else self._now
        assert now is not None
        since = now.events
        try:
            for _ in range(now.row, last):
                since = self._step(driver, since, law)
        finally:
            self._stepper.release()
        self._seconds += clock.perf_counter() - began
        return self.state

    def save(self) -> SavedState:
        """Return the present state whole, to go on from it again: motion, contact, law, sensor and events so far.

        What a user's law keeps in its own attributes is not in it.
        """
        self._open()
        assert self._now is not None
        return SavedState(self, self._stepper, self._now, dict(self._drivers))

    def restore(self, saved: SavedState) -> StepState:
        """Go back to a state that `save` returned, as often as is wanted, and return it; also after `reset`.

        Raises
        ------
        ValueError
            If it is a state of another simulator.
        """
        if not isinstance(saved, SavedState) or saved._owner is not self:
            raise ValueError("restore: must be given what save() of this simulator returned")
        self._stepper, self._now, self._drivers = saved._stepper, saved._now, dict(saved._drivers)
        self._failure, self._driver = None, None
        self._stepper.put_batch(saved._batch)  # the next step goes back to the mark, which has the rest
        return self.state

    def run(self) -> Run:
        """Return the run so far, one row for each instant; before the end its `stopped` says where it is.

        The last row has the torque and the force of `state`. A failed simulation's run is that of its error.
        """
        state, now = self.state, self._now
        if self._failure is not None:
            assert isinstance(self._failure.run, Run)
            return self._failure.run
        assert now is not None
        if self._driver is None:  # the loop's memory may be in the middle of a step: record the row again
            self._stepper.back_to(now.mark)
            self._stepper.hold(state.torque)
            self._stepper.to_row()
        at_end = now.row == self.problem.steps
        return self._run(now.row + 1, None if at_end else f"at t = {state.time:.6g} s it was not stepped further")

    def latest(self, count: int) -> Run | None:
        """Return the latest rows as a run, at most `count`, while the simulation goes on in another thread.

        The present row is not among them, unless it is the first: the next torque records it anew. Condition numbers
        that are not computed yet are NaN. None where there is no row, or where the simulation begins anew meanwhile.
        """
        now, stepper = self._now, getattr(self, "_stepper", None)
        if now is None or stepper is None:
            return None
        stop = max(1, now.row)
        first = max(0, stop - count)
        rows, events = stepper.rows[first:stop].copy(), stepper.answers.events[: now.events].copy()
        after = self._now
        if after is None or after.row < now.row:
            return None
        conditions = rows[:, Row.place("kkt_condition", self._n)]
        conditions[conditions == 0.0] = np.nan
        since = events[:, EventRow.place("time")] >= self._h * first
        return as_run(
            self.problem, rows, events[since], self._seconds, self._engine, law=(FROM_OUTSIDE, ""), first=first
        )

    def _open(self) -> _Now:
        """Return where the simulation is, refusing one that is over."""
        if self._now is None:
            self.reset()
        now = self._now
        assert now is not None
        if self._failure is None and now.row < self.problem.steps:
            return now
        time = now.state.time
        where = f"failed: {self._failure}" if self._failure else f"is at its end, t = {time:.6g} s"
        raise SimulationError(f"the simulation {where}; reset() begins anew", time, self.run()) from self._failure

    def _checked(self, torque: ArrayLike) -> Array:
        n = self._n
        try:
            given = np.asarray(torque)
            if given.shape == (n,) and given.dtype.kind in "iuf" and all(map(math.isfinite, given.tolist())):
                return given if given.dtype == np.float64 else given.astype(np.float64)
        except (TypeError, ValueError):  # lists of different lengths
            pass
        raise ValueError(
            f"step: torque = {' '.join(str(torque).split())[:80]}: must be {n} finite numbers, one torque a joint, "
            f"({n},)"
        )

    def _step(self, driver: object, since: int, law: Law | None = None, torque: Array | None = None) -> int:
        """Go one row on, driven by the scenario's law (`_OWN`), by a user's law, or with None by a torque.

        The new state shows the events from number `since` on, which is returned, less those that did not happen with
        another torque at t = 0.
        """
        now, before, stepper = self._now, self._driver, self._stepper
        assert now is not None
        self._driver = None
        try:
            if before is driver is not None:
                stepper.go_on()
            else:
                stepper.back_to(now.mark)
                if torque is None:
                    stepper.let(law)
                else:
                    stepper.hold(torque)
                since = min(since, stepper.events_done)
                stepper.to_row()  # the present row anew, with what acts from here on
            self._to_row(now, since)
        except KeyboardInterrupt as stop:
            failure = interrupted(stop, now.state.time)
            failure.run = self.run()
            raise failure from stop
        except SimulationError as error:
            error.run = self._run(stepper.rows_done, str(error))
            self._failure = error
            raise
        self._driver = driver
        self._note(driver, law)
        return since

    def _to_row(self, now: _Now | None, since: int) -> None:
        """Record the next row and show it, with the events from number `since` on."""
        stepper = self._stepper
        stepper.to_row()
        row = 0 if now is None else now.row + 1
        measured, count = stepper.seen()
        table = stepper.answers.events[since:count].copy() if count > since else None
        recorded = stepper.rows[row].copy()
        state = StepState(self._h * row, row, self._n, recorded, measured, table, self._reads, self._types)
        self._now = _Now(stepper.mark, row, count, state)

    def _note(self, driver: object, law: Law | None) -> None:
        """Note what drove the step, for the record."""
        name = "scenario" if driver is _OWN else FROM_OUTSIDE if law is None else law_name(law)
        if name not in self._drivers:
            self._drivers[name] = "" if law is None else law_digest(law)

    def _run(self, done: int, stopped: str | None) -> Run:
        rows, events = self._stepper.completed(done)
        law = " and ".join(self._drivers) or "scenario"
        digest = self._drivers.get(law, "")
        return as_run(self.problem, rows, events, self._seconds, self._engine, law=(law, digest), stopped=stopped)
