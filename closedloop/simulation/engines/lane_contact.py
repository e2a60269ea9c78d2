"""The contact of eight tips in SIMD lanes, of which each may be free, slide or stick, and its record.

The kernels are those of a run by itself; what lanes do not share (friction, a soft surface, one that is curved or
moves) is asked lane by lane, in the memory of each run's loop. A number for each lane says whether its run surely goes
on as it is: what is tested for here may be less than an event, never more.

Where a run does what the lanes cannot, events and all that is about one, it goes by itself. Each lane has the memory of
its run's loop. There the plug-ins that are called by address answer, one run after the other. A lane in which something
may happen goes back to its last row, from which its loop goes on by itself to the next; then the lane has the state
that its loop has. So every number is that of the run by itself.
"""

from typing import Annotated, Any

from closedloop.base.arrays import Array, IntArray
from closedloop.control.reference.desired import Reference
from closedloop.jit.blocks import Block
from closedloop.jit.calls import call_at, fortran_at, integers_at, matrix_at, row_of, vector_at
from closedloop.jit.inside.simd8 import lane, lane_at, put_at, with_lane
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import WIDE, every, select
from closedloop.loop.events.locate import DONE, IMPACT_LAW_WANTED, NO_TRIAL, STEP_END, TERMS, request_terms, slip_margin
from closedloop.loop.events.substep import save_slip
from closedloop.loop.step.locate import locate_on_plane, locate_on_surface, off_anchor, take_answer
from closedloop.loop.step.memory import SMOOTH, Constants, N, Start, State, TipContact, Work, loop_at
from closedloop.loop.step.record_row import Row, write_columns
from closedloop.loop.step.solve_contact import slide_slowly
from closedloop.loop.step.tip_friction import surface_friction
from closedloop.mechanics.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    baumgarte_acceleration,
    pressed_force,
    stuck_force,
)
from closedloop.mechanics.closure.solve import OK, closure_residual
from closedloop.mechanics.friction.answers import LIMIT
from closedloop.mechanics.limits import HOVERING, NEAR, OUTPACED, RESTING
from closedloop.mechanics.robot.tree import Tree, tree_terms
from closedloop.mechanics.surface.contact import CONTACT, FOUND, ask_at
from closedloop.simulation.engines.loops import ADDRESSES, IN_MEMORY, Addresses


class Alone(Block):
    """Whole numbers, int64: where the memory of a run's loop is, and where it stands."""

    addresses: int  # see `closedloop.simulation.engines.loops.Addresses`
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

    `tree`, `scratch`: its robot, and scratch for its terms.
    `w`, `kept`: of the lanes, which have stepped from the row before, or have begun to.
    `members` (8,): addresses of the `Alone` of each lane.
    `forces` (P,): desired forces of each lane, N, at the instants of the table.
    `h`: step, s.
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


# A square is compared with a square, to leave out what is nearer to a bound than this share: its rounding.
NEARLY = 1e-9
# Places in records, before all that a number of joints moves.
GAP, RATE, INSIDE = (TipContact.place(name, 1) for name in ("gap", "rate", "inside"))
SLIP_SPEED = Start.place("slip_speed", 1, 0)


@kernel_inlined
def locate_tips(w: Work, constants: Constants, members: IntArray, asked: bool, t: float, h: float) -> Array:
    """Write the motion of the tips in their contact frames; return for each lane 1 where there is a frame, else 0."""
    found = 0.0 * w.r[0] + 1.0
    if not asked:
        locate_on_plane(w, constants)
        return found
    for k in range(3):
        speed = 0.0
        for j in range(w.v.shape[0]):
            speed += w.J[k, j] * w.v[j]
        w.scratch.target[k] = speed
    for i in range(WIDE):
        found = with_lane(found, i, 1.0 if ask_surface_of(w, members, i, t, h) else 0.0)
    locate_on_surface(w)
    return found


@kernel
def ask_surface_of(w: Work, members: IntArray, i: int, t: float, h: float) -> bool:
    """Ask the surface of lane `i` how its tip, with the velocity in `target`, is to it; see `ask_surface`."""
    _, state, _, own = alone_at(members, i)
    links, ask = ask_at(state.surface.at)
    ask.time = t
    for k in range(3):
        ask.r[k], ask.velocity[k] = lane_at(w.r, k, i), lane_at(w.scratch.target, k, i)
    if call_at(state.surface.entry, links.address, CONTACT) != FOUND or not take_answer(own, h, state):
        return False
    put_at(w.tip.memory, GAP, i, own.tip.gap)
    put_at(w.tip.memory, INSIDE, i, own.tip.inside)
    for k in range(3):
        put_at(w.tip.carried, k, i, own.tip.carried[k])
        put_at(w.tip.turning, k, i, own.tip.turning[k])
        for j in range(3):
            put_at(w.tip.frame, 3 * k + j, i, own.tip.frame[k, j])
    return True


