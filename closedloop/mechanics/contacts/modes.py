"""The modes of contacts after an event: those with which accelerations and forces agree.

Of the contacts that touch without velocity along the normal, those that slide have a direction, and those that do not
are in Coulomb's cone, with the acceleration in place of the velocity (P. Lötstedt, SIAM J. Appl. Math. 42, 1982). The
problem of `closedloop.mechanics.contacts.unknown_modes` says which of them part, which slide, and which stick.
"""

import math

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE
from closedloop.mechanics.contacts.friction import has_law, slide, stick_as_spring, stops_slipping, write_limits
from closedloop.mechanics.contacts.given_modes import energy_gained, stop
from closedloop.mechanics.contacts.memory import (
    CONE,
    DOUBLE,
    INSIDE,
    LINE,
    OFF,
    RAY,
    SPRING_STICK,
    ContactLinks,
    Contacts,
)
from closedloop.mechanics.contacts.mobility import added, write_motion
from closedloop.mechanics.contacts.resistance import form_of_resistance, is_resistance, mode_of_resistance
from closedloop.mechanics.contacts.soft import soft_gap, write_shared
from closedloop.mechanics.contacts.unknown_modes import solve_contacts
from closedloop.mechanics.limits import (
    BEYOND_EDGE,
    CLOSED,
    DEPENDENT,
    FOUND,
    HOVERING,
    OFF_SURFACE,
    RESTING,
    STICK_SPEED,
    TOUCHING,
    WEDGED,
)

# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
CAME, LEFT, STUCK_NOW, SLIPPED, TURNED_ROUND = 2.0, 3.0, 4.0, 5.0, 6.0


@kernel
def touches(links: ContactLinks, c: Contacts, i: int) -> bool:
    """Whether a contact is closed, or about to be."""
    if c.past_edge[i] != 0.0:
        return False
    return bool(c.mode[i] != FREE or c.located[3 * i] <= (HOVERING if links.fresh != 0 else TOUCHING))


@kernel
def closed_depth(links: ContactLinks, c: Contacts) -> float:
    """Return the least gap of the rigid contacts that are closed, m, zero if none is below its surface."""
    least = 0.0
    for i in range(links.points + links.stops):
        if c.mode[i] != FREE and c.soft[i] == 0.0:
            least = min(least, c.located[3 * i])
    return float(least)


@kernel
def open_margin(c: Contacts, i: int, depth: float = 0.0) -> float:
    """Return what is left until contact i, which is open, closes, m; beside its surface until it comes back onto it.

    A contact that has parted and not been clear since goes with the error of a step: it may sink as deep, `depth`, as
    the contacts that are closed.
    """
    if c.past_edge[i] != 0.0:
        back = c.located[3 * i] >= -BEYOND_EDGE and c.inside[i] < math.inf
        return float(HOVERING - c.inside[i]) if back else math.inf
    if c.gaps.cleared[i] != 0.0:
        return float(c.located[3 * i] - c.gaps.floor[i] + CLOSED)
    return float(c.located[3 * i] - depth - min(-OFF_SURFACE, c.gaps.floor[i] - CLOSED))


@kernel
def near(c: Contacts, i: int) -> bool:
    """Whether a contact is closed, or so near that it may close."""
    return bool(c.mode[i] != FREE or c.located[3 * i] <= c.step.reach)


@kernel
def decide(links: ContactLinks, c: Contacts, slow: float) -> int:
    """Write the modes of all contacts, what happened to each, and in F the impulses that remove what is left of motion.

    Returns OK, or PAINLEVE if no forces in the cones were found, with any modes.
    """
    k = links.k
    write_limits(links, c)
    size = choose_kinds(links, c, slow)
    write_motion(c, k, c.viscous)
    for r in range(3 * k):
        c.F[r], c.problem.q[r] = 0.0, c.a[r] - added(c, r)
    found = solve_contacts(links, c, 1.0, WEDGED, c.step.follows != 0.0)
    for i in range(k):  # friction of a contact that pulls is μ |f|
        if (
            found
            and c.problem.form[i] == LINE
            and c.F[3 * i] < 0.0
            and (c.problem.along[i, 0] != 0.0 or c.problem.along[i, 1] != 0.0)
        ):
            c.problem.along[i, 0], c.problem.along[i, 1] = -c.problem.along[i, 0], -c.problem.along[i, 1]
            found = solve_contacts(links, c, 1.0, WEDGED, c.step.follows != 0.0)
    if not found:
        return PAINLEVE
    c.problem.sought, c.problem.borne = 1.0, 0.0
    nothing = max(DEPENDENT * size, c.stepping.residual * c.stepping.asked)
    for i in range(links.joints):
        if c.friction.pulls[i] == 0.0 or stops_slipping(c, i):
            mode = mode_after(c, i, nothing, links.chattering != 0)
            if is_resistance(c, i):
                mode = FREE if mode_of_resistance(c, i) == FREE else mode
            elif carries_nothing(links, c, i):
                mode = FREE
            told = links.fresh == 0 and not is_resistance(c, i)
            c.event.happened[i] = happened_to(c, i, mode) if told else 0.0
            if mode == STUCK and c.mode[i] != STUCK:
                for j in range(3 * i, 3 * i + 3):
                    c.anchor[j] = c.at[j]
            if mode == FREE and c.mode[i] != FREE:
                c.gaps.cleared[i], c.gaps.floor[i] = 0.0, min(c.located[3 * i], 0.0)
            if mode == FREE:  # it parts from where it is, be that inside by the error of a step
                c.gaps.floor[i] = min(c.gaps.floor[i], c.located[3 * i])
            c.mode[i] = mode
    return remove_motion(links, c, k)


