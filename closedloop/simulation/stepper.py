"""The loop of a problem from one row of the record to the next, and back to the row before.

A call of the loop that records a row also begins the step after it, with the torque of that row. So a mark is kept: a
copy of the loop's memory just before that call. A torque that is given once the row has been seen acts from the row on:
the memory is put back to the mark, and the row is recorded anew.
"""

from dataclasses import replace
from struct import Struct
from typing import Any, cast

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.drives import cut_torque
from closedloop.jit.background import make_ready
from closedloop.jit.kernel import plain
from closedloop.loop.events.locate import FAILED, MEASURED, STEP_END
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.memory import State, Work
from closedloop.loop.step.record_row import complete_record
from closedloop.mechanics.closure.conditioning import BATCH
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.reactions import lose_undriven, torque_of_drives
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law, UserLaw
from closedloop.simulation.loop_calls import Driver, drive

# A copy of the loop's memory: whole numbers, real ones before and behind the batch of rows that wait for their
# condition numbers, that batch if the next row completes it, whether the scenario's law had started, and the memory of
# the links' contacts. The batch is most of the memory, and the rows in it stay as they are until it begins anew. (A
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
        problem = replace(problem, robot=problem.robot.again())
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
        contacts = w.kept.get("contacts", ())
        self._of_contacts: tuple[Any, ...] = tuple(block.memory.data.cast("B") for block in contacts)
        self._own = int(state.settings.general), int(state.law.entry), int(state.compensation.entry)
        self._torque: Any = w.torque.data
        make_ready(*([collide] if state.settings.unilateral or state.contacts.at else []), complete_record)
        self._held, self._own_started = False, False
        self._all_driven = not len(problem.robot.model.undriven)
        self._begins = MEASURED if state.settings.encoder else STEP_END  # the phase that a row begins with
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
        if drive(self._go_on, self.answers.give, lambda: bool(numbers[_ROW] <= row)) == FAILED:
            raise self.answers.failure(self._torque if self._held else self._law, self._user_law)
        self.mark = self._next_mark
        if row > 0 and self._begins == STEP_END:
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
