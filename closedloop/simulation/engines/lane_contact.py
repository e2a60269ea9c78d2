"""The contact of eight tips in SIMD lanes, of which each may be free, slide or stick, and its record.

The kernels are those of a run by itself; what lanes do not share (friction, a soft surface, one that is curved or
moves) is asked lane by lane, in the memory of each run's loop. A number for each lane says whether its run surely goes
on as it is: what is tested for here may be less than an event, never more.
"""

from typing import Any

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.calls import call_at, integers_at, matrix_at
from closedloop.jit.inside.simd8 import lane, lane_at, put_at, with_lane
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import WIDE, every, select
from closedloop.loop.events.locate import slip_margin
from closedloop.loop.events.substep import save_slip
from closedloop.loop.step.locate import locate_on_plane, locate_on_surface, off_anchor, take_answer
from closedloop.loop.step.memory import SMOOTH, Constants, Start, State, TipContact, Work
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
from closedloop.mechanics.limits import HOVERING, NEAR, RESTING
from closedloop.mechanics.surface.contact import CONTACT, FOUND, ask_at
from closedloop.simulation.engines.lane_members import WINDOW, Kept, alone_at
from closedloop.simulation.engines.proceed import ADDRESSES, Addresses

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
