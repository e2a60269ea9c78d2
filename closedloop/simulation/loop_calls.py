"""Calls of the loop: the functions that provide its terms, and the answers to what else it requests.

All that steps one problem does so by a `Driver` and by `drive`: `closedloop.simulation.simulate` to the end,
`closedloop.simulation.stepper` from row to row, the adaptive integrator from state to state.
"""

import time as clock
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.reference.inverse_kinematics import sample_spline, walk
from closedloop.jit.background import make_ready, start, takes_long
from closedloop.jit.blocks import arrays_of
from closedloop.jit.calls import address_of
from closedloop.jit.interim import PROBE, Interim, at_hand, call_now, compile_ahead, compiles_ahead
from closedloop.jit.kernel import direct
from closedloop.loop.events.locate import IMPACT_LAW_WANTED, INITIAL_EVENTS, TABLE_FULL, TERMS
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.closed_loops import closed_loops
from closedloop.loop.step.contacts import contacts_in_step
from closedloop.loop.step.memory import Loop
from closedloop.loop.step.record_row import complete_record
from closedloop.mechanics.closure.solve import LAW_FAILED
from closedloop.mechanics.loops.reactions import rows_along
from closedloop.mechanics.loops.solve import along_path, closed_to
from closedloop.mechanics.robot.tree import Tree, potential_energies
from closedloop.mechanics.surface.contact import normals_on_surface, put_on_surface
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.scenario.arm import has_stops
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.bind_contacts import entries_of_contacts
from closedloop.simulation.engines.failures import failure_of, raised_by_member
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO, Pace, kernels_of, loop_for
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.proceed import (
    FROM_PINOCCHIO,
    Addresses,
    addresses_of,
    proceed_at,
    set_events,
    set_rows,
)
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

    addresses: Addresses

    def __init__(self, problem: Problem, loop: Loop, interim: bool = False) -> None:
        self._loop, self._interim = loop, interim
        self.events: Array = np.zeros((INITIAL_EVENTS, EVENT_WIDTH))
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
        if request == TABLE_FULL:
            self.events = np.vstack([self.events, np.zeros_like(self.events)])
            set_events(self.addresses, self.events)
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
    request = TERMS
    while True:
        request = call(request)
        if request in (TABLE_FULL, IMPACT_LAW_WANTED):
            give(request)
        elif request != TERMS or not goes_on():
            return request


class Driver:
    """What steps the loop of a problem: its memory, at t = 0, and the calls of it with terms of an engine.

    Nobody else may evaluate terms with the problem's robot meanwhile.

    `problem`: the problem.
    `rows` (>= steps + 1, width): memory for the record, see `closedloop.loop.step.record_row.Row`.
    `law`, `engine`, `interim`, `tree`: see `closedloop.simulation.simulate.run_loop`.
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
        tree: tuple[Tree, Array] | None = None, table: Array | None = None, into: Loop | None = None,
        kept: bool = False,
    ) -> None:  # fmt: skip
        self.loop = loop = problem.memory(user_law=law is not None, into=into)
        self._law, self.user_law = law, None if law is None else UserLaw(law, loop)
        connect = partial(problem.connect, loop, self.user_law.connect if self.user_law else None)
        if interim:
            self.kernel = begun(engine, problem, loop, connect, law)
        else:
            self.kernel = loop_for(engine)
            make_ready(*kernels_of(engine), *problem.called(loop, law is not None))
        connect(compiled=not (isinstance(self.kernel, Interim) and self.kernel.interpreting))
        self.may_be_kept = kept and law is None and not isinstance(self.kernel, Interim)
        self._robot = problem.robot
        self._before = unwritten(loop) if self.may_be_kept else []
        self.answers = Answers(problem, loop, interim)
        arrays = problem.table if table is None else table, problem.integrator.tableau(), rows, self.answers.events
        provide = (self._compiled if engine == COMPILED else self._pinocchios)(problem, arrays, tree)
        self.answers.addresses, pace, kernel = self._addresses, Pace(), self.kernel

        def once() -> int:
            return provide(1)

        def many() -> int:
            # Interpreted, the compiled engine's loop returns after each evaluation, and can be interrupted.
            single = engine == COMPILED and isinstance(kernel, Interim) and kernel.interpreting
            return once() if single else pace.take(provide)

        self.once, self.many = once, many
        problem.begin(loop)

    def _pinocchios(self, problem: Problem, arrays: Arrays, made: tuple[Tree, Array] | None) -> Provide:
        robot, w = problem.robot, self.loop.w
        self._addresses = addresses_of(robot.views, self.loop, *arrays)
        at, (q, turned), v = address_of(self._addresses.memory), robot.configuration(w.q), w.v
        crba, bias, convention, pinocchio, data = robot.passes
        call, self.terms = direct(self.kernel, at, FROM_PINOCCHIO), robot.evaluator(w.q, w.v)

        def provide(evaluations: int) -> int:
            request = TERMS
            for _ in range(evaluations):
                if turned is not None:
                    turned()
                crba(pinocchio, data, q, convention)  # as in `terms`, without a call
                bias(pinocchio, data, q, v)
                request = call(at, FROM_PINOCCHIO)
                if request != TERMS:
                    break
            return request

        self.again = partial(call, at, FROM_PINOCCHIO)
        return provide

    def _compiled(self, problem: Problem, arrays: Arrays, made: tuple[Tree, Array] | None) -> Provide:
        from closedloop.simulation.engines.compiled import compiled_terms, compiled_tree, compiled_work

        n = problem.robot.n
        tree, work = made or (compiled_tree(problem), compiled_work(n))
        H, C, scratch = compiled_terms(work, n)
        self._addresses = addresses_of((H, C), self.loop, *arrays)
        given = tree, scratch, address_of(self._addresses.memory)
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
        set_rows(self._addresses, problem.table, rows)
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
    compile_ahead([*called, *(WITH_LOOPS if model.loops else ()), proceed_at, complete_record, collide, *USED_ONCE])


def begun(
    engine: str, problem: Problem, loop: Loop, connect: Callable[..., None], law: Law | None
) -> Callable[..., int]:
    """Return the loop, or what it is begun with if it is not compiled; and have compiled what else is missing."""
    kernels, called = kernels_of(engine), problem.called(loop, user_law=law is not None)
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
