"""One of several simulations side by side: its memory, and the kernels that step it.

A member goes from one control instant to the next in one call: what the action sets is held until then, events within
are located as in any run. At the end the row of the record is there, but the step after it begins with the next action.
So the loop's memory is copied just before that row is evaluated (the mark), and put back once the action is known, as
`closedloop.simulation.loop_calls` does it: what happens is to the same bits what `closedloop.Simulator` does.
"""

from typing import Annotated

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.control.reference.desired import Reference
from closedloop.jit.blocks import Block
from closedloop.jit.calls import call_at, fortran_at, integers_at, matrix_at, row_of, vector_at
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.jit.simd8 import WIDE
from closedloop.loop.events.locate import DONE, IMPACT_LAW_WANTED, TERMS
from closedloop.loop.events.table import EVENT_WIDTH, EventRow
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.memory import State, loop_at
from closedloop.loop.step.record_row import ContactRow, Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.loops.reactions import lose_undriven
from closedloop.mechanics.robot.tree import LINK_ROWS, Tree, tree_terms
from closedloop.simulation.engines.loops import ADDRESSES, IN_MEMORY, Addresses

# What `Member.request` is at a control instant, where an action is waited for.
WAITING = -1
# What a number of an action sets: torque of a joint; desired force; displacement of the desired tip along an axis of
# the contact frame; a number of the law's parameters; displacement of a desired joint position.
TORQUE, FORCE, SHIFT, PARAMETER, JOINT = range(5)


class Member(Block):
    """Whole numbers, int64: where the memory of a simulation is, and where it stands."""

    # As `closedloop.simulation.engines.lane_contact.Alone`, whose kernels members in lanes share.
    addresses: int  # see `closedloop.simulation.engines.loops.Addresses`
    strike: int  # address of what computes an impact; 0: Python does
    window: int  # address of the rows that are kept
    links: int  # the robot, see `closedloop.mechanics.robot.tree.Tree`
    constants: int
    constants_size: int
    blocks: int
    once: int
    carrier: int
    serial: int
    balls: int
    scratch: int  # address and size of the scratch of its kernels
    scratch_size: int
    copied: int  # address of rows (from, to, length) of the memory that the mark is a copy of, and how many there are
    copied_count: int
    reading: int  # address of the reading of the force sensor in the mark
    boundary: int  # address of the reference's row at the next control instant, before an action displaced it
    displaced: int  # 1 if one did
    room: int  # how many rows there is room for in the window, and which of all is the first there
    first: int
    keep: int  # how many earlier rows a step may read or write
    begins: int  # the phase that a row begins with
    held: int  # 1 if a torque from outside acts; 0: the scenario's law
    steps: int  # between two control instants
    target: int  # the row of the next control instant
    marked: int  # 1 if the mark is of the latest control instant, AT_MARK if the memory itself is as the mark would be
    known: int  # 1 if the terms are those of the state in the loop's memory
    request: int  # what the loop asked for last
    lanes: int  # 1 if it may be stepped in lanes


class Group(Block):
    """Whole numbers, int64: members that are stepped together, and memory of float64x8 for it.

    See `closedloop.simulation.ensemble.lane_steps`.
    """

    entry: int  # address of what steps them
    mode: int  # of the tips
    filled: int  # how many there are
    members: Annotated[IntArray, WIDE]  # addresses of each `Member`
    numbers: Annotated[IntArray, WIDE]  # which of all members it is
    trees: Annotated[IntArray, WIDE]  # addresses of the constants of the arm that each lane has
    work: int
    constants: int
    terms: int
    tree: int
    row: int
    forces: int
    before: int
    everyone: int  # addresses of all `Member`s, and of what `tell` writes of them
    rows: int
    wanted: int
    between: int


class LaneConstants(Block):
    """Of `closedloop.loop.step.memory.Constants`, what differs between lanes."""

    offset: float
    s_v: float
    s_p: float
    reach: float
    stick_speed: float
    capture_speed: float


class Kept(Block):
    """What is put back where a lane is given up, and what is only asked for once."""

    direction: Annotated[Array, 2]
    slip: Annotated[Array, 2]
    slip_speed: float
    stick_limit: float


class Between(Block):
    """What happened between two control instants, the later one included."""

    largest_force: float  # largest contact force at a row, N
    smallest_force: float
    largest_link_force: float  # largest force along the normal of a [[contact]] at a row, N
    free_rows: float  # rows at which the tip was free
    events: float  # how many there were
    impulse: float  # largest impulse along the normal, N s
    measured: float  # the force sensor's reading as a law has it at the control instant, N
    path_error: float  # distance of the tip from the reference along the surface there, m


MEMBER, BETWEEN, GROUP = Member.count(), Between.count(), Group.count()
AT_MARK = 2
# Eight in lanes take about as long as two by themselves.
FEWEST = 3


@entry_kernel
def strike(address: int, what: int) -> int:
    """Compute the impulses of an impact, as `collide` does; called by address."""
    collide(address)
    return what


