"""The contacts of the links in a step: watched while they are open, else solved, the tip's among them, together.

With H = L Lᵀ, y = L⁻¹(Q − C) of the tree, less what loops bind (`closedloop.loop.step.closed_loops`), and X = L⁻¹Gᵀ of
all contacts, likewise, the acceleration of the contacts is u̇ = X y + drift + X Xᵀ F. An event
(`closedloop.loop.events.contacts`) is dealt with in two parts: impacts, if contacts come together, then at the state
after them the modes.
"""

import math

from closedloop.jit.calls import integers_at, row_of
from closedloop.jit.kernel import kernel, long_loops_entry
from closedloop.loop.step.contact_rows import (
    asked,
    forget_joints,
    locate_contacts,
    locate_joints,
    locate_points,
    locate_stops,
    place_contacts,
    resolution,
)
from closedloop.loop.step.locate import set_anchor
from closedloop.loop.step.memory import Constants, State, Work, loop_at, takes_one_stage
from closedloop.loop.step.tendons import add_along
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK, accelerate
from closedloop.mechanics.closure.solve import LAW_FAILED, OK, PAINLEVE, back_substitute
from closedloop.mechanics.contacts.closed import solve_closed
from closedloop.mechanics.contacts.friction import (
    advance_states,
    cone_limit,
    give_states,
    stops_slipping,
    take_kinetic,
    write_rates,
)
from closedloop.mechanics.contacts.given_modes import (
    keep_in_cones,
    kinds_of_modes,
    solve_modes,
    stopping_impulses,
    write_after,
)
from closedloop.mechanics.contacts.impact import STRUCK_AND_LEFT, STRUCK_AND_STAYED, apply_impulses
from closedloop.mechanics.contacts.memory import (
    CONE,
    DOUBLE,
    LINE,
    OFF,
    RAY,
    SPRING_STICK,
    ContactLinks,
    Contacts,
    contacts_at,
    joints_of,
    joints_rub,
)
from closedloop.mechanics.contacts.modes import closed_depth, decide, open_margin, touches
from closedloop.mechanics.contacts.resistance import has_resistance, is_resistance
from closedloop.mechanics.contacts.rolling import longest_roll, rest_on_feet, rim_margin, rolls, shapes_at
from closedloop.mechanics.contacts.soft import let_friction_rise, soft_margin
from closedloop.mechanics.contacts.stepping import begin_step, look_ahead
from closedloop.mechanics.contacts.time_step import begin_time_step
from closedloop.mechanics.contacts.turning import stop_slips, turn_and_solve
from closedloop.mechanics.impact import energy_lost
from closedloop.mechanics.limits import (
    BREAKING_AWAY,
    CLOSED,
    HOVERING,
    INSTANT,
    ITERATIONS,
    MAX_IN_STEP,
    MOST_OF,
    QUARTER,
    RESTING,
    STICK_SPEED,
    STILL,
    TENTH,
    TOUCHING,
    WEDGED,
)

# What the contacts are asked for.
FORCE, WATCH, SAVE, PLACE, IMPULSE, DECIDE = range(6)
CLOSE_GAPS, CLOSE_RATES, FRICTION_RATES, ADVANCE_FRICTION, ANSWER = range(6, 11)


