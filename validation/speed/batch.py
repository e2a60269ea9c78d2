"""Many runs at once: the compiled engine holds no lock, so threads share the cores.

Beside it two threads that do nothing but arithmetic, for what the machine gives to two threads at that moment: on a
shared one it may be hardly more than to one, and no batch can be better.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from closedloop.compiled import entry_kernel
from closedloop.compiled_engine import compiled_tree, compiled_work
from closedloop.events import EVENT_WIDTH
from closedloop.machine import DONE
from closedloop.problem import Problem
from closedloop.simulation import ROOM_FOR_EVENTS, machine
from closedloop.step import Row
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final

T = TypeVar("T")

SPINS = 400_000


def compiled_batch(arm: str, problem: Problem, runs: int, threads: int) -> Contestant:
    """Return a batch of slides in the compiled engine on some threads, each with gains of its own.

    What prepares a run, its constants and its reference, is done before; a lap copies the start and steps.
    """
    n, tree, run = problem.robot.n, compiled_tree(problem), machine(problem.more, "compiled")
    many = [with_gains(problem, 1.0 + 0.01 * i) for i in range(runs)]
    given = [(of.constants(), of.state(), of.memory(), of.table, of.integrator.tableau()) for of in many]
    width = Row.of(n).width
    wanted = np.concatenate([final(of) for of in many])

    def one(i: int) -> Array:
        k, state, memory, table, tableau = given[i]
        rows, events = np.zeros((problem.steps + 1, width)), np.zeros((ROOM_FOR_EVENTS, EVENT_WIDTH))
        request = run(tree, compiled_work(n), k, state.copy(), memory.copy(), table, tableau, rows, events)
        if request != DONE:
            raise RuntimeError(f"run {i} of the batch stopped")
        return np.array(rows[-1, :n])

    share = _shared(one, runs, threads)
    what = f"compiled batch, {threads} thread{'s' * (threads > 1)}"
    steps = problem.steps * runs
    return Contestant(f"batch_{threads}", arm, n, steps, lambda: (None, np.concatenate(share())), wanted, 1e-9, what)


def arithmetic(threads: int) -> Contestant:
    """Return threads that add sines and ask nothing of memory: what the machine has to give. A step is one sine."""
    share = _shared(lambda i: _spin(SPINS), 4, threads)

    def lap() -> tuple[float | None, Array | None]:
        share()
        return None, None

    what = f"arithmetic, {threads} thread{'s' * (threads > 1)}"
    return Contestant(f"arithmetic_{threads}", "machine", 1, 4 * SPINS, lap, what=what)


def _shared(one: Callable[[int], T], count: int, threads: int) -> Callable[[], list[T]]:
    """Return a function that does `one` for every number below `count`, on some threads."""
    if threads == 1:
        return lambda: [one(i) for i in range(count)]
    pool = ThreadPoolExecutor(threads)
    return lambda: list(pool.map(one, range(count)))


@entry_kernel
def _spin(count: int) -> float:
    total = 0.0
    for i in range(count):
        total += np.sin(i)
    return total


def with_gains(problem: Problem, factor: float) -> Problem:
    """Return a problem with the law's gains some other size: another run, with the same amount of work."""
    law = problem.law
    return dataclasses.replace(problem, law=law._replace(gains=factor * law.gains))