@kernel
def copy_memory(m: Member, back: bool) -> None:
    """Copy the loop's memory into the mark, or back."""
    listed = integers_at(m.copied, 3 * m.copied_count)
    for i in range(m.copied_count):
        memory = integers_at(listed[3 * i], listed[3 * i + 2])
        mark = integers_at(listed[3 * i + 1], listed[3 * i + 2])
        if back:
            for j in range(memory.shape[0]):
                memory[j] = mark[j]
        else:
            for j in range(memory.shape[0]):
                mark[j] = memory[j]


@kernel
def go_back(m: Member, state: State) -> None:
    """Put the loop back to just before the row of the latest control instant was recorded."""
    if m.marked != AT_MARK:
        copy_memory(m, True)
    if state.row > 0 and (state.mode != FREE or state.contacts.at != 0):
        state.trial.off = 1  # the step before has been searched, with what acted in it
    state.event.rows, state.batched = 0, 0
    # With encoders other terms have been evaluated since.
    m.known = 1 if state.settings.encoder == 0 and m.marked != AT_MARK else 0
    m.marked = 0


@kernel
def make_room(m: Member, a: Addresses, row: int) -> None:
    """Move the rows before `row` that are still needed to the front, if the next control instant's has no place."""
    if m.target - m.first < m.room:
        return
    width, begin = a.row_width, max(row - m.keep, m.first)
    rows, moved = vector_at(m.window, m.room * width), (begin - m.first) * width
    for i in range((row - begin) * width):
        rows[i] = rows[moved + i]
    m.first = begin
    a.rows = m.window - 8 * begin * width


@kernel
def act(m: Member, a: Addresses, action: Array, plan: IntArray) -> None:
    """Let an action (k,) act until the next control instant.

    `m`, `a`: the member, which stands at a control instant.
    `action` (k,): SI units.
    `plan` (l, 3): what is set (TORQUE ...), at which place, and by which number of the action.
    """
    state, constants, w = loop_at(a.loop)
    n, nodes = a.n, state.settings.nodes_per_step
    table = matrix_at(a.table, a.instants, a.table_width)
    begin, end = (m.target - m.steps) * nodes, m.target * nodes
    boundary = vector_at(m.boundary, 2 * n + 3)
    for i in range(2 * n + 3):  # the last of the rows that were displaced before is displaced by this action instead
        if m.displaced != 0:
            table[begin, i] = boundary[i]
        boundary[i] = table[end, i]
    m.displaced, lost = 0, 0
    for i in range(plan.shape[0]):
        what, place, x = plan[i, 0], plan[i, 1], action[plan[i, 2]]
        if what == TORQUE:
            w.torque[place] = x
            lost = state.settings.undriven
        elif what == FORCE:
            for t in range(begin, end + 1):
                table[t, 2 * n + 9] = x
        elif what == SHIFT:
            m.displaced = 1
            for t in range(begin, end + 1):
                for j in range(3):
                    table[t, 2 * n + j] += x * w.tip.frame[place, j]
        elif what == JOINT:
            m.displaced = 1
            for t in range(begin, end + 1):
                table[t, place] += x
        else:
            constants.law[place] = x
    lose_undriven(constants.undriven, lost, w.torque)


@kernel
def to_target(m: Member, a: Addresses) -> int:
    """Go on until the row of the next control instant is recorded, or something is asked for, and return the request.

    DONE if the row is recorded; else see `closedloop.loop.events.proceed.proceed`.
    """
    state, _, w = loop_at(a.loop)
    n = a.n
    H, C = fortran_at(a.H, n, n), vector_at(a.C, n)
    tree = Tree(
        n, m.blocks, m.once, m.carrier, m.serial, integers_at(m.links, LINK_ROWS * n),
        vector_at(m.constants, m.constants_size), m.balls,
    )  # fmt: skip
    scratch = vector_at(m.scratch, m.scratch_size)
    while True:
        if m.known == 0:
            tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
        m.known = 0
        # At t = 0 only the first time: which events there are then depends on the action.
        if state.phase == m.begins and state.row == m.target and (m.target > 0 or m.marked == 0):
            copy_memory(m, False)
            m.marked = 1
        if m.held != 0:
            state.sampled = 0
        request = call_at(state.proceed, m.addresses, IN_MEMORY)
        if request == TERMS:
            if state.row > m.target:
                return DONE
        elif request == IMPACT_LAW_WANTED and m.strike != 0:
            call_at(m.strike, a.loop, 0)
            m.known = 1  # the impulses are applied with what is in memory
        else:
            return request