@long_loops_entry
def contacts_in_step(address: int, what: int) -> int:
    """Answer for the contacts, by the address of their memory; return a status of `closedloop.mechanics.closure.solve`.

    FORCE    write the forces at the state in `Work`, q̈, and the margin of the event function
    WATCH    write the gaps of the links' contacts and of the stops, all of them open, and the least as that margin
    SAVE     keep what a substep begins with
    PLACE    write where the contacts are, and which of them strikes alone
    IMPULSE  apply the impulses of contacts that come together to q̇; `happened` says what
    DECIDE   write the modes after an event or at the start, `happened` likewise, and take what velocity they have not
    CLOSE_GAPS, CLOSE_RATES     write as `column` what moves q, or q̇, onto the contacts; `moved` says whether it is any
    FRICTION_RATES     write the rates of the states of the laws of friction
    ADVANCE_FRICTION   advance these states by `friction_span`
    ANSWER   add to `column`, L⁻¹ of a torque, what the contacts answer in their modes
    """
    links, c = contacts_at(address)
    state, constants, w = loop_at(links.loop)
    status = OK
    if what == FORCE:
        if state.event.stepping != 0 and state.begins != 0:
            look_ahead(c, links.k, left_of_step(w, constants, state))
        status = locate_contacts(links, c, w, constants, state)
        if status == OK:
            status = contact_forces(links, c, w, constants, state)
    elif what == WATCH:
        status = locate_points(links, c, w, constants, state)
        locate_stops(links, c, w, constants)
        c.margin = math.inf
        for i in range(1, links.points + links.stops):
            c.margin = min(c.margin, open_margin(c, i))
        w.contacts.margin = c.margin
    elif what == SAVE:
        c.step.begun = 1.0 * links.stepped
        if state.event.stepping == 0:
            state.event.steady = 0
            save_contacts(links, c)
            w.start.force_over_load = force_over_load(links, c)
        if state.coupled != 0 and state.settings.unilateral != 0:
            state.past_edge = int(c.past_edge[0])
    elif what == PLACE:
        place_contacts(links, c, w)
        state.striking = striking_alone(links, c)
    elif what == IMPULSE:
        if state.striking < 0:
            status = apply_impulses(links, c, constants.rest_speed)
        else:
            apply_impulse_alone(links, c, w, state.striking, state.event.kind == int(STRUCK_AND_LEFT))
        move(links, c, w)
        if links.fresh == 0:
            give_states(links, c, w.z)
    elif what in (CLOSE_GAPS, CLOSE_RATES):
        status = locate_contacts(links, c, w, constants, state)
        if status == OK:
            close_contacts(links, c, w, what == CLOSE_RATES)
    elif what == ANSWER:
        answer_torque(links, c, w)
    elif what == FRICTION_RATES:
        write_rates(links, c, w.dz, w.decays.rate)
    elif what == ADVANCE_FRICTION:
        advance_states(links, c, w.friction.span, w.z)
    else:
        place_contacts(links, c, w)
        soft_closure = c.friction.pulls[0] != 0.0 and c.soft[0] != 0.0  # is no part of the problem of impulses
        status, fixed = PAINLEVE, state.settings.adaptive == 0 and not soft_closure
        crowded = fixed and (state.event.instants > ITERATIONS or state.event.in_step > MAX_IN_STEP)
        if links.chattering < 2 and not crowded:
            locate_joints(links, c, w, constants, state)
            status = decide(links, c, (3.0 if state.settings.adaptive != 0 else 1.0) * constants.stick_speed)
        if status == OK:
            c.step.in_vain = c.step.follows = 0.0
            if links.shapes != 0:
                rest_on_feet(links, c)
        elif status == PAINLEVE and links.fresh == 0:
            status = OK
            if crowded or (fixed and state.event.steady != 0):
                begin_stepping(links, c, state, constants.h)
            else:
                begin_time_step(links, c, w.time)
        forget_joints(links, c)
        move(links, c, w)
        put_at_stops(links, c, w, constants)
        if c.mode[0] == STUCK and c.event.happened[0] != 0.0:
            set_anchor(w, state)
        give_states(links, c, w.z)
    if links.raised != 0:
        state.raised = 1
        return int(LAW_FAILED)
    return int(status)


# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
TIME_STEPPING = 12.0


