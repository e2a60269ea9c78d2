"""A run of a lane as it goes by itself, where it does what the lanes cannot: events, and all that is about one.

Each lane has the memory of its run's loop. There the plug-ins that are called by address answer, one run after the
other. A lane in which something may happen goes back to its last row, from which its loop goes on by itself to the
next; then the lane has the state that its loop has. So every number is that of the run by itself.
"""

from typing import Annotated

from closedloop.base.arrays import Array, IntArray
from closedloop.control.reference.table import Reference
from closedloop.jit.blocks import Block
from closedloop.jit.calls import call_at, fortran_at, integers_at, matrix_at, row_of, vector_at
from closedloop.jit.inside.simd8 import lane, lane_at, put_at, with_lane
from closedloop.jit.kernel import kernel
from closedloop.jit.simd8 import WIDE
from closedloop.loop.events.phases import DONE, IMPACT_LAW_WANTED, NO_TRIAL, STEP_END, TERMS, request_terms
from closedloop.loop.step.memory import Constants, N, State, Work, loop_at
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import STUCK
from closedloop.mechanics.friction.answers import LIMIT
from closedloop.mechanics.limits import OUTPACED
from closedloop.mechanics.robot.tree import Tree, tree_terms
from closedloop.simulation.engines.proceed import ADDRESSES, IN_MEMORY, Addresses


class Alone(Block):
    """Whole numbers, int64: where the memory of a run's loop is, and where it stands."""

    addresses: int  # see `closedloop.simulation.engines.proceed.Addresses`
    strike: int  # address of what computes an impact, see `closedloop.simulation.ensemble.member.strike`
    window: int  # address of its first row and its two latest
    row: int  # the latest
    stands: int  # 1 while the loop's memory goes on from that row; 0: the lane is ahead of it


ALONE = Alone.count()
# Rows of a loop that are kept: the first, and the two latest.
WINDOW = 3


class Kept(Block, sizes=("n",)):
    """What of the latest row that was reached in lanes its loop would go on from, as it was before that row."""

    mode: float  # of the tip's contact
    limit: float  # of sticking, see `closedloop.loop.step.memory.TipFriction`
    direction: Annotated[Array, 2]  # of slip
    slip_speed: float  # at the beginning of the step before, m/s, as the next
    rate: float  # of the gap
    energy: float  # supplied, J
    torque: Annotated[Array, N]  # which may be held


@kernel
def alone_at(members: IntArray, i: int) -> tuple[Alone, State, Constants, Work]:
    """Return where the run of lane `i` goes by itself, and the memory of its loop."""
    alone = Alone(integers_at(members[i], ALONE))
    state, constants, own = loop_at(Addresses(integers_at(alone.addresses, ADDRESSES)).loop)
    return alone, state, constants, own


@kernel
def go_on(tree: Tree, scratch: Array, alone: Alone, forces: Array, i: int, target: int) -> bool:
    """Let the run of lane `i` go on by itself until its row `target` is recorded; False if it cannot.

    Its table is of other runs too, with other forces: its own, in a lane of `forces`, are put there first.
    """
    a = Addresses(integers_at(alone.addresses, ADDRESSES))
    state, _, w = loop_at(a.loop)
    n, nodes, before = a.n, state.settings.nodes_per_step, max(target - 1, 0)
    H, C = fortran_at(a.H, n, n), vector_at(a.C, n)
    table = matrix_at(a.table, a.instants, a.table_width)
    for k in range(before * nodes, target * nodes + 1):
        Reference(row_of(table, k), n).force = lane(forces[k], i)
    a.rows, state.batched, known = alone.window - 8 * (before - min(target, 1)) * a.row_width, 0, False
    while state.row <= target:
        if not known:
            tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
        request = call_at(state.proceed, alone.addresses, IN_MEMORY)
        known = request == IMPACT_LAW_WANTED
        if known:
            call_at(alone.strike, a.loop, 0)  # it is applied with what is in memory
        elif request == DONE:
            break
        elif request != TERMS:
            return False
    alone.row, alone.stands = target, 1
    return True


