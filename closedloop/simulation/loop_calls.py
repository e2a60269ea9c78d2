"""Calls of the loop: the functions that provide its terms, and the answers to what else it requests.

All that steps one problem does so by a `Driver` and by `drive`: `closedloop.simulation.simulate` to the end, `Stepper`
from row to row, the adaptive integrator from state to state.
"""

import time as clock
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from struct import Struct
from typing import Any, cast

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.drives import cut_torque
from closedloop.control.reference.inverse_kinematics import sample_spline, walk
from closedloop.jit.background import make_ready, start, takes_long
from closedloop.jit.blocks import arrays_of
from closedloop.jit.calls import address_of
from closedloop.jit.interim import PROBE, Interim, at_hand, call_now, compile_ahead, compiles_ahead
from closedloop.jit.kernel import direct, plain
from closedloop.loop.events import locate
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.closed_loops import closed_loops
from closedloop.loop.step.contacts import contacts_in_step
from closedloop.loop.step.memory import Loop, State, Work
from closedloop.loop.step.record_row import complete_record
from closedloop.mechanics.closure.conditioning import BATCH
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.closure.solve import LAW_FAILED
from closedloop.mechanics.loops.reactions import lose_undriven, rows_along, torque_of_drives
from closedloop.mechanics.loops.solve import along_path, closed_to
from closedloop.mechanics.robot.tree import potential_energies
from closedloop.mechanics.surface.contact import normals_on_surface, put_on_surface
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.scenario.arm import has_stops
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines import loops as engine_loops
from closedloop.simulation.engines.bind_contacts import entries_of_contacts
from closedloop.simulation.engines.failures import failure_of, raised_by_member
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.scenario_numbers import calls_law, entries_of
from closedloop.simulation.engines.user_law import Law, UserLaw
from robot_models import RobotModel

# What calls the loop so many times, each with new terms, as long as nothing else is requested.
Provide = Callable[[int], int]
Arrays = tuple[Array, Array, Array, Array]  # the table of what is desired, the tableau, the rows, the events

# What a run calls once or twice before and after its loop, interpreted where it is not compiled yet; and with loops.
USED_ONCE, WITH_LOOPS = (potential_energies, walk, sample_spline), (rows_along, along_path, closed_to)


class Answers:
    """The answers to all that the loop requests beside terms.

    `interim`: whether an impact may be computed interpreted while its law is not compiled yet.
    `events` (M, EVENT_WIDTH): the table of events, which grows as needed.
    `addresses`: where the loop finds it; set once they are known.
    `compiling`: time of the first impact, s, which may have compiled its law.
    """

    addresses: engine_loops.Addresses

    def __init__(self, problem: Problem, loop: Loop, interim: bool = False) -> None:
        self._loop, self._interim = loop, interim
        self.events: Array = np.zeros((locate.INITIAL_EVENTS, EVENT_WIDTH))
        self.begin(problem)

    def begin(self, problem: Problem) -> None:
        """Answer for a run of a problem, from its start."""
        self._problem, self.compiling, self._struck = problem, 0.0, False
        self.events.fill(0.0)

    def end(self) -> None:
        """Let the problem go."""
        del self._problem

    def give(self, request: int) -> None:
        """Answer TABLE_FULL or IMPACT_LAW_WANTED, see `closedloop.loop.events.proceed`."""
        if request == locate.TABLE_FULL:
            self.events = np.vstack([self.events, np.zeros_like(self.events)])
            engine_loops.set_events(self.addresses, self.events)
            return
        self._problem.set_restitution(self._loop)
        began = clock.perf_counter()
        if self._interim:
            call_now(collide, (self._loop.state.memory, self._loop.w.memory), self._loop.address)
        else:
            collide(self._loop.address)
        if not self._struck:
            self.compiling, self._struck = clock.perf_counter() - began, True

    def failure(self, law: object, user_law: UserLaw | None) -> SimulationError:
        """Return why the loop cannot go on, with a law other than the scenario's, if not None.

        What a user's law raised is raised here.
        """
        state, w = self._loop.state, self._loop.w
        if user_law is not None and (state.status == LAW_FAILED or user_law.interruption is not None):
            raise user_law.failure()
        if state.raised != 0:
            raise raised_by_member(self._problem, self._loop)
        return failure_of(int(state.status), float(w.time), self._problem.robot, self._problem, law, w.q, w.v)