@kernel
def choose_kinds(links: ContactLinks, c: Contacts, slow: float) -> float:
    """Write the kind of each contact and the direction of those that slip; return the size of accelerations."""
    size = 0.0
    for i in range(links.joints, links.k):
        c.problem.form[i] = CONE if c.problem.known[i] > 0.0 else OFF
    for i in range(links.joints):
        at = 3 * i
        for row in range(at, at + 3):
            size = max(size, c.size[row])
        c.problem.form[i], c.problem.along[i, 0], c.problem.along[i, 1] = OFF, 0.0, 0.0
        c.viscous[at + 1], c.viscous[at + 2] = 0.0, 0.0
        pulls = c.friction.pulls[i] != 0.0
        if is_resistance(c, i):
            if form_of_resistance(c, i, CONE) == OFF:
                continue
        elif not pulls and (
            not touches(links, c, i) or (c.mode[i] == FREE and c.u[at] > STICK_SPEED and c.soft[i] == 0.0)
        ):
            continue
        if not pulls and c.soft[i] != 0.0 and soft_gap(c, i) >= 0.0 and c.u[at] > 0.0:
            continue
        u1, u2 = c.u[at + 1], c.u[at + 2]
        speed = math.hypot(u1, u2)
        turned = c.mode[i] == PRESSED and u1 * c.direction[i, 0] + u2 * c.direction[i, 1] <= 0.0
        band = slow if speed > c.friction.capture[i] else c.friction.capture[i] * (1.0 + FOUND)
        c.problem.form[i] = LINE if pulls else RAY
        if c.friction.sticks[i] == SPRING_STICK:
            hold_by_spring(links, c, i, speed <= slow, turned and speed <= STICK_SPEED)
        elif c.mode[i] == STUCK and c.event.outside[i] != 0.0 and has_law(links, i) and c.friction.kinetic[i] < c.mu[i]:
            slide(links, c, i)  # what moves is held by less than what rests
        elif speed <= (STICK_SPEED if turned else band) and c.mu[i] > 0.0:
            c.problem.form[i] = DOUBLE if pulls else CONE
        elif has_law(links, i):
            if speed > 0.0:
                c.direction[i, 0], c.direction[i, 1] = u1 / speed, u2 / speed
            slide(links, c, i)
        elif c.mu[i] > 0.0:
            c.direction[i, 0], c.direction[i, 1] = u1 / speed, u2 / speed
            c.problem.along[i, 0], c.problem.along[i, 1] = c.mu[i] * u1 / speed, c.mu[i] * u2 / speed
    write_shared(links, c)
    return size


@kernel
def hold_by_spring(links: ContactLinks, c: Contacts, i: int, slow: bool, turned: bool) -> None:
    """Let a contact that sticks as a spring slip, where that pulls more than it can, or stick, where slip has ended."""
    c.friction.held[i] = 0.0
    if c.mode[i] == STUCK:
        c.friction.held[i] = 1.0 if c.event.outside[i] == 0.0 else 0.0
    elif c.mode[i] == FREE:
        c.friction.held[i] = 1.0 if slow else 0.0
    elif turned or (slow and c.friction.start_slip[i] > STICK_SPEED):
        stick_as_spring(links, c, i)
        c.friction.held[i] = 1.0
    slide(links, c, i, c.friction.held[i] != 0.0)


