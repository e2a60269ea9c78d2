"""The compiled engine: the same loop with terms of our own instead of Pinocchio's.

`closedloop.loop.events.proceed` requests terms and does everything else; here the terms come from
`closedloop.mechanics.robot.tree`. So the two engines differ only in the source of H, C, Jᵣ, r and J̇ᵣq̇. The loop runs
without the interpreter and its lock, so the runs of a batch are parallel in threads.
"""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at, fortran_at, integers_at, vector_at
from closedloop.jit.kernel import entry_kernel, kernel_inlined, plain
from closedloop.loop.events.phases import TERMS
from closedloop.loop.step.memory import loop_at
from closedloop.mechanics.robot.tree import Tree, tree_terms, work_size
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.proceed import ADDRESSES, IN_MEMORY, Addresses


@entry_kernel
def run_compiled(tree: Tree, scratch: Array, address: int, most: int) -> int:
    """Run until something other than terms is requested, and return the request; see `closedloop.loop.events.proceed`.

    After `most` evaluations, at least one, it returns in any case. The address is that of the memory of
    `closedloop.simulation.engines.proceed.Addresses`, of H and C in `compiled_terms`.
    """
    return provide_terms(tree, scratch, address, most)


@kernel_inlined
def provide_terms(tree: Tree, scratch: Array, address: int, most: int) -> int:
    """Do as `run_compiled`."""
    a, n = Addresses(integers_at(address, ADDRESSES)), tree.n
    H, C = fortran_at(a.H, n, n), vector_at(a.C, n)
    state, _, w = loop_at(a.loop)
    request, evaluations = TERMS, 0
    while request == TERMS and evaluations < most:
        evaluations += 1
        tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
        request = call_at(state.proceed, address, IN_MEMORY)
    return request


def compiled_work(n: int) -> Array:
    """Return the scratch array of `run_compiled` for n joints, with room for H and C before it."""
    return np.zeros(n * n + n + plain(work_size)(n))


def compiled_terms(work: Array, n: int) -> tuple[Array, Array, Array]:
    """Return H (n, n), column after column, C (n,) and the scratch array of `run_compiled` in `compiled_work`."""
    return work[: n * n].reshape(n, n).T, work[n * n : n * n + n], work[n * n + n :]


def compiled_tree(problem: Problem) -> Tree:
    """Return the robot of a problem as the compiled engine's arrays."""
    return problem.robot.tree