def drive(call: Callable[[int], int], give: Callable[[int], None], goes_on: Callable[[], bool] = lambda: True) -> int:
    """Call a loop, and give what it requests beside terms, until it is done or fails, or does not go on.

    `call`: calls the loop, with terms if the request before, which it gets, was TERMS; returns the next request.
    `give`: answers TABLE_FULL or IMPACT_LAW_WANTED.
    `goes_on`: whether to go on where terms are requested.
    Returns the last request: DONE, FAILED or TERMS.
    """
    request = locate.TERMS
    while True:
        request = call(request)
        if request in (locate.TABLE_FULL, locate.IMPACT_LAW_WANTED):
            give(request)
        elif request != locate.TERMS or not goes_on():
            return request


class Driver:
    """What steps the loop of a problem: its memory, at t = 0, and the calls of it with terms of an engine.

    Nobody else may evaluate terms with the problem's robot meanwhile.

    `problem`: the problem.
    `rows` (>= steps + 1, width): memory for the record, see `closedloop.loop.step.record_row.Row`.
    `law`, `engine`, `interim`: see `closedloop.simulation.simulate.run_loop`.
    `table`: in place of the problem's table of what is desired.
    `into`: see `closedloop.loop.step.memory.make_loop`.
    `kept`: whether the next run of the problem, from the same start or another, may take it over.
    `loop`, Loop: the memory.
    `once`, `many`, `again`, callables: call the loop: with new terms, with new terms as long as nothing else is
        requested and a `MOMENT` at most, see `Pace`, and with the last terms. They return the request. The compiled
        engine evaluates terms in any case.
    `terms`, callable: evaluates Pinocchio's terms.
    `answers`, Answers: answers to what else the loop requests.
    `user_law`, UserLaw or None: the connection to `law`.
    """

    def __init__(
        self, problem: Problem, rows: Array, engine: str = PINOCCHIO, *, law: Law | None = None, interim: bool = False,
        table: Array | None = None, into: Loop | None = None, kept: bool = False,
    ) -> None:  # fmt: skip
        self.loop = loop = problem.memory(user_law=law is not None, into=into)
        self._law, self.user_law = law, None if law is None else UserLaw(law, loop)
        connect = partial(problem.connect, loop, self.user_law.connect if self.user_law else None)
        if interim:
            self.kernel = begun(engine, problem, loop, connect, law)
        else:
            self.kernel = engine_loops.loop_for(engine)
            make_ready(*engine_loops.kernels_of(engine), *problem.called(loop, law is not None))
        connect(compiled=not (isinstance(self.kernel, Interim) and self.kernel.interpreting))
        self.may_be_kept = kept and law is None and not isinstance(self.kernel, Interim)
        self._robot = problem.robot
        self._before = unwritten(loop) if self.may_be_kept else []
        self.answers = Answers(problem, loop, interim)
        arrays = problem.table if table is None else table, problem.integrator.tableau(), rows, self.answers.events
        provide = (self._compiled if engine == COMPILED else self._pinocchios)(problem, arrays)
        self.answers.addresses, pace, kernel = self._addresses, engine_loops.Pace(), self.kernel

        def once() -> int:
            return provide(1)

        def many() -> int:
            # Interpreted, the compiled engine's loop returns after each evaluation, and can be interrupted.
            single = engine == COMPILED and isinstance(kernel, Interim) and kernel.interpreting
            return once() if single else pace.take(provide)

        self.once, self.many = once, many
        problem.begin(loop)

    def _pinocchios(self, problem: Problem, arrays: Arrays) -> Provide:
        robot, w = problem.robot, self.loop.w
        self._addresses = engine_loops.addresses_of(robot.views, self.loop, *arrays)
        at, (q, turned), v = address_of(self._addresses.memory), robot.configuration(w.q), w.v
        crba, bias, convention, pinocchio, data = robot.passes
        call, self.terms = direct(self.kernel, at, engine_loops.FROM_PINOCCHIO), robot.evaluator(w.q, w.v)

        def provide(evaluations: int) -> int:
            request = locate.TERMS
            for _ in range(evaluations):
                if turned is not None:
                    turned()
                crba(pinocchio, data, q, convention)  # as in `terms`, without a call
                bias(pinocchio, data, q, v)
                request = call(at, engine_loops.FROM_PINOCCHIO)
                if request != locate.TERMS:
                    break
            return request

        self.again = partial(call, at, engine_loops.FROM_PINOCCHIO)
        return provide

    def _compiled(self, problem: Problem, arrays: Arrays) -> Provide:
        n = problem.robot.n
        H, C, scratch = engine_loops.compiled_terms(engine_loops.compiled_work(n), n)
        self._addresses = engine_loops.addresses_of((H, C), self.loop, *arrays)
        given = engine_loops.compiled_tree(problem.robot), scratch, address_of(self._addresses.memory)
        call = direct(self.kernel, *given, 1)  # compiled, or read from the cache, before the clock starts
        self.again = partial(call, *given, 1)
        return partial(call, *given)

    def fits(self, problem: Problem) -> bool:
        """Whether these calls may step a problem: it differs in numbers alone from what they stepped before."""
        return self._robot is problem.robot and problem.fits(self.loop)

    def begin(self, problem: Problem, rows: Array) -> None:
        """Go to the start of a problem that it fits."""
        for array, before in self._before:
            array[...] = before
        self.answers.begin(problem)
        engine_loops.set_rows(self._addresses, problem.table, rows)
        problem.begin(self.loop)

    def end(self) -> None:
        """Let the problem and the rows of the run go."""
        self._addresses.keep_alive(table=None, rows=None)
        self.answers.end()

    def failure(self) -> SimulationError:
        """Return why the loop cannot go on; what a user's law raised is raised here."""
        return self.answers.failure(self._law, self.user_law)

    def close(self) -> None:
        """Release the user's law."""
        if self.user_law is not None:
            self.user_law.close()


