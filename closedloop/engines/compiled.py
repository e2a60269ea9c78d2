"""The compiled engine: the same machine, with terms of our own instead of Pinocchio's, in one compiled loop.

`closedloop.events.proceed` asks for terms and does everything else; here they come from `closedloop.robot.tree`. So the
two engines differ in nothing but who provides H, C, Jᵣ, r and J̇ᵣq̇, and that is what the harness compares. The loop
needs no interpreter and holds no lock: runs of a batch go on side by side in threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.engines.problem import Problem
from closedloop.errors import ModelError, ScenarioError
from closedloop.events.phases import TERMS, extra_states
from closedloop.events.proceed import proceed
from closedloop.jit.kernel import entry_kernel, inlined_kernel
from closedloop.robot.tree import Tree, tree_of, tree_terms, work_size
from closedloop.step.memory import SENSOR_RING, STAGES, Whole, workspace

Array = NDArray[np.float64]

# More evaluations than any run has.
ALL = 1 << 62


@inlined_kernel
def _run(
    n: int, tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array, most: int, more: int | None,
) -> int:  # fmt: skip
    w = workspace(memory, n, extra_states(state, n), state[STAGES], state[SENSOR_RING])
    H, C, scratch = work[0 : n * n].reshape(n, n), work[n * n : n * n + n], work[n * n + n :]
    request, evaluations = TERMS, 0
    while request == TERMS and evaluations < most:
        evaluations += 1
        tree_terms(tree, w.q, w.v, scratch, H, C, w.J, w.r, w.drift)
        request = proceed(H, C, w, k, state, table, tableau, rows, events, more)
    return request


@entry_kernel
def run_compiled(
    tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array, most: int,
) -> int:  # fmt: skip
    """Go on until something other than terms is asked for, and return what; see `closedloop.events.proceed`.

    After `most` evaluations, at least one, it returns in any case.
    """
    return _run(tree.n, tree, work, k, state, memory, table, tableau, rows, events, most, None)


@entry_kernel
def run_compiled_with_more(
    tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array, tableau: Array, rows: Array,
    events: Array, most: int,
) -> int:  # fmt: skip
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return _run(tree.n, tree, work, k, state, memory, table, tableau, rows, events, most, 1)


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
