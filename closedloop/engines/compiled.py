"""The compiled engine: the same machine, with terms of our own instead of Pinocchio's, in one compiled loop.

`closedloop.events.proceed` asks for terms and does everything else; here they come from `closedloop.robot.tree`. So the
two engines differ in nothing but who provides H, C, Jᵣ, r and J̇ᵣq̇, and that is what the harness compares. The loop
needs no interpreter and holds no lock: runs of a batch go on side by side in threads.
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
    more: int | None,
) -> int:  # fmt: skip
    n = tree.n
    state, constants, w = loop_at(address)
    H, C, scratch = work[0 : n * n].reshape(n, n), work[n * n : n * n + n], work[n * n + n :]
    request, evaluations = TERMS, 0
    while request == TERMS and evaluations < most:
        evaluations += 1
        tree_terms(tree, w.q, w.v, scratch, H, C, w.J, w.r, w.drift)
        request = proceed(H, C, w, constants, state, table, tableau, rows, events, more)
    return request


@entry_kernel
def run_compiled(
    tree: Tree, work: Array, address: int, table: Array, tableau: Array, rows: Array, events: Array, most: int
) -> int:
    """Go on until something other than terms is asked for, and return what; see `closedloop.events.proceed`.

    After `most` evaluations, at least one, it returns in any case. The loop is found at the address, see
    `closedloop.step.memory.loop_at`.
    """
    return _run(tree, work, address, table, tableau, rows, events, most, None)


@entry_kernel
def run_compiled_with_more(
    tree: Tree, work: Array, address: int, table: Array, tableau: Array, rows: Array, events: Array, most: int
) -> int:
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return _run(tree, work, address, table, tableau, rows, events, most, 1)


def compiled_work(n: int) -> Array:
    """Return the scratch array of `run_compiled` for n joints."""
    return np.zeros(n * n + n + plain(work_size)(n))


def compiled_tree(problem: Problem) -> Tree:
    """Return the robot of a problem as the compiled engine's arrays."""
    return problem.robot.tree