def unwritten(loop: Loop) -> list[tuple[Array, Array]]:
    """Return the arrays of a loop's memory that runs change, and copies of them."""
    changing = [each for each in arrays_of(loop) if each.flags.writeable and each is not loop.constants.memory]
    return [(array, array.copy()) for array in changing]


def have_compiled(scenario: Scenario, model: RobotModel) -> None:
    """Have compiled in the background what a run of a scenario will want, before its path is known.

    A run that begins interpreted does so, and not one that is over before it would ask for compiled code.
    """
    if not compiles_ahead() or scenario.time.duration < PROBE * scenario.time.step:
        return
    surface = PlacedSurface(scenario.surface, scenario.surface_motion, np.eye(3), np.zeros(3), below_start=False)
    called = [*surface.entries().values(), *([] if surface.fixed_plane else (put_on_surface, normals_on_surface))]
    called += [closed_loops] if model.loops else []
    called += entries_of(scenario, model, calls_law(scenario, model)).values()
    if scenario.contact or has_stops(scenario, model):
        with suppress(ScenarioError):  # which is said in its turn
            called += entries_of_contacts(scenario)
        called.append(contacts_in_step)
    compile_ahead(
        [*called, *(WITH_LOOPS if model.loops else ()), engine_loops.proceed_at, complete_record, collide, *USED_ONCE]
    )


def begun(
    engine: str, problem: Problem, loop: Loop, connect: Callable[..., None], law: Law | None
) -> Callable[..., int]:
    """Return the loop, or what it is begun with if it is not compiled; and have compiled what else is missing."""
    kernels, called = engine_loops.kernels_of(engine), problem.called(loop, user_law=law is not None)
    with_it = [
        *kernels[1:],
        complete_record,
        *([collide] if loop.state.settings.unilateral or loop.state.contacts.at else []),
        *called,
    ]
    once = (*USED_ONCE, *(WITH_LOOPS if problem.robot.model.loops else ()))
    waited_for = [*kernels, *filter(takes_long, called)]
    if not all(map(at_hand, waited_for)):
        calls = problem.steps * problem.integrator.stages
        return Interim(
            kernels[0], loop.written, calls, with_it, connect, once,
            called=() if engine == COMPILED else called, on_called_compiled=lambda: connect(loop_compiled=False),
            share_done=lambda: float(loop.state.row) / problem.steps,
        )  # fmt: skip
    make_ready(*waited_for)
    start([function for function in (*with_it, *once) if not at_hand(function)])
    return kernels[0]