@kernel
def ask_friction_of(w: Work, members: IntArray, i: int) -> None:
    """Ask the friction of lane `i` at the slip that it has."""
    alone, state, constants, own = alone_at(members, i)
    own.tip.u[1], own.tip.u[2] = lane_at(w.tip.u, 1, i), lane_at(w.tip.u, 2, i)
    width = Addresses(integers_at(alone.addresses, ADDRESSES)).row_width
    surface_friction(own, constants, state, matrix_at(alone.window, WINDOW, width))
    for k in range(2):
        put_at(w.friction.c, k, i, own.friction.c[k])
        put_at(w.friction.viscous, k, i, own.friction.viscous[k])


@kernel
def slide_slowly_of(w: Work, members: IntArray, i: int) -> bool:
    """Turn the friction of lane `i`, whose slip may be slow, with its F; return whether there is a solution."""
    _, _, constants, own = alone_at(members, i)
    for k in range(3):
        own.tip.a[k], own.tip.F[k] = lane_at(w.tip.a, k, i), lane_at(w.tip.F, k, i)
        for j in range(3):
            own.tip.S[k, j] = lane_at(w.tip.S, 3 * k + j, i)
    for k in range(2):  # a lane that nothing uses has the memory of another, in which this has been done already
        own.friction.c[k] = lane_at(w.friction.c, k, i)
    b, share = lane_at(w.tip.b, 0, i), lane_at(w.tip.stabiliser_force, 0, i)
    status, share = slide_slowly(b, share, own, constants.h)
    put_at(w.tip.stabiliser_force, 0, i, share)
    for k in range(3):
        put_at(w.tip.F, k, i, own.tip.F[k])
    for k in range(2):
        put_at(w.friction.c, k, i, own.friction.c[k])
    return status == OK


@kernel
def ask_depth_of(w: Work, members: IntArray, i: int) -> None:
    """Ask the soft surface of lane `i` for the force at the depth that it has."""
    _, state, _, own = alone_at(members, i)
    own.tip.gap, own.tip.rate = lane_at(w.tip.memory, GAP, i), lane_at(w.tip.memory, RATE, i)
    call_at(state.compliance.entry, state.address, 0)
    put_at(w.tip.F, 0, i, own.tip.F[0])


@kernel
def save_slip_of(w: Work, members: IntArray, i: int) -> None:
    """Save the slip of lane `i` at the beginning of a step, in its run's memory and in the lane."""
    _, state, constants, own = alone_at(members, i)
    own.tip.u[1], own.tip.u[2] = lane_at(w.tip.u, 1, i), lane_at(w.tip.u, 2, i)
    save_slip(own, constants, state)
    put_at(w.start.memory, SLIP_SPEED, i, own.start.slip_speed)
    for k in range(2):
        put_at(w.friction.direction, k, i, own.friction.direction[k])


@kernel
def off_anchor_of(w: Work, members: IntArray, i: int) -> None:
    """Write to `target` how far the tip of lane `i` is from where it stuck, along both tangents."""
    _, state, _, own = alone_at(members, i)
    for k in range(1, 3):
        own.tip.p[k] = lane_at(w.tip.p, k, i)
        put_at(w.scratch.target, k, i, off_anchor(own, state, k))


@kernel_inlined
def hold_tips(
    w: Work, constants: Constants, state: State, kept: Kept, members: IntArray, h: float
) -> tuple[int, Array]:
    """Write F and its parts; return a status, and for each lane 1 where its mode surely goes on at this stage, else 0.

    See `closedloop.loop.step.solve_contact.contact_force`, of which this is the part without an event.
    """
    tip, friction = w.tip, w.friction
    S, F, rubs, soft = tip.S, tip.F, state.friction.sticking != SMOOTH, state.compliance.entry != 0
    touching, stuck, unilateral = kept.mode > FREE + 0.5, kept.mode > PRESSED + 0.5, state.settings.unilateral != 0
    goes_on = 0.0 * S[0, 0] + 1.0
    none = 0.0 * goes_on
    for k in range(3):
        tip.b[k] = tip.stabiliser_force[k] = none
    for i in range(WIDE if rubs else 0):
        ask_friction_of(w, members, i)
    if soft:
        for i in range(WIDE):
            ask_depth_of(w, members, i)
        F[1], F[2] = -friction.c[0] * F[0] - friction.viscous[0], -friction.c[1] * F[0] - friction.viscous[1]
        goes_on = select(stuck, none, goes_on)
        if unilateral:
            goes_on = select((tip.gap <= 0.0) | (tip.rate <= 0.0), goes_on, 0.0)
    else:
        tip.b[0] = baumgarte_acceleration(constants.s_v, constants.s_p, tip.rate, tip.gap)
        status, tip.stabiliser_force[0] = pressed_force(S, tip.a, tip.b[0], friction.c, friction.viscous, F)
        if status != OK:
            return status, none
        goes_on = select(S[0, 0] > NEAR * (S[0, 0] + S[1, 1] + S[2, 2]), goes_on, 0.0)
    if rubs or unilateral:
        goes_on = select(F[0] >= 0.0, goes_on, 0.0)
    if rubs:
        pull = friction.c[0] * friction.c[0] + friction.c[1] * friction.c[1]
        reach = h * F[0] * (S[1, 1] + S[2, 2])  # see `closedloop.mechanics.friction.turning.turn_friction`
        speed = tip.u[1] * tip.u[1] + tip.u[2] * tip.u[2]
        fast = select(stuck | (reach * reach * pull < speed * (1.0 - NEARLY)), goes_on, 0.0)
        for i in range(WIDE if not every(fast > 0.5) else 0):
            slow = lane(fast, i) < 0.5 < lane(goes_on, i) and lane(kept.mode, i) > FREE + 0.5
            if slow and (soft or not slide_slowly_of(w, members, i)):
                goes_on = with_lane(goes_on, i, 0.0)
        if not soft and not every(kept.mode < PRESSED + 0.5):
            status = stick_tips(w, constants, state, members, stuck)
            if status != OK:
                return status, none
    if unilateral and not soft:
        goes_on = select((F[0] >= 0.0) & (F[0] - tip.stabiliser_force[0] >= 0.0), goes_on, 0.0)
    if not every(touching):
        goes_on = select(touching, goes_on, 1.0)
        for k in range(3):
            F[k], tip.b[k] = select(touching, F[k], 0.0), select(touching, tip.b[k], 0.0)
            tip.stabiliser_force[k] = select(touching, tip.stabiliser_force[k], 0.0)
    return OK, goes_on


