"""The compiled engine: the same loop with terms of our own instead of Pinocchio's.

`closedloop.events.proceed` requests terms and does everything else; here the terms come from `closedloop.robot.tree`.
So the two engines differ only in the source of H, C, Jᵣ, r and J̇ᵣq̇. The loop runs without the interpreter and its
lock, so the runs of a batch are parallel in threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.engines.problem import Problem
from closedloop.events.phases import TERMS
from closedloop.events.proceed import proceed
from closedloop.jit.kernel import entry_kernel, inlined_kernel, plain
from closedloop.robot.tree import Tree, tree_terms, work_size
from closedloop.step.memory import loop_at

Array = NDArray[np.float64]

# More evaluations than any run has.
ALL = 1 << 62


@inlined_kernel
def _run(
    tree: Tree, work: Array, address: int, table: Array, tableau: Array, rows: Array, events: Array, most: int,
    general: int | None,
) -> int:  # fmt: skip
    n = tree.n
    state, constants, w = loop_at(address)
    H, C, scratch = work[0 : n * n].reshape(n, n), work[n * n : n * n + n], work[n * n + n :]
    request, evaluations = TERMS, 0
    while request == TERMS and evaluations < most:
        evaluations += 1
        tree_terms(tree, w.q, w.v, scratch, H, C, w.J, w.r, w.drift)
        request = proceed(H, C, w, constants, state, table, tableau, rows, events, general)
    return request


@entry_kernel
def run_compiled(
    tree: Tree, work: Array, address: int, table: Array, tableau: Array, rows: Array, events: Array, most: int
) -> int:
    """Run until something other than terms is requested, and return the request; see `closedloop.events.proceed`.

    After `most` evaluations, at least one, it returns in any case. The address is that of the loop's memory, see
    `closedloop.step.memory.loop_at`.
    """
    return _run(tree, work, address, table, tableau, rows, events, most, None)


@entry_kernel
def run_compiled_general(
    tree: Tree, work: Array, address: int, table: Array, tableau: Array, rows: Array, events: Array, most: int
) -> int:
    """Do the same in the general form: other laws, friction, a force sensor."""
    return _run(tree, work, address, table, tableau, rows, events, most, 1)


def compiled_work(n: int) -> Array:
    """Return the scratch array of `run_compiled` for n joints."""
    return np.zeros(n * n + n + plain(work_size)(n))


def compiled_tree(problem: Problem) -> Tree:
    """Return the robot of a problem as the compiled engine's arrays."""
    return problem.robot.tree
