"""Calls of the loop: the functions that provide its terms, and the answers to what else it requests.

`closedloop.simulation.simulate` runs a problem to its end with them, `closedloop.simulation.simulator` step by step.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.reference.inverse_kinematics import walk
from closedloop.control.reference.joint_path import sample_spline
from closedloop.jit.background import make_ready, start, takes_long
from closedloop.jit.blocks import arrays_of
from closedloop.jit.buffers import draft_address
from closedloop.jit.calls import address_of
from closedloop.jit.interim import PROBE, Interim, at_hand, call_now, compile_ahead, compiles_ahead
from closedloop.jit.kernel import direct
from closedloop.loop.events.impacts import collide
from closedloop.loop.events.phases import INITIAL_EVENTS, TABLE_FULL, TERMS
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.closed_loops import closed_loops
from closedloop.loop.step.contacts import contacts_in_step
from closedloop.loop.step.memory import Loop
from closedloop.loop.step.record_row import complete_record
from closedloop.mechanics.closure.solve import LAW_FAILED
from closedloop.mechanics.loops.close import along_path, closed_to
from closedloop.mechanics.loops.reactions import rows_along
from closedloop.mechanics.robot.tree import Tree, potential_energies
from closedloop.mechanics.surface.contact import normals_on_surface, put_on_surface
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.scenario.arm import has_stops
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.bind_contacts import entries_of_contacts
from closedloop.simulation.engines.failures import failure_of, raised_by_member
from closedloop.simulation.engines.loops import COMPILED, Pace, kernels_of, loop_for
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.proceed import (
    FROM_PINOCCHIO,
    Addresses,
    addresses_of,
    proceed_at,
    set_events,
    set_rows,
)
from closedloop.simulation.engines.scenario_numbers import entries_of
from closedloop.simulation.engines.user_law import Law, UserLaw
from robot_models import RobotModel

Call = Callable[[Array], int]

# What a run calls once or twice before and after its loop, interpreted where it is not compiled yet; and with loops.
USED_ONCE, WITH_LOOPS = (potential_energies, walk, sample_spline), (rows_along, along_path, closed_to)


class Answers:
    """The answers to all that the loop requests beside terms.

    Parameters
    ----------
    interim : bool
        Whether an impact may be computed interpreted while its law is not compiled yet.

    Attributes
    ----------
    events : (M, EVENT_WIDTH) array
        The table of events, which grows as needed.
    compiling : float
        Time of the first impact, s, which may have compiled its law.
    """

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


class Calls:
    """What steps the loop of a problem; the next run of it takes it over, from the same start or another.

    Parameters
    ----------
    problem : Problem
        The problem; see `begin`.
    rows, law, engine, interim, tree
        See `closedloop.simulation.simulate.run_loop`.
    into
        See `closedloop.loop.step.memory.make_loop`.

    Attributes
    ----------
    once, many : callables
        See `driver`.
    answers : Answers
        Answers to what else the loop requests.
    user_law : UserLaw or None
        The connection to `law`.
    """

    def __init__(
        self, problem: Problem, rows: Array, law: Law | None, engine: str, interim: bool,
        tree: tuple[Tree, Array] | None, into: Loop | None = None,
    ) -> None:  # fmt: skip
        self.loop = loop = problem.memory(user_law=law is not None, into=into)
        self.user_law = None if law is None else UserLaw(law, loop)
        connect = partial(problem.connect, loop, self.user_law.connect if self.user_law else None)
        if interim:
            self.kernel = begun(engine, problem, loop, connect, law)
        else:
            self.kernel = loop_for(engine)
            make_ready(*kernels_of(engine), *problem.called(loop, law is not None))
        connect(compiled=not (isinstance(self.kernel, Interim) and self.kernel.interpreting))
        self.may_be_kept = law is None and not isinstance(self.kernel, Interim)
        self._of, self._new = (problem.form, problem.robot), True
        self._settled = self._last = problem.settled
        self._before = unwritten(loop) if self.may_be_kept else []
        self.answers = Answers(problem, loop, interim)
        arrays = problem.table, problem.integrator.tableau(), rows
        self.once, self.many, self._addresses = driver(problem, self.kernel, loop, arrays, engine, tree)

    def fits(self, problem: Problem) -> bool:
        """Whether these calls may step a problem: it differs in numbers alone from what they stepped before."""
        form, robot = self._of
        return robot is problem.robot and form == problem.form

    def begin(self, problem: Problem, rows: Array) -> None:
        """Go to the start of a problem that they fit."""
        if not self._new:
            for array, before in self._before:
                array[...] = before
            if not problem.settled is self._settled is self._last:
                problem.write(self.loop)
                self._last = problem.settled
        self._new = False
        problem.begin(self.loop)
        self.answers.begin(problem)
        set_rows(self._addresses, problem.table, rows)

    def end(self) -> None:
        """Let the problem and the rows of the run go."""
        self._addresses.keep_alive(table=None, rows=None)
        self.answers.end()


def unwritten(loop: Loop) -> list[tuple[Array, Array]]:
    """Return the arrays of a loop's memory that runs change, and copies of them."""
    changing = [each for each in arrays_of(loop) if each.flags.writeable and each is not loop.constants.memory]
    return [(array, array.copy()) for array in changing]