@kernel_inlined
def stick_tips(w: Work, constants: Constants, state: State, members: IntArray, stuck: Any) -> int:
    """Write F and its parts of the tips that stick; return a status."""
    tip, off, force, share = w.tip, w.scratch.target, w.scratch.force, w.scratch.unused
    for k in range(1, 3):
        off[k] = tip.p[k] - tip.anchor[k]
    for i in range(WIDE if state.surface.entry != 0 else 0):
        off_anchor_of(w, members, i)
    for k in range(1, 3):
        tip.b[k] = select(stuck, baumgarte_acceleration(constants.s_v, constants.s_p, tip.u[k], off[k]), 0.0)
    status = stuck_force(tip.S, tip.a, tip.b, force, share)
    for k in range(3):
        tip.F[k] = select(stuck, force[k], tip.F[k])
        tip.stabiliser_force[k] = select(stuck, share[k], tip.stabiliser_force[k])
    return status


@kernel_inlined
def passed_rows(w: Work, constants: Constants, state: State, kept: Kept, h: float) -> Array:
    """Return for each lane 1 where no event has happened in the step before this row, else 0.

    See `closedloop.loop.events.locate.event_function` and `closedloop.loop.events.substep.check_step`.
    """
    tip, F = w.tip, w.tip.F
    touching, stuck = kept.mode > FREE + 0.5, kept.mode > PRESSED + 0.5
    goes_on = 0.0 * F[0] + 1.0
    if state.friction.sticking != SMOOTH:
        limit, size = kept.limit * F[0], F[1] * F[1] + F[2] * F[2]
        held = limit * limit * (1.0 - NEARLY) > size
        slides = (kept.mode < PRESSED + 0.5) & (slip_margin(w, constants) > 0.0)
        goes_on = select((stuck & held) | slides, goes_on, 0.0)
    if state.surface.entry != 0:
        goes_on = select(tip.inside > 0.0, goes_on, 0.0)
    if not every(touching):
        leaving = HOVERING + (h * h * abs(tip.drift_c[0]) if state.settings.stages == 1 else 0.0 * h)
        turns = (w.start.rate < -RESTING) & (tip.rate > 0.0)
        goes_on = select(touching, goes_on, select((tip.gap > leaving), select(turns, 0.0 * F[0], 1.0), 0.0))
    return goes_on


@kernel_inlined
def write_rows(H: Array, C: Array, w: Work, state: State, kept: Kept, row: Row) -> Any:
    """Do as `closedloop.loop.step.record_row.write_row`, for tips of different modes."""
    write_columns(H, C, w, state, row)
    row.mode = kept.mode
    closed = (kept.mode > FREE + 0.5) & (w.tip.S[0, 0] > 0.0)
    if state.compliance.entry != 0:
        closed = w.tip.S[0, 0] < 0.0
    row.residual_closure = select(closed, closure_residual(w.qdd, w.tip, (0, 1)), 0.0)
    if not every(kept.mode < PRESSED + 0.5):
        all_three = closure_residual(w.qdd, w.tip, (0, 3))
        row.residual_closure = select(kept.mode > STUCK - 0.5, all_three, row.residual_closure)
    return closed


@kernel_inlined
def keep_start(w: Work, kept: Kept, members: IntArray, state: State) -> None:
    """Keep where a step begins, as `closedloop.loop.events.substep.save_state` does; its state is kept already."""
    kept.slip_speed, kept.rate, kept.energy = w.start.slip_speed, w.start.rate, w.supply.energy
    for j in range(w.q.shape[0]):
        kept.torque[j] = w.torque[j]
    w.start.rate = w.tip.rate
    if state.friction.sticking != SMOOTH:
        for k in range(2):
            kept.direction[k] = w.friction.direction[k]
        for i in range(WIDE):
            save_slip_of(w, members, i)