@kernel
def write_wanted(m: Member, a: Addresses, row: Array, wanted: Array, between: Array) -> None:
    """Write what is desired at the control instant, and the distance of the tip in `row` from it."""
    state, _, _ = loop_at(a.loop)
    table = matrix_at(a.table, a.instants, a.table_width)
    for j in range(2 * a.n + 10):
        wanted[j] = table[m.target * state.settings.nodes_per_step, j]
    there, desired, out, square = Row(row, a.n), Reference(wanted, a.n), 0.0, 0.0
    for k in range(3):
        out += (there.position[k] - desired.position[k]) * there.surface_normal[k]
    for k in range(3):
        along = there.position[k] - desired.position[k] - out * there.surface_normal[k]
        square += along * along
    Between(between).path_error = np.sqrt(square)


@kernel
def tell(m: Member, a: Addresses, row: Array, wanted: Array, between: Array) -> None:
    """Write the row of the control instant, what is desired there, and `Between`."""
    state, _, _ = loop_at(a.loop)
    n, here = a.n, m.target - m.first
    rows = matrix_at(m.window, m.room, a.row_width)
    for j in range(a.row_width):
        row[j] = rows[here, j]
    write_wanted(m, a, row, wanted, between)
    b = Between(between)
    b.largest_force, b.smallest_force, b.free_rows, b.largest_link_force = -np.inf, np.inf, 0.0, 0.0
    links, at = 0, 0
    if state.contacts.entry != 0:
        contacts, _ = contacts_at(state.contacts.at)
        links, at = contacts.points - 1, contacts.record_at
    for i in range(max(here - m.steps + 1, 0), here + 1):
        each = Row(row_of(rows, i), n)
        b.largest_force = max(b.largest_force, each.contact_force)
        b.smallest_force = min(b.smallest_force, each.contact_force)
        if each.mode == FREE:
            b.free_rows += 1.0
        if links > 0:
            forces = ContactRow(row_of(rows, i)[at:], links).link_forces
            for k in range(links):
                b.largest_link_force = max(b.largest_link_force, forces[k])
    b.events, b.impulse = state.event.rows, 0.0
    b.measured = vector_at(m.reading, 1)[0]
    events = matrix_at(a.events, a.event_room, EVENT_WIDTH)
    for i in range(state.event.rows):
        event = EventRow(row_of(events, i))
        b.impulse = max(b.impulse, event.compression + event.decompression)


@kernel
def step_alone(m: Member, i: int, rows: Array, wanted: Array, between: Array) -> None:
    """Step member `i` to its next control instant, or until it asks for something; see `step_members`."""
    a = Addresses(integers_at(m.addresses, ADDRESSES))
    state, _, _ = loop_at(a.loop)
    make_room(m, a, state.row)
    m.request = to_target(m, a)
    if m.request == DONE:
        tell(m, a, row_of(rows, i), row_of(wanted, i), row_of(between, i))
        m.request = WAITING


@kernel
def step_group(group: int, rows: Array, wanted: Array, between: Array) -> None:
    """Step the members of a group, and those alone that cannot be stepped together, or all if they are too few."""
    g = Group(integers_at(group, GROUP))
    done = call_at(g.entry, group, g.filled) if g.filled >= FEWEST else 0
    for k in range(g.filled):
        if done & (1 << k) == 0:
            step_alone(Member(integers_at(g.members[k], MEMBER)), g.numbers[k], rows, wanted, between)
    g.filled = 0


@entry_kernel
def step_members(
    members: IntArray, going: IntArray, first: int, last: int, actions: Array, plan: IntArray, rows: Array,
    wanted: Array, between: Array, groups: IntArray,
) -> None:  # fmt: skip
    """Step some members to their next control instant, without Python.

    `members` (N, MEMBER): the memory of each.
    `going` (M,): numbers of those that are stepped.
    `first`, `last`: which entries of `going` are dealt with.
    `actions`, `plan`: (N, k) and (l, 3), see `act`; they act where a member stands at a control instant (WAITING).
    `rows`, `wanted`, `between`, (N, ...) arrays: written, see `tell`, of members that reach it. The others'
        `Member.request` says what they ask for.
    `groups` (2,): addresses of groups for tips that slide and tips that stick, whose memory no other thread has; 0:
        there are none.
    """
    for at in range(first, last):
        i = going[at]
        m = Member(row_of(members, i))
        if m.request == WAITING:
            a = Addresses(integers_at(m.addresses, ADDRESSES))
            state, _, _ = loop_at(a.loop)
            go_back(m, state)
            m.target += m.steps
            act(m, a, row_of(actions, i), plan)
            if groups[0] != 0 and m.lanes != 0 and state.mode != FREE and state.approached == 0:
                group = groups[0] if state.mode == PRESSED else groups[1]
                g = Group(integers_at(group, GROUP))
                g.members[g.filled], g.numbers[g.filled] = g.everyone + 8 * MEMBER * i, i
                g.filled += 1
                if g.filled == WIDE:
                    step_group(group, rows, wanted, between)
                continue
        step_alone(m, i, rows, wanted, between)
    for k in range(2 if groups[0] != 0 else 0):
        step_group(groups[k], rows, wanted, between)