@kernel
def begin_stepping(links: ContactLinks, c: Contacts, state: State, h: float) -> None:
    """Let steps of impulses follow, the first to the end of this step, until modes stay: they do not last now.

    Friction of other laws than Coulomb's has the level of an impact.
    """
    state.event.stepping, state.event.steady, state.divided, state.event.instants = 1, 0, 0, 0
    c.step.gained = c.step.follows = c.step.in_vain = 0.0
    take_kinetic(links, c)
    told = False
    for i in range(links.k):
        closed = i < links.points + links.stops and c.mode[i] != FREE
        c.gaps.cleared[i] = 1.0 if closed else 0.0  # of open ones `belongs_here` says it
        c.event.happened[i], told = TIME_STEPPING if closed and not told else 0.0, told or closed
    c.event.energy_lost = c.event.energy_rested = 0.0
    for r in range(3 * links.k):
        c.F[r], c.before[r], c.problem.after[r] = 0.0, c.u[r], c.u[r]
        c.step.gained = max(c.step.gained, h * abs(c.a[r]))


@kernel
def close_contacts(links: ContactLinks, c: Contacts, w: Work, rates: bool) -> None:
    """Write as `column` the least change, in the norm of H, of q or q̇ after which what is closed has no error, or rate.

    What sticks as a constraint is put back to where it stuck; what slides, or is held by a spring, onto its surface;
    and what has parted from below its surface, too.
    """
    k, size = links.k, 0.0
    for i in range(k):
        at, held = 3 * i, c.mode[i] == STUCK and c.friction.sticks[i] != SPRING_STICK
        c.problem.form[i], c.problem.along[i, 0], c.problem.along[i, 1] = OFF, 0.0, 0.0
        for j in range(at, at + 3):
            off = c.located[j] - (c.anchor[j] if j > at and i > 0 and not asked(links, i) else 0.0)
            if j > at and links.shapes != 0 and rolls(shapes_at(links.shapes), i):
                off = 0.0
            c.before[j] = c.u[j] if rates else off
        parted = not rates and c.mode[i] == FREE and c.gaps.floor[i] < 0.0 and c.past_edge[i] == 0.0
        if parted and c.located[at] >= -CLOSED:
            c.gaps.floor[i], parted = 0.0, False
        if c.soft[i] == 0.0 and (c.mode[i] != FREE or c.friction.pulls[i] != 0.0 or parted):
            c.problem.form[i] = DOUBLE if held else LINE
            for j in range(at, at + (3 if held else 1)):
                size = max(size, abs(c.before[j]))
    links.moved = 1 if size > CLOSED else 0
    stopping_impulses(links, c)
    answer(links, c, w)


@kernel
def answer_torque(links: ContactLinks, c: Contacts, w: Work) -> None:
    """Add to `column` what the contacts answer in their modes: none while these are sought, or in a time step."""
    if links.undecided != 0 or links.stepped != 0:
        return
    for i in range(links.k):
        c.problem.form[i] = (
            LINE if c.problem.form[i] == RAY else (DOUBLE if c.problem.form[i] == CONE else c.problem.form[i])
        )
        for r in range(3 * i, 3 * i + 3):
            c.before[r] = 0.0
            if (
                r > 3 * i or c.soft[i] == 0.0
            ):  # f of a soft one follows its depth, which a torque does not change at once
                for j in range(links.n):
                    c.before[r] += c.X[r, j] * w.scratch.column[j]
    stopping_impulses(links, c)
    for i in range(3 * links.k):
        for j in range(links.n):
            w.scratch.column[j] += c.X[i, j] * c.F[i]