# A copy of the loop's memory: whole numbers, real ones before and behind the batch of rows that wait for their
# condition numbers, that batch if the next row completes it, whether the scenario's law had started, and of the links'
# contacts what lasts. The batch is most of the memory, and the rows in it stay as they are until it begins anew. (A
# tuple with names would take longer to make, at every step, and arrays twice as long to copy there and back as bytes.)
Mark = tuple[bytes, bytes, bytes, bytes, bool, tuple[bytes, ...]]
_REAL = Struct("d")

# Places in the loop's numbers that are used at every step: an attribute of `State` takes five times as long.
_ROW, _PHASE, _EVENTS, _MODE, _DRIVES, _SAMPLED, _OFF, _BATCHED = (
    cast(int, State.place(name))
    for name in ("row", "phase", "event.rows", "mode", "settings.drives", "sampled", "trial.off", "batched")
)
_GENERAL, _LAW, _COMPENSATION = (
    cast(int, State.place(name)) for name in ("settings.general", "law.entry", "compensation.entry")
)


class Stepper:
    """The loop of a problem, and what drives it: the scenario's law, a user's law, or a torque that is held.

    `rows`, (steps + 1, width) array: the record, see `closedloop.loop.step.record_row.Row`.
    `mark`, Mark: from just before the call that recorded the latest row; of the first row, from before anything was
        called.
    """

    def __init__(self, problem: Problem, engine: str) -> None:
        # A robot of its own: the terms that it has evaluated last are used again.
        problem = problem.with_robot(problem.robot.again())
        self._problem = problem
        self.rows: Array = np.zeros((problem.steps + 1, problem.row_width))
        self._driver = driver = Driver(problem, self.rows, engine)
        self.loop, self.answers = driver.loop, driver.answers
        state, w = self.loop.state, self.loop.w
        self._numbers: Any = state.memory.data
        # What is written through these is written as bytes, in a third of the time.
        self._all_numbers: Any = state.memory.data.cast("B")
        values, batch = w.memory.data.cast("B"), cast(slice, Work.place("batch", *w.sizes))
        begin, end = _REAL.size * batch.start, _REAL.size * batch.stop
        self._before: Any = values[:begin]
        self._batch: Any = values[begin:end]
        self._behind: Any = values[end:]
        self._of_contacts: tuple[Any, ...] = tuple(each.data.cast("B") for each in self.loop.lasting_contacts)
        self._own = int(state.settings.general), int(state.law.entry), int(state.compensation.entry)
        self._torque: Any = w.torque.data
        make_ready(*([collide] if state.settings.unilateral or state.contacts.at else []), complete_record)
        self._held, self._own_started = False, False
        self._all_driven = not len(problem.robot.model.undriven)
        self._begins = (
            locate.MEASURED if state.settings.encoder else locate.STEP_END
        )  # the phase that a row begins with
        self._law: Law | None = None
        self._user_law: UserLaw | None = None
        self._measured = _REAL.size * cast(int, Work.place("sensing.measured", *w.sizes)) - end
        self.mark: Mark = self._copied()
        # The mark whose terms have been evaluated last, and whether the loop is there.
        self._terms_of: Mark | None = None
        self._at_mark = self._terms_there = False

    def _copied(self) -> Mark:
        contacts = tuple(map(bytes, self._of_contacts)) if self._of_contacts else ()
        # The row after the next, which may be recorded before the loop goes back, would be the first of a new batch.
        batch = bytes(self._batch) if self._numbers[_BATCHED] == BATCH - 1 else b""
        return bytes(self._all_numbers), bytes(self._before), bytes(self._behind), batch, self._own_started, contacts

    def _put_back(self, mark: Mark) -> None:
        self._all_numbers[:], self._before[:], self._behind[:], batch, self._own_started, contacts = mark
        if batch:
            self._batch[:] = batch
        for block, before in zip(self._of_contacts, contacts, strict=True):
            block[:] = before

    def batch(self) -> bytes:
        """Return a copy of the rows that wait for their condition numbers, of which a mark has none."""
        return bytes(self._batch)

    def put_batch(self, batch: bytes) -> None:
        """Put back what `batch` returned, before going back to a mark of that instant."""
        self._batch[:] = batch

    def back_to(self, mark: Mark) -> None:
        """Go back to just before the row of a mark was recorded; what the next torque ends, ends at this row."""
        numbers = self._numbers
        self._put_back(mark)
        self.mark, self._at_mark, self._terms_there = mark, True, mark is self._terms_of
        if numbers[_ROW] > 0 and (numbers[_MODE] != FREE or self._of_contacts):
            numbers[_OFF] = 1  # the step before has been searched, with the torque that acted in it

    def hold(self, torque: Array) -> None:
        """Let a torque (n,), an array of doubles, act from the row on, to which the loop has gone back.

        Of what it asks of joints without a drive, what the drives can give through loops acts, as of a law's.
        """
        numbers = self._numbers
        if self._held and self._own_started:  # the laws are as they were
            numbers[_GENERAL], numbers[_LAW], numbers[_COMPENSATION] = self._own
        else:
            self._set_law(None)
            self._held = True
        if not self._all_driven:
            robot, model = self._problem.robot, self._problem.robot.model
            if model.loops:
                torque = torque_of_drives(robot, self.loop.w.q, torque)[0]
            else:
                torque = np.array(torque)
                plain(lose_undriven)(model.undriven, len(model.undriven), torque)
        if not numbers[_DRIVES]:
            self._torque[:] = torque
            return
        acting = self.loop.w.torque
        before = acting.copy()
        acting[:] = torque
        if not np.array_equal(torque, before):
            most, change = self._problem.drives
            plain(cut_torque)(
                acting, before, change / max(1, self._problem.hold), most, numbers[_ROW] == 0,
                self.loop.w.drives.limited,
            )  # fmt: skip

    def let(self, law: Law | None) -> None:
        """Let a law, None: the scenario's own, act from the row on, to which the loop has gone back."""
        self._set_law(law)
        self._held = False
        self.loop.state.sampled = 1

    def _set_law(self, law: Law | None) -> None:
        self.release()
        state = self.loop.state
        state.settings.general, state.law.entry, state.compensation.entry = self._own
        self._law = law
        if law is not None:
            state.compensation.entry, state.started = 0, 0
            self.loop.w.dz[: int(state.law_states)] = 0.0  # those of the scenario's law wait
            self._connect()
        elif not self._own_started:
            state.started, self._own_started = 0, True

    def _connect(self) -> None:
        assert self._law is not None
        self._user_law = UserLaw(self._law, self.loop)
        self._user_law.connect()

    def go_on(self) -> None:
        """Connect the law that acted last, if it was a user's, again."""
        if self._law is not None and self._user_law is None:
            self._connect()

    def release(self) -> None:
        """Release a user's law until `go_on`, `let` or `hold`."""
        if self._user_law is not None:
            self._user_law.close()
            self._user_law = None

    def to_row(self) -> None:
        """Go on until a row has been recorded.

        Raises SimulationError if the loop cannot go on; an exception of a user's law is its cause.
        """
        numbers = self._numbers
        row, self._next_mark = numbers[_ROW], self.mark
        self._call = self._driver.again if self._terms_there else self._driver.once
        self._marked = self._at_mark or row == 0
        self._at_mark, self._terms_there, self._terms_of = False, False, None
        if drive(self._go_on, self.answers.give, lambda: bool(numbers[_ROW] <= row)) == locate.FAILED:
            raise self.answers.failure(self._torque if self._held else self._law, self._user_law)
        self.mark = self._next_mark
        if row > 0 and self._begins == locate.STEP_END:
            self._terms_of = self.mark

    def _go_on(self, request: int) -> int:
        """Call the loop, which may record a row."""
        numbers = self._numbers
        if not self._marked and numbers[_PHASE] == self._begins:
            self._next_mark = self._copied()
        self._marked = numbers[_ROW] == 0
        if self._held:
            numbers[_SAMPLED] = 0
        call, self._call = self._call, self._driver.once
        return call()

    @property
    def rows_done(self) -> int:
        """The rows that a run which fails now has."""
        return int(self._numbers[_ROW])

    @property
    def events_done(self) -> int:
        """The events so far."""
        return int(self._numbers[_EVENTS])

    def seen(self) -> tuple[float, int]:
        """Return what the force sensor said before the latest row, N, and how many events there are."""
        (measured,) = _REAL.unpack_from(self.mark[2], self._measured)
        return measured, self._numbers[_EVENTS]

    def completed(self, done: int) -> tuple[Array, Array]:
        """Return copies of `done` rows, all that are recorded in the memory, and of the events."""
        now = self._copied()
        complete_record(self.loop.address, self.rows, done)
        self._put_back(now)
        return self.rows[:done].copy(), self.answers.events[: self.events_done].copy()
