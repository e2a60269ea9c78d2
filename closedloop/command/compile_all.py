"""Compile everything that ships, at once: ``closedloop compile``, for images and clusters.

Each entry kernel of the package is compiled by a short run that calls it, so for the same types as in use. The process
in the background (`closedloop.jit.background`) calls `compile_these` for a few of them.
"""

from __future__ import annotations

import argparse
import logging
import signal
import time as clock
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import active_children, get_context
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from closedloop.base.errors import ScenarioError
from closedloop.base.second_process import cores
from closedloop.command.border import DONE, Parser, as_command
from closedloop.jit.background import notices, seconds_of_name
from closedloop.jit.cache_folder import cache_folder, why_not_kept
from closedloop.jit.calls import entry_address
from closedloop.jit.dual import FORM
from closedloop.jit.kernel import direct, jit_disabled

if TYPE_CHECKING:
    from closedloop.base.families import Family
    from closedloop.simulation.engines.problem import Problem


# What shares its functions with contacts and loops and hardly any with the step, or asks a surface.
BESIDE_STEP = frozenset((
    "contacts_in_step", "closed_loops", "along_path", "closed_to", "rows_along", "ball_tip", "external_forces",
    "put_on_surface", "normals_on_surface", "gradients_on_surface",
))  # fmt: skip


class Piece(NamedTuple):
    """Something to be compiled."""

    # kernel, what: the entry kernel's name, and a description
    kernel: str
    what: str
    compile: Callable[[], Any]  # compiles it
    after: str = ""  # the kernel that has to be there: `compile` would compile that too

    @property
    def family(self) -> str:
        """The same for pieces that share most of their functions."""
        return "" if self.kernel.startswith("entry_of_") else str(self.kernel in BESIDE_STEP)


def pieces() -> tuple[Piece, ...]:
    """Return everything that ships, in the order of how many runs need it."""
    return (*_kernels(), *_laws())


def _kernels() -> tuple[Piece, ...]:
    from closedloop.simulation.engines.lanes import FEWEST

    return (
        Piece("walk", "inverse kinematics of a path", _problem),
        Piece("sample_spline", "a path of joints", _problem),
        _entry("simulation.engines.loops", "proceed_at", "the step"),
        Piece(
            "complete_record", "the end of a record",
            lambda: direct(_named("loop.step.record_row", "complete_record"), 0, np.zeros((0, 0)), 0),
        ),
        Piece("collide", "impacts", lambda: direct(_named("loop.events.transitions", "collide"), 0)),
        Piece("run_compiled", "the compiled engine's terms", _compiled_engine, "proceed_at"),
        Piece("measure_rows", "values of a batch's runs", lambda: _batch(1), "run_compiled"),
        Piece("run_in_lanes", "eight runs of a batch at a time", lambda: _batch(FEWEST), "measure_rows"),
        Piece(
            "_impact", "a single impact",
            lambda: _named("mechanics.impact", "two_phase_impact")(np.eye(3), -np.eye(3)[0], 0.5, friction=0.1),
        ),
        Piece("put_on_surface", "a path on a surface", lambda: _path("put_on_surface")),
        Piece("normals_on_surface", "the normal along a path", lambda: _path("normals_on_surface")),
        Piece("gradients_on_surface", "the gradient along a path", lambda: _path("gradients_on_surface")),
        Piece("potential_energies", "potential energy of a record", _energies),
        _entry("loop.step.closed_loops", "closed_loops", "loops"),
        _entry("mechanics.loops.solve", "along_path", "loops along a path"),
        Piece("closed_to", "a closed start", lambda: _loops("closed_to")),
        Piece("rows_along", "loops of a record", lambda: _loops("rows_along")),
        _entry("loop.step.contacts", "contacts_in_step", "contacts of the links"),
        _entry("loop.step.locate", "ball_tip", "the round end of a tool"),
        _entry("loop.step.external", "external_forces", "forces from outside"),
        Piece("step_members", "simulations side by side", _together, "run_compiled"),
        _entry("simulation.ensemble.member", "strike", "impacts in them"),
        _entry("simulation.ensemble.lane_steps", "step_in_lanes", "eight of them in SIMD lanes"),
    )  # fmt: skip


def _named(module: str, name: str) -> Any:
    return getattr(import_module(f"closedloop.{module}"), name)


def _entry(module: str, kernel: str, what: str) -> Piece:
    """Return what is called by address."""
    return Piece(kernel, what, lambda: entry_address(_named(module, kernel)))


def _together() -> None:
    """Compile a step of simulations side by side."""
    from closedloop.simulation.ensemble.ensemble import Ensemble

    ensemble = Ensemble(1, 1, np.zeros((0, 3), dtype=np.int64), 0)
    ensemble.begin(0, _problem())
    ensemble.start([0])
    ensemble.close()


