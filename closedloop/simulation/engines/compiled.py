"""The compiled engine: the same loop with terms of our own instead of Pinocchio's.

`closedloop.loop.events.proceed` requests terms and does everything else; here the terms come from
`closedloop.mechanics.robot.tree`. So the two engines differ only in the source of H, C, Jᵣ, r and J̇ᵣq̇. The loop runs
without the interpreter and its lock, so the runs of a batch are parallel in threads.

Python has no arrays of dual numbers (`closedloop.jit.dual8`), only their memory, so entries for them take all arrays by
address. Of these entries only the form of dual numbers is compiled. The arrays are those of the entries that they stand
for: `closedloop.simulation.engines. compiled.run_compiled` and `closedloop.record.report.measures.measure_rows`.
"""

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.calls import call_at, fortran_at, integers_at, matrix_at, vector_at
from closedloop.jit.kernel import entry_kernel, kernel_inlined, plain
from closedloop.loop.events.locate import TERMS
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.memory import loop_at
from closedloop.mechanics.robot.tree import Tree, tree_terms, work_size
from closedloop.record.report.measures import CONTROL, measure
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


class Parts(Block):
    """Addresses and sizes of what `Addresses` of the run does not have."""

    constants: int  # of the tree
    constants_size: int
    scratch: int  # of the terms, with room for H and C before it, see `compiled_work`
    tally: int
    values: int
    signals: int
    limits: int  # see `closedloop.record.report.measures.joint_limits`
    step: int  # the step, one number, s


PARTS = Parts.count()


@kernel_inlined
def tree_with(tree: Tree, parts: Parts) -> Tree:
    """Return the robot, its constants read from an address: with the derivatives that they may have."""
    return Tree(
        tree.n, tree.blocks, tree.once, tree.carrier, tree.serial, tree.links,
        vector_at(parts.constants, parts.constants_size), tree.balls,
    )  # fmt: skip


@entry_kernel
def run_at(tree: Tree, parts_at: int, address: int, most: int) -> int:
    """Do as `run_compiled`, of a robot whose constants have no derivatives."""
    parts, first = Parts(integers_at(parts_at, PARTS)), tree.n * tree.n + tree.n
    scratch = vector_at(parts.scratch, first + work_size(tree.n))[first:]
    return provide_terms(tree, scratch, address, most)


@entry_kernel
def run_varied_at(tree: Tree, parts_at: int, address: int, most: int) -> int:
    """Do as `run_compiled`, of a robot whose constants have derivatives."""
    parts, first = Parts(integers_at(parts_at, PARTS)), tree.n * tree.n + tree.n
    scratch = vector_at(parts.scratch, first + work_size(tree.n))[first:]
    return provide_terms(tree_with(tree, parts), scratch, address, most)


@entry_kernel
def measure_at(tree: Tree, parts_at: int, address: int, nodes: int, done: int) -> None:
    """Do as `measure_rows` with the first `done` rows; `nodes` of the table are to each of them."""
    a, parts, n = Addresses(integers_at(address, ADDRESSES)), Parts(integers_at(parts_at, PARTS)), tree.n
    state, _, _ = loop_at(a.loop)
    terms, tally = vector_at(parts.scratch, n * n + n + work_size(n)), vector_at(parts.tally, 0)
    table = matrix_at(a.table, a.instants, a.table_width)
    measure(
        tree_with(tree, parts), (terms, tally), matrix_at(a.rows, done, a.row_width),
        (table, nodes), vector_at(parts.step, 1)[0], vector_at(parts.limits, 4 * n),
        matrix_at(a.events, state.event.rows, EVENT_WIDTH), vector_at(parts.values, 0),
        matrix_at(parts.signals, CONTROL, done),
    )  # fmt: skip