@kernel
def go_back(w: Work, kept: Kept, alone: Alone, state: State, own: Work, h: float, i: int, row: int) -> None:
    """Put the loop of lane `i`'s run back to just before the row from which the lanes have stepped.

    The numbers are those in lane `i` of `w.start` and of what was kept there; where nothing has happened since the
    loop stood somewhere, all else is as it was.
    """
    n = own.q.shape[0]
    for j in range(n):
        own.q[j], own.v[j] = lane_at(w.start.state, j, i), lane_at(w.start.state, n + j, i)
        own.torque[j] = lane_at(kept.torque, j, i)
    for k in range(2):
        own.friction.direction[k] = lane_at(kept.direction, k, i)
    own.start.slip_speed, own.start.rate = lane(kept.slip_speed, i), lane(kept.rate, i)
    own.supply.energy, own.supply.work = lane(kept.energy, i), 0.0
    own.time, own.length, own.search.tau, own.start.time = row * h, h, h, (row - 1) * h
    passed, counted = row - 1 - alone.row, state.event.in_step
    if passed >= 0 or counted > 0:  # a count of zero may have been anything that a row takes off
        state.event.in_step = max(counted - OUTPACED * passed, 0)
    state.row, state.stage, state.after_event, state.divided, state.approached = row, 0, 0, 0, 0
    state.trial.purpose, state.trial.watched, state.trial.off = NO_TRIAL, 0, 0
    request_terms(state, STEP_END)


@kernel
def take_state(w: Work, kept: Kept, alone: Alone, state: State, own: Work, i: int) -> None:
    """Put the state in which a loop has recorded its latest row into lane `i`."""
    n, ended = own.q.shape[0], state.row == alone.row
    for j in range(n):
        put_at(w.q, j, i, own.q[j] if ended else own.start.state[j])
        put_at(w.v, j, i, own.v[j] if ended else own.start.state[n + j])
        put_at(w.torque, j, i, own.torque[j])
    for k in range(2):
        put_at(w.friction.direction, k, i, own.friction.direction[k])
    for k in range(3):
        put_at(w.tip.anchor, k, i, own.tip.anchor[k])
    w.start.slip_speed = with_lane(w.start.slip_speed, i, own.start.slip_speed)
    w.start.rate = with_lane(w.start.rate, i, own.start.rate)
    w.supply.energy, w.supply.work = with_lane(w.supply.energy, i, own.supply.energy), with_lane(w.supply.work, i, 0.0)
    kept.mode = with_lane(kept.mode, i, 1.0 * state.mode)
    if state.mode == STUCK:
        call_at(state.friction.entry, state.address, LIMIT)
        kept.limit = with_lane(kept.limit, i, own.friction.stick_limit)


@kernel
def take_row(w: Work, members: IntArray, row: Row, i: int, place: int) -> None:
    """Put row `place` into lane `i` as its loop has recorded it, if it has, and what acts from there on."""
    alone, _, _, own = alone_at(members, i)
    if alone.row != place:
        alone.stands = 0
        return
    recorded = matrix_at(alone.window, WINDOW, row.memory.shape[0])[2 * min(place, 1)]
    for j in range(row.memory.shape[0]):
        put_at(row.memory, j, i, recorded[j])
    for j in range(own.q.shape[0]):
        put_at(w.qdd, j, i, own.start.slope[j])
    w.supply.power = with_lane(w.supply.power, i, own.supply.power)
    w.supply.power_rate = with_lane(w.supply.power_rate, i, own.supply.power_rate)


@kernel
def first_of(members: IntArray, i: int) -> bool:
    """Whether no lane before `i` has the same run: lanes that nothing uses repeat the first."""
    return i == 0 or members[i] != members[0]


@kernel
def go_alone(
    tree: Tree, scratch: Array, w: Work, kept: Kept, members: IntArray, forces: Array, h: float, i: int, target: int
) -> bool:
    """Let the run of lane `i` go by itself from the row that it has reached to the next, `target`; False if it cannot.

    Parameters
    ----------
    tree, scratch
        Its robot, and scratch for its terms.
    w, kept
        Of the lanes, which have stepped from the row before, or have begun to.
    members : (8,) array of int
        Addresses of the `Alone` of each lane.
    forces : (P,) array
        Desired forces of each lane, N, at the instants of the table.
    h : float
        Step, s.
    """
    alone, state, _, own = alone_at(members, i)
    if alone.stands == 0:
        go_back(w, kept, alone, state, own, h, i, target - 1)
    if not go_on(tree, scratch, alone, forces, i, target):
        return False
    for k in range(i, WIDE):
        if members[k] == members[i]:
            take_state(w, kept, alone, state, own, k)
    return True