@kernel
def contact_forces(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> int:
    """Write the forces in the present modes, none while these are not decided, and q̈."""
    n, k, status = links.n, links.k, OK
    if state.begins != 0:
        c.step.span = constants.h if links.shapes == 0 else min(constants.h, longest_roll(links, c))
    if state.event.stepping != 0:
        status = step_forces(links, c, w, constants, state)
        ends = state.settings.time_stepping == 0 and state.event.steady > ITERATIONS
        c.margin = -1.0 if ends else math.inf
    elif links.undecided != 0:
        for i in range(3 * k):
            c.F[i], c.rigid[i] = 0.0, 0.0
        c.margin = -1.0
    elif links.stepped != 0:
        for i in range(3 * k):
            c.F[i] = c.rigid[i] = c.step.force[i]
        c.margin = c.step.end - w.time
        for i in range(k):
            if c.mode[i] == FREE and c.friction.pulls[i] == 0.0:
                c.margin = min(c.margin, open_margin(c, i))
    else:
        kinds_of_modes(links, c)
        if state.settings.adaptive != 0:
            let_friction_rise(c, k)
        status = solve_closed(links, c)
        if (
            c.problem.form[0] == LINE
            and c.rigid[0] < 0.0
            and (c.problem.along[0, 0] != 0.0 or c.problem.along[0, 1] != 0.0)
        ):
            c.problem.along[0, 0], c.problem.along[0, 1] = (
                -c.problem.along[0, 0],
                -c.problem.along[0, 1],
            )  # of a contact that pulls friction is μ|f|
            status = solve_modes(links, c)
        c.problem.sought = 0.0
        begins, fixed = state.begins != 0 and w.time > 0.0, state.settings.adaptive == 0
        points = fixed and links.shapes == 0
        if status == OK:
            h = c.step.span if state.begins != 0 else c.step.within
            status = turn_and_solve(links, c, h if fixed else BREAKING_AWAY, begins and fixed, points)
        keep_in_cones(c, k)
        rest = 2.0 * STICK_SPEED if state.settings.adaptive != 0 else 0.0
        if joints_rub(links):
            rest = max(rest, STILL)  # dry friction of the joints stops a slip within a step, which then does not turn
        c.margin = margin_of(links, c, k, STICK_SPEED, rest, resolution(constants, state))
        if begins and fixed and status == OK and c.margin >= 0.0:
            left = stop_slips(links, c, constants.h)
            if left <= (QUARTER * constants.h if state.settings.stages > 1 else constants.h):
                links.stepped, c.step.end, c.margin = 1, w.time + left, left
                for i in range(3 * k):
                    c.F[i] = c.rigid[i] = c.step.force[i]
            elif left < math.inf:
                c.step.span = MOST_OF * left
                status = turn_and_solve(links, c, c.step.span, begins, points)
                keep_in_cones(c, k)
                c.margin = margin_of(links, c, k, STICK_SPEED, rest, resolution(constants, state))
        wedges = links.stepped == 0 and force_over_load(links, c) > WEDGED
        if (status != OK or wedges) and w.time > 0.0:  # these modes end here: others, or a time step, go on
            status, c.margin = OK, NO_FORCES
    w.contacts.margin, w.contacts.power, w.contacts.power_rate = c.margin, 0.0, 0.0
    for i in range(3):
        w.tip.F[i], w.tip.b[i], w.tip.stabiliser_force[i] = c.F[i], c.b[i], c.F[i] - c.rigid[i]
    w.tip.rigid_force = c.rigid[0]
    for j in range(n):
        w.contacts.torque[j] = 0.0
    torque, y = w.contacts.torque, w.y
    for at in range(3, 3 * k, 3):
        f, f1, f2 = c.F[at], c.F[at + 1], c.F[at + 2]
        if f == 0.0 and f1 == 0.0 and f2 == 0.0:
            continue
        for i in range(at, at + 3):
            w.contacts.power += c.F[i] * (c.u[i] + c.carried[i])
        g0, g1, g2 = row_of(c.G, at), row_of(c.G, at + 1), row_of(c.G, at + 2)
        x0, x1, x2 = row_of(c.X, at), row_of(c.X, at + 1), row_of(c.X, at + 2)
        first, end = joints_of(c, at // 3)
        for j in range(first, end):
            torque[j] += g0[j] * f + g1[j] * f1 + g2[j] * f2
            y[j] += x0[j] * f + x1[j] * f1 + x2[j] * f2
    accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, integers_at(state.addresses.group_ends, state.n))
    for i in range(3, 3 * k if takes_one_stage(state) else 0):
        if c.F[i] == 0.0:
            continue
        growth, row, (first, end) = c.drift[i] - c.turning[i], row_of(c.G, i), joints_of(c, i // 3)
        for j in range(first, end):
            growth += row[j] * w.qdd[j]
        w.contacts.power_rate += c.F[i] * growth
    return status


@kernel
def left_of_step(w: Work, constants: Constants, state: State) -> float:
    """Return how long the step of impulses is that begins, s: what is left of a row's step, or the next row's."""
    left = state.row * constants.h - w.time
    return float(left if left > INSTANT else constants.h)


@kernel
def step_forces(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> int:
    """Write the forces of the step that begins, and what dry friction of joints then is; or again those under way."""
    if state.begins == 0:
        for i in range(3 * links.k):
            c.F[i] = c.rigid[i] = c.step.force[i]
        return OK
    locate_joints(links, c, w, constants, state)
    status, steady = begin_step(links, c, w.y, left_of_step(w, constants, state), constants.rest_speed)
    state.event.steady = state.event.steady + 1 if steady else 0
    if c.step.shifts != 0.0:
        back_substitute(w.L, c.step.shift, 0, links.n)
    for i in range(links.joints, links.k):
        add_along(constants, i - links.joints, c.F[3 * i + 1], w.joint_friction.torque)
        c.u[3 * i + 1] = 0.0
    state.mode = int(c.mode[0])
    return int(status)


# The margin where no forces go with the modes.
NO_FORCES = -1e30


@kernel
def margin_of(links: ContactLinks, c: Contacts, k: int, slow: float, rest: float, h: float) -> float:
    """Return what is left until the mode of a contact ends: a gap, m, a force, N, or a speed of slip, m/s.

    Or until a disc stands, or rolls, which steps of h, s, resolve (`closedloop.mechanics.contacts.rolling`).

    Slip ends at the speed `rest`, m/s: 0 with steps of fixed length, if no dry friction of joints stops it. An
    integrator that chooses its steps would need endlessly many for the turns of the direction at the very end. One that
    is slower than `slow` has begun, or fades away.
    """
    least = rim_margin(links, c, h) if links.shapes != 0 else math.inf
    depth, shared = closed_depth(links, c), c.problem.beyond > 0.0  # forces that are shared are inside, or all end
    inside = max(c.problem.rounding, c.problem.borne) - c.problem.beyond if shared else c.problem.rounding
    for i in range(k):
        n = 3 * i
        if c.friction.pulls[i] == 0.0:
            if c.mode[i] == FREE:
                least = min(least, open_margin(c, i, depth))
                continue
            own = 0.0 if shared else c.rigid[n]
            least = min(least, own + inside if c.soft[i] == 0.0 else soft_margin(c, i))
        least = min(least, c.inside[i])
        if c.mode[i] == STUCK:
            left = cone_limit(c, i) * abs(c.rigid[n]) - math.hypot(c.rigid[n + 1], c.rigid[n + 2])
            least = min(least, (0.0 if shared else left) + inside)
        elif stops_slipping(c, i) and c.friction.shared[i] == 0.0:
            along = c.u[n + 1] * c.direction[i, 0] + c.u[n + 2] * c.direction[i, 1]
            start = c.friction.start_slip[i]
            end = max(rest, c.friction.capture[i] if start > c.friction.capture[i] else 0.0)
            if start <= STILL:
                end = -slow
            elif start <= max(slow, rest):
                end = TENTH * start
            least = min(least, along - end)
    return float(least)


@kernel
def striking_alone(links: ContactLinks, c: Contacts) -> int:
    """Return the contact that strikes while no other is closed or closes, −1 if there is none such."""
    alone = -1
    for i in range(links.k):
        if c.soft[i] != 0.0 or is_resistance(c, i):
            continue
        if c.friction.pulls[i] != 0.0 or (touches(links, c, i) and (alone >= 0 or c.mode[i] != FREE)):
            return -1
        if touches(links, c, i):
            alone = i
    if alone < 0 or alone >= links.points or has_resistance(c, alone) or not c.u[3 * alone] < -RESTING:
        return -1
    return alone


@kernel
def apply_impulse_alone(links: ContactLinks, c: Contacts, w: Work, i: int, leaves: bool) -> None:
    """Write what the impulse of a contact that strikes alone does, which `collide` has left in `Work`."""
    k, at = links.k, 3 * i
    for j in range(3 * k):
        c.F[j], c.before[j] = 0.0, c.u[j]
    for j in range(k):
        c.event.happened[j], c.event.struck[j], c.event.pulled[j], c.event.outside[j] = 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        c.F[at + j] = w.impact.compression[j] + w.impact.decompression[j]
    write_after(c, k)
    c.event.energy_lost, c.event.restitution_share, c.event.struck[i] = (
        energy_lost(w.impact.before, w.impact.after, c.F[at : at + 3]),
        1.0,
        1.0,
    )
    c.event.energy_rested = w.impact.energy_rested
    c.event.happened[i] = STRUCK_AND_LEFT if leaves else STRUCK_AND_STAYED
    c.mode[i], c.gaps.cleared[i], c.gaps.floor[i] = FREE if leaves else PRESSED, 1.0, min(c.located[at], 0.0)


@kernel
def save_contacts(links: ContactLinks, c: Contacts) -> None:
    """Keep speed and direction of the slips at the beginning of a substep, and which contacts have come clear."""
    c.step.within = c.step.span
    for i in range(links.k):
        c.friction.against[i] = c.friction.next_against[i]
        if c.located[3 * i] > HOVERING:
            c.gaps.cleared[i], c.gaps.floor[i], c.gaps.unloaded[i], c.past_edge[i] = 1.0, 0.0, 0.0, 0.0
            if c.mode[i] == FREE:
                continue
        speed = math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])
        c.friction.start_slip[i], c.friction.start_u[i, 0], c.friction.start_u[i, 1] = (
            speed,
            c.u[3 * i + 1],
            c.u[3 * i + 2],
        )
        if c.mode[i] == PRESSED and speed > (STICK_SPEED if c.friction.rises == 0.0 else STILL):
            c.direction[i, 0], c.direction[i, 1] = c.u[3 * i + 1] / speed, c.u[3 * i + 2] / speed


@kernel
def force_over_load(links: ContactLinks, c: Contacts) -> float:
    """Return the largest force of rigid contacts that are closed, over that which would stop their accelerations.

    It grows without bound on the way to Painlevé's paradox. Where none slides there is none: zero.
    """
    largest, asked, most, slides = 0.0, 0.0, 0.0, 0.0
    for i in range(links.points + links.stops):
        for j in range(3 * i, 3 * i + 3 if c.soft[i] == 0.0 and c.mode[i] != FREE else 0):
            largest, asked = max(largest, abs(c.rigid[j])), max(asked, abs(c.a[j]))
            most = max(most, c.S[i, j % 3, j % 3])
        if c.mode[i] == PRESSED and c.mu[i] > 0.0:
            slides = 1.0
    return float(slides * largest * most / asked) if asked > 0.0 else 0.0


@kernel
def move(links: ContactLinks, c: Contacts, w: Work) -> None:
    """Add to q̇ what the impulses F of the contacts make of it."""
    answer(links, c, w)
    for j in range(links.n):
        w.v[j] += w.scratch.column[j]


@kernel
def put_at_stops(links: ContactLinks, c: Contacts, w: Work, constants: Constants) -> None:
    """Put joints that are at their stops, but for the rounding of an instant, exactly there."""
    for i in range(links.points, links.points + links.stops):
        j = int(c.joint[i])
        if j < links.n and c.mode[i] != FREE and abs(c.located[3 * i]) <= TOUCHING:
            w.q[j] = constants.lower_stop[j] if c.side[i] > 0.0 else constants.upper_stop[j]


@kernel
def answer(links: ContactLinks, c: Contacts, w: Work) -> None:
    """Write as `column` what the impulses F of the contacts make of q̇, L⁻ᵀ Xᵀ F."""
    for j in range(links.n):
        s = 0.0
        for i in range(3 * links.k):
            s += c.X[i, j] * c.F[i]
        w.scratch.column[j] = s
    back_substitute(w.L, w.scratch.column, 0, links.n)