def driver(
    problem: Problem,
    kernel: Callable[..., int],
    loop: Loop,
    arrays: tuple[Array, Array, Array],
    engine: str,
    made: tuple[Tree, Array] | None = None,
) -> tuple[Call, Call, Addresses]:
    """Return two functions of the table of events: one provides terms once, one while nothing else is requested.

    And the addresses that they call the loop with. The second returns after about a `MOMENT` too, see `Pace`. The
    compiled engine's are the same: it returns as soon as something else is requested.

    Parameters
    ----------
    problem, kernel, loop
        The problem, one of its loops, see `closedloop.simulation.engines.loops.loop_for`, and the loop's memory.
    arrays : tuple of three arrays
        Reference, tableau and rows, see `closedloop.loop.events.proceed.proceed`.
    engine : str
        See `closedloop.simulate`.
    made : (Tree, array), optional
        The robot for the compiled engine, and its scratch array, if they exist already.
    """
    pace = Pace()
    if engine == COMPILED:
        given, addresses = _compiled_arguments(problem, loop, arrays, made)
        if not isinstance(kernel, Interim) and not getattr(kernel, "signatures", ()):
            direct(kernel, *given, 1)  # compile it, or read it from the cache, before the clock starts

        def go_on(events: Array) -> int:
            set_events(addresses, events)
            # Interpreted, it returns after each evaluation, as with Pinocchio, and can be interrupted.
            if isinstance(kernel, Interim) and kernel.interpreting:
                return kernel(*given, 1)
            return pace.take(lambda evaluations: kernel(*given, evaluations))

        return go_on, go_on, addresses

    robot = problem.robot
    addresses = addresses_of(robot.views, loop, *arrays, np.zeros((0, EVENT_WIDTH)))
    crba, bias, convention, pinocchio, data = robot.passes
    (q, turned), v, at = robot.configuration(loop.w.q), loop.w.v, address_of(addresses.memory)

    def provide(evaluations: int) -> int:
        request, call = TERMS, direct(kernel, at, FROM_PINOCCHIO)
        for _ in range(evaluations):
            if turned is not None:
                turned()
            crba(pinocchio, data, q, convention)  # as in `Robot.evaluator`, without a call
            bias(pinocchio, data, q, v)
            request = call(at, FROM_PINOCCHIO)
            if request != TERMS:
                break
        return request

    def once(events: Array) -> int:
        set_events(addresses, events)
        return provide(1)

    def many(events: Array) -> int:
        set_events(addresses, events)
        return pace.take(provide)

    return once, many, addresses


def single_calls(
    problem: Problem, kernel: Callable[..., int], loop: Loop, arrays: tuple[Array, Array, Array], engine: str
) -> tuple[Call, Call]:
    """Return two functions of the table of events that call a compiled kernel once: with new terms, with the last.

    Of the arguments see `driver`. Nobody else may evaluate terms with the problem's robot.
    """
    known: Array | None = None
    if engine == COMPILED:
        given, addresses = _compiled_arguments(problem, loop, arrays)
        call = direct(kernel, *given, 1)

        def evaluate(events: Array) -> int:
            nonlocal known
            if known is not events:
                set_events(addresses, events)
                known = events
            return call(*given, 1)

        return evaluate, evaluate

    robot = problem.robot
    addresses = addresses_of(robot.views, loop, *arrays, np.zeros((0, EVENT_WIDTH)))
    crba, bias, convention, pinocchio, data = robot.passes
    (q, turned), v, at = robot.configuration(loop.w.q), loop.w.v, address_of(addresses.memory)
    call = direct(kernel, at, FROM_PINOCCHIO)

    def again(events: Array) -> int:
        nonlocal known
        if known is not events:
            set_events(addresses, events)
            known = events
        return call(at, FROM_PINOCCHIO)

    def once(events: Array) -> int:
        if turned is not None:
            turned()
        crba(pinocchio, data, q, convention)  # as in `Robot.evaluator`, without a call
        bias(pinocchio, data, q, v)
        return call(at, FROM_PINOCCHIO) if known is events else again(events)

    return once, again


def _compiled_arguments(
    problem: Problem, loop: Loop, arrays: tuple[Array, Array, Array], made: tuple[Tree, Array] | None = None
) -> tuple[tuple[Tree, Array, int], Addresses]:
    """Return the arguments of `run_compiled` but for the last, and the addresses, which are kept as long as it runs."""
    from closedloop.simulation.engines.compiled import compiled_terms, compiled_tree, compiled_work

    n = problem.robot.n
    tree, work = made or (compiled_tree(problem), compiled_work(n))
    H, C, scratch = compiled_terms(work, n)
    addresses = addresses_of((H, C), loop, *arrays, np.zeros((0, EVENT_WIDTH)))
    return (tree, scratch, address_of(addresses.memory)), addresses


def have_compiled(scenario: Scenario, model: RobotModel) -> None:
    """Have compiled in the background what a run of a scenario will want, before its path is known.

    A run that begins interpreted does so, and not one that is over before it would ask for compiled code.
    """
    if not compiles_ahead() or scenario.time.duration < PROBE * scenario.time.step:
        return
    surface = PlacedSurface(scenario.surface, scenario.surface_motion, np.eye(3), np.zeros(3), below_start=False)
    called = [*surface.entries().values(), *([] if surface.fixed_plane else (put_on_surface, normals_on_surface))]
    called += [closed_loops] if model.loops else []
    called += entries_of(scenario, model).values()
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
        again = law is None  # which has a memory of its own, and is not asked twice

        def connect_drafts(of_loop: bool) -> None:
            connect(machine=draft_address, loop_compiled=of_loop)

        return Interim(
            kernels[0], loop.written, calls, with_it, connect, once, again, called,
            None if engine == COMPILED else connect_drafts,
            lambda: float(loop.state.row) / problem.steps,
        )  # fmt: skip
    make_ready(*waited_for)
    start([function for function in (*with_it, *once) if not at_hand(function)])
    return kernels[0]
