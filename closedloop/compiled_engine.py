"""The compiled engine: the same machine, with terms of our own instead of Pinocchio's, in one compiled loop.

`closedloop.machine.proceed` asks for terms and does everything else; here they come from `closedloop.tree`. So the two
engines differ in nothing but who provides H, C, Jᵣ, r and J̇ᵣq̇, and that is what the harness compares. The loop needs no
interpreter and holds no lock: runs of a batch go on side by side in threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import entry_kernel, inlined_kernel, needs_compiling
from closedloop.errors import ModelError, ScenarioError
from closedloop.machine import TERMS, extra_states, proceed
from closedloop.problem import Problem
from closedloop.tree import Tree, tree_of, tree_terms, work_size
from closedloop.workspace import SENSOR_RING, STAGES, Whole, workspace

Array = NDArray[np.float64]


# How many steps must be ahead for a loop for just this number of joints to be worth the ten seconds that compiling it
# takes: its inner loops are written out, which saves a fifth of each step. Above so many joints they no longer are.
WORTH_COMPILING, MOST_WRITTEN_OUT = 50_000_000, 8


@inlined_kernel
def _run(
    n: int, tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array, more: int | None,
) -> int:  # fmt: skip
    w = workspace(memory, n, extra_states(state, n), state[STAGES], state[SENSOR_RING])
    H, C, scratch = work[0 : n * n].reshape(n, n), work[n * n : n * n + n], work[n * n + n :]
    request = TERMS
    while request == TERMS:
        tree_terms(tree, w.q, w.v, scratch, H, C, w.J, w.r, w.drift)
        request = proceed(H, C, w, k, state, table, tableau, rows, events, more)
    return request


@entry_kernel
def run_compiled(
    tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array,
) -> int:  # fmt: skip
    """Go on until something other than terms is asked for, and return what; see `closedloop.machine.proceed`."""
    return _run(tree.n, tree, work, k, state, memory, table, tableau, rows, events, None)


@entry_kernel
def run_compiled_with_more(
    tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array,
) -> int:  # fmt: skip
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return _run(tree.n, tree, work, k, state, memory, table, tableau, rows, events, 1)


@cache
def written_out(n: int, more: bool) -> Callable[..., int]:
    """Return `run_compiled` (or `run_compiled_with_more`) for n joints and no other number, compiled when first called.

    The compiler then knows how long each inner loop is. The arithmetic is the same, to the last bit.
    """
    form = 1 if more else None

    def run(
        tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
        events: Array,
    ) -> int:  # fmt: skip
        return _run(n, tree, work, k, state, memory, table, tableau, rows, events, form)

    run.__name__ = run.__qualname__ = f"run_{n}_joints" + ("_with_more" if more else "")
    return entry_kernel(run)


def compiled_loop(n: int, more: bool, ahead: int = 0) -> Callable[..., int]:
    """Return the loop to run n joints with: that of just n joints if it is there, or worth it.

    Parameters
    ----------
    n : int
        Number of joints.
    more : bool
        See `closedloop.step`.
    ahead : int
        How many steps are to come, in this run and others.
    """
    if 0 < n <= MOST_WRITTEN_OUT and (ahead >= WORTH_COMPILING or _is_there(n, more)):
        return written_out(n, more)
    return run_compiled_with_more if more else run_compiled


@cache
def _is_there(n: int, more: bool) -> bool:
    """Whether an earlier process has compiled a loop for n joints: asked once, since it takes a look at the disk."""
    return not needs_compiling(written_out(n, more))


def compiled_work(n: int) -> Array:
    """Return the scratch array of `run_compiled` for n joints."""
    return np.zeros(n * n + n + work_size(n))


def compiled_tree(problem: Problem) -> Tree:
    """Return the robot of a problem as the compiled engine's arrays.

    Raises
    ------
    ScenarioError
        If the robot has a joint that the compiled engine does not cover.
    """
    try:
        return tree_of(problem.robot.model, problem.robot.tip)
    except ModelError as error:
        raise ScenarioError(f"--engine compiled: {error}; use the pinocchio engine") from None