def _loops(kernel: str) -> None:
    """Compile one of the kernels of mechanisms with loops."""
    import robot_models
    from closedloop.figures.scene.solids import compile_rows
    from closedloop.mechanics.loops.bind import loop_memory
    from closedloop.mechanics.loops.solve import closed_to
    from closedloop.mechanics.robot.pinocchio import Robot

    robot = Robot(robot_models.load("five_bar"))
    if kernel == "closed_to":
        memory = loop_memory(robot)
        closed_to(memory.address, memory.rows.q.copy(), memory.rows.v.copy())
    else:
        compile_rows(robot)


def _laws() -> Iterable[Piece]:
    for what, entry in _members():
        yield Piece(getattr(entry, "__name__", ""), what, partial(entry_address, entry))


def _members() -> Iterable[tuple[str, Any]]:
    """Return the entries of all members that ship, and what each is."""
    from closedloop.control.law import COMPENSATIONS, LAWS
    from closedloop.loop.step.entries import friction_entry, joint_friction_entry, law_entry
    from closedloop.loop.step.solve_contact import compliance_entry
    from closedloop.mechanics.contacts.friction import contact_friction_entry
    from closedloop.mechanics.contacts.soft import depth_entry
    from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS
    from closedloop.mechanics.friction.laws.none import NoFriction
    from closedloop.mechanics.surface.compliances.none import Rigid
    from closedloop.mechanics.surface.contact import motion_entry, surface_entry
    from closedloop.mechanics.surface.motion import MOTIONS
    from closedloop.mechanics.surface.motions.none import NoMotion
    from closedloop.mechanics.surface.surface import COMPLIANCES, SURFACES

    families: tuple[tuple[Family[Any], Callable[[Any], Any], str], ...] = (
        (LAWS, law_entry, "law"),
        (COMPENSATIONS, law_entry, "compensation"),
        (SURFACE_LAWS, friction_entry, "friction"),
        (JOINT_LAWS, joint_friction_entry, "joint friction"),
        (SURFACES, surface_entry, "surface"),
        (COMPLIANCES, compliance_entry, "soft surface"),
        (COMPLIANCES, depth_entry, "soft contact of a link"),
        (SURFACE_LAWS, contact_friction_entry, "friction of a contact of a link"),
        (MOTIONS, motion_entry, "surface that moves:"),
    )
    for family, entry_of, what in families:
        for kind, member in family.items():
            if member not in (NoFriction, NoMotion, Rigid):
                yield f"{what} {kind}", entry_of(member)


def compile_these(names: Sequence[str]) -> None:
    """Compile these kernels, in this order."""
    from closedloop.jit import cache_folder as folders

    folders.make_folders, known = False, [*_kernels()]
    if any(name.startswith("entry_of_") for name in names):
        known += _laws()
    for name in names:
        for piece in known:
            if piece.kernel == name:
                piece.compile()
    if any(name.endswith(FORM) for name in names):
        _duals(names)


def _duals(names: Collection[str]) -> None:
    """Compile kernels of dual numbers, each by a scenario or a member that has it."""
    from closedloop.jit.dual import dual
    from closedloop.loop.step.closed_loops import closed_loops
    from closedloop.loop.step.contacts import contacts_in_step
    from closedloop.simulation.engines.dual_loop import compile_for, prepared

    compile_for(prepared(_problem()), names)
    for entry in (closed_loops, contacts_in_step, *(entry for _, entry in _members())):
        if dual(entry).__name__ in names:
            entry_address(dual(entry))


def _problem() -> Problem:
    from closedloop.scenario.load import load_scenario
    from closedloop.simulation.prepare import prepare

    return prepare(load_scenario("planar2_slide", {"time.duration": 0.002}))


def _compiled_engine() -> None:
    from closedloop.jit.interim import not_compiled_first
    from closedloop.simulation.engines.loops import COMPILED
    from closedloop.simulation.simulate import run_loop

    with not_compiled_first():  # the path is a piece of its own
        problem = _problem()
    run_loop(problem, engine=COMPILED)


def _energies() -> None:
    from closedloop.mechanics.robot.tree import potential_energies, work_size

    robot = _problem().robot
    potential_energies(robot.tree, np.zeros((1, robot.n)), np.zeros(int(work_size(robot.n))), np.zeros(1))