@kernel
def carries_nothing(links: ContactLinks, c: Contacts, i: int) -> bool:
    """Whether contact i presses with no more than rounding, and is open or has to be.

    Where a force has just become zero there is hardly any acceleration. That the mode would have it pull, or leave its
    cone, says more, and what is open stays so: something else may hold the body, as the friction of a joint does.
    """
    if c.friction.pulls[i] != 0.0 or c.F[3 * i] > c.problem.rounding:
        return False
    if c.mode[i] != FREE:
        return bool(c.event.pulled[i] != 0.0 or c.event.outside[i] != 0.0)
    return bool(
        links.fresh == 0
        and c.soft[i] == 0.0
        and c.event.struck[i] == 0.0
        and open_margin(c, i, closed_depth(links, c)) > 0.0
    )


@kernel
def mode_after(c: Contacts, i: int, nothing: float, repeated: bool = False) -> int:
    """Return the mode that goes with force and acceleration of contact i, and write that of a slip that begins.

    At the edge of the cone there is hardly any acceleration: a contact slips against its friction, and so does one that
    is found to stick there again and again.
    """
    at = 3 * i
    leaves = c.problem.after[at] > nothing and not is_resistance(c, i)
    if c.friction.pulls[i] == 0.0 and (c.problem.form[i] == OFF or leaves):
        return FREE
    if c.friction.sticks[i] == SPRING_STICK:
        return STUCK if c.friction.held[i] != 0.0 else PRESSED
    a1, a2 = c.problem.after[at + 1], c.problem.after[at + 2]
    size = math.hypot(a1, a2)
    if c.problem.form[i] in (CONE, DOUBLE):
        friction = math.hypot(c.F[at + 1], c.F[at + 2])
        if size <= nothing and c.friction.shared[i] != 0.0:
            return PRESSED
        if size <= nothing and not (repeated and c.event.outside[i] != 0.0 and friction > 0.0):
            return STUCK
        if friction > 0.0:  # the acceleration may be what the solution is off
            if size > nothing and friction < INSIDE * c.mu[i] * abs(c.F[at]) and c.friction.shared[i] == 0.0:
                return STUCK
            a1, a2, size = -c.F[at + 1], -c.F[at + 2], friction
        c.event.turned[i] = 1.0 if a1 * c.direction[i, 0] + a2 * c.direction[i, 1] < 0.0 else 0.0
        c.direction[i, 0], c.direction[i, 1] = a1 / size, a2 / size
    else:
        c.event.turned[i] = 0.0
    return PRESSED


@kernel
def happened_to(c: Contacts, i: int, mode: int) -> float:
    """Return what happened to a contact that has this mode now, 0.0 for nothing; an impact has been told already."""
    before = c.mode[i]
    if before == FREE:
        return CAME if mode != FREE else 0.0
    if mode == FREE:
        return LEFT
    if c.event.struck[i] != 0.0 or c.friction.shared[i] != 0.0:
        return 0.0
    if mode == STUCK:
        return STUCK_NOW if before != STUCK else 0.0
    if before == STUCK:
        return SLIPPED
    return TURNED_ROUND if c.event.turned[i] != 0.0 and (c.problem.form[i] in (CONE, DOUBLE)) else 0.0


@kernel
def write_before(c: Contacts, k: int) -> None:
    """Write in `before` the velocities that impulses may change: not that along the normal of a soft contact."""
    for i in range(3 * k):
        c.before[i] = 0.0 if i % 3 == 0 and c.soft[i // 3] != 0.0 else c.u[i]


@kernel
def remove_motion(links: ContactLinks, c: Contacts, k: int) -> int:
    """Write in F the impulses after which contacts that stick or begin to slip are at rest, and others stay closed."""
    for i in range(k):
        if c.friction.pulls[i] == 0.0 and c.mode[i] == FREE:
            c.problem.form[i] = OFF
        rests = c.problem.form[i] in (CONE, DOUBLE, OFF)
        c.friction.start_slip[i] = 0.0 if rests else math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])
        c.problem.along[i, 0], c.problem.along[i, 1] = 0.0, 0.0
    write_before(c, k)
    stopped = stop(links, c)
    for i in range(k if links.shapes != 0 else 0):  # those that part are not pressed in
        parts = c.problem.form[i] == OFF and c.near[i] != 0.0 and c.located[3 * i] <= TOUCHING and c.past_edge[i] == 0.0
        parts = parts and c.soft[i] == 0.0  # a spring lets itself be pressed in
        stopped = stopped and not (parts and -STICK_SPEED < c.problem.after[3 * i] < -RESTING <= c.before[3 * i])
    for r in range(0 if stopped else 3 * k):
        c.F[r], c.problem.after[r] = 0.0, c.before[r]
    c.event.energy_lost = c.event.energy_rested = -energy_gained(c, k)
    return OK