def _path(kernel: str) -> None:
    """Compile one of the kernels of paths on a surface."""
    from closedloop.mechanics.surface.along import gradients_on_surface
    from closedloop.mechanics.surface.contact import make_memory, normals_on_surface, put_on_surface, surface_entry
    from closedloop.mechanics.surface.kinds.plane import PlaneSurface

    memory = make_memory(np.zeros(0), np.zeros(0), (0, 0), np.zeros(3), np.eye(3), (np.inf, np.inf))
    nothing = np.zeros((0, 3))
    place, now = entry_address(surface_entry(PlaneSurface)), np.zeros(0)
    if kernel == "gradients_on_surface":
        gradients_on_surface(place, memory.address, now, nothing, nothing)
    elif kernel == "normals_on_surface":
        normals_on_surface(place, memory.address, now, nothing, nothing)
    else:
        put_on_surface(place, memory.address, np.zeros(3), 0.0, now, nothing, nothing, nothing)


def _batch(runs: int) -> None:
    if find_spec("pyarrow") is None:  # without it there are no batches, which alone need this
        return
    from closedloop.simulation.batch.simulate_batch import simulate_batch

    simulate_batch(_problem().scenario, {"law.force": [10.0 + i for i in range(runs)]}, workers=1)


MOST_WORKERS = 8  # more would wait for what is compiled one after the other


@as_command()
def main(arguments: list[str]) -> int:
    """Compile everything, with a line for each piece, and return the exit status."""
    parser = Parser(
        prog="closedloop compile",
        description="Compile everything that ships, so that no later run has to, and say where it\nis kept.",
        epilog="exit status: 0 done; 2 nothing can be kept, or NUMBA_DISABLE_JIT is set;\n130 interrupted",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help=f"processes (default: one for each core, at most {MOST_WORKERS})"
    )
    workers = parser.parse_args(arguments).workers
    if workers is not None and not 1 <= workers <= MOST_WORKERS:
        raise ScenarioError(f"--workers {workers}: must be at least 1, and at most {MOST_WORKERS}")
    if jit_disabled():
        raise ScenarioError("NUMBA_DISABLE_JIT is set: there is nothing to compile")
    if reason := why_not_kept():
        raise ScenarioError(f"compiled code cannot be kept: {reason}")
    began, processor_time, everything = clock.perf_counter(), 0.0, pieces()
    width = max(len(piece.what) for piece in everything)
    for what, wall, own in _compiled(everything, workers or min(cores(), MOST_WORKERS)):
        processor_time += own
        print(f"{what:{width}}  {wall:6.1f} s  ({own:.1f} s of processor time)", flush=True)
    wall = clock.perf_counter() - began
    print(f"{'together':{width}}  {wall:6.1f} s  ({processor_time:.1f} s of processor time); kept in {cache_folder()}")
    return DONE


def _compiled(everything: Sequence[Piece], workers: int) -> Iterator[tuple[str, float, float]]:
    """Compile everything in so many processes; yield what is done, and its time and processor time, s."""
    # What others come after is begun first, and then what takes longest.
    waiting = dict(enumerate(everything))
    order = sorted(waiting, key=lambda i: (not waiting[i].after, -seconds_of_name(waiting[i].kernel)))
    there: set[str] = set()
    running: dict[Future[tuple[float, float]], tuple[Piece, int]] = {}
    families: list[set[str]] = [set() for _ in range(workers)]  # of what each process has compiled
    with ExitStack() as stack:
        # Fresh processes: in a copy of this one the locks of libraries' threads could be taken. They leave Ctrl-C to
        # this one, which ends them.
        how = get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
        pools = [stack.enter_context(ProcessPoolExecutor(1, *how)) for _ in range(workers)]
        try:
            while waiting or running:
                for at in set(range(workers)) - {at for _, at in running.values()}:
                    ready = [i for i in order if i in waiting and waiting[i].after in {"", *there}]
                    if ready:
                        # First what shares functions with what this process has compiled, last what another has begun.
                        i = min(ready, key=lambda i: (
                            waiting[i].family not in families[at], any(waiting[i].family in each for each in families)
                        ))  # fmt: skip
                        families[at].add(waiting[i].family)
                        running[pools[at].submit(_compile_piece, i)] = waiting.pop(i), at
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    piece, _ = running.pop(done)
                    there.add(piece.kernel)
                    yield piece.what, *done.result()
        except BrokenProcessPool:
            raise ScenarioError(
                "a process that compiles was ended from outside, perhaps as memory is short; try --workers 1"
            ) from None
        except BaseException:
            for process in active_children():
                process.terminate()
            raise


def _compile_piece(i: int) -> tuple[float, float]:
    """Compile one of `pieces`, and return the time and the processor time, s, that it took."""
    notices.setLevel(logging.WARNING)  # a line for each piece says it already
    began, busy = clock.perf_counter(), clock.process_time()
    pieces()[i].compile()
    return clock.perf_counter() - began, clock.process_time() - busy
