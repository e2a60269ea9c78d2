"""Impacts of several contacts at one instant, with Newton's restitution and Coulomb's friction.

    u⁺ = u⁻ + W P,     P ∈ K,     u⁺_n + e u⁻_n >= 0,     P_n (u⁺_n + e u⁻_n) = 0

with friction against u⁺_t: the problem of `closedloop.mechanics.contacts.unknown_modes` for q = u⁻ + e u⁻_n n (J. J.
Moreau, in Nonsmooth Mechanics and Applications, Springer, 1988). Contacts that were closed already take part with e =
0. Newton's law with friction can create energy (T. R. Kane, 1984), and where contacts are opposite each other, as of a
wedge, there need not be velocities that all e allow: then all e of the impact are lessened by one factor, until there
are impulses and they create none. With e = 0 there always are (V. Acary, F. Cadoux, C. Lemaréchal and J. Malick, ZAMM
91, 2011), and they never do.
"""

import math

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.friction import cone_limit, take_kinetic
from closedloop.mechanics.contacts.given_modes import energy_gained, stop, write_after
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, RAY, SMOOTH, ContactLinks, Contacts
from closedloop.mechanics.contacts.modes import touches
from closedloop.mechanics.contacts.resistance import form_of_resistance, is_resistance, mode_of_resistance
from closedloop.mechanics.contacts.unknown_modes import solve_contacts, solve_impulses
from closedloop.mechanics.limits import HALVINGS, RESTING, SMALL, STIFF

# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
STRUCK_AND_LEFT, STRUCK_AND_STAYED = 1.0, 2.0


@kernel
def apply_impulses(links: ContactLinks, c: Contacts, rest_speed: float) -> int:
    """Write the impulses F of the contacts that come together, zero if there are none; `after` their velocities.

    Returns OK.
    """
    k, coming = links.k, 0
    c.event.energy_lost, c.event.energy_rested, c.event.restitution_share = 0.0, 0.0, 1.0
    for i in range(3 * k):
        c.F[i], c.before[i], c.problem.after[i] = 0.0, c.u[i], c.u[i]
    for i in range(k):
        c.event.happened[i], c.event.struck[i] = 0.0, 0.0
        c.event.pulled[i] = 1.0 if c.mode[i] != FREE and c.rigid[3 * i] < -c.problem.rounding else 0.0
        friction = math.hypot(c.rigid[3 * i + 1], c.rigid[3 * i + 2])
        left = cone_limit(c, i) * abs(c.rigid[3 * i]) - friction + c.problem.rounding
        c.event.outside[i] = 1.0 if c.mode[i] == STUCK and left < 0.0 else 0.0
        if (
            c.event.outside[i] != 0.0 and c.friction.sticks[i] != SMOOTH and friction > 0.0
        ):  # where it slips, if it begins to
            c.direction[i, 0], c.direction[i, 1] = -c.rigid[3 * i + 1] / friction, -c.rigid[3 * i + 2] / friction
    take_kinetic(links, c)
    for i in range(k):
        c.problem.form[i] = OFF
        if c.friction.pulls[i] != 0.0:
            c.problem.form[i] = OFF if c.soft[i] != 0.0 else (DOUBLE if c.mu[i] > 0.0 else LINE)
        elif is_resistance(c, i):
            c.problem.form[i] = form_of_resistance(c, i, CONE)
        elif touches(links, c, i) and c.soft[i] == 0.0:
            c.problem.form[i] = CONE if c.mu[i] > 0.0 else RAY
        c.problem.along[i, 0], c.problem.along[i, 1] = 0.0, 0.0
        if c.friction.pulls[i] == 0.0 and c.problem.form[i] != OFF and c.mode[i] == FREE and c.u[3 * i] < -RESTING:
            coming, c.event.struck[i] = coming + 1, 1.0
    if coming == 0:
        let_stay(links, c, rest_speed, False)
        return OK
    if not (solve_with(links, c, 1.0, rest_speed) and energy_gained(c, k) <= 0.0):
        c.event.restitution_share = lessened_restitution(links, c, rest_speed)
        solve_with(links, c, c.event.restitution_share, rest_speed)
    for i in range(k):
        if c.friction.pulls[i] != 0.0 or c.problem.form[i] == OFF:
            continue
        if is_resistance(c, i):
            c.mode[i] = mode_of_resistance(c, i)
            continue
        parts = c.problem.after[3 * i] > 0.5 * own_rest_speed(c, i, rest_speed)
        if c.event.struck[i] != 0.0:
            c.event.happened[i] = STRUCK_AND_LEFT if parts else STRUCK_AND_STAYED
        if parts:
            c.mode[i], c.gaps.cleared[i], c.gaps.floor[i] = FREE, 1.0, min(c.located[3 * i], 0.0)
        elif c.mode[i] == FREE:
            c.mode[i] = PRESSED
    let_stay(links, c, rest_speed, True)
    return OK


@kernel
def let_stay(links: ContactLinks, c: Contacts, rest_speed: float, strikes: bool) -> None:
    """Take from contacts that others have made part, too slowly to leave, what they part with; write the energy lost.

    A body that rocks so slowly is at rest: what is left of its turning would decide how its feet slip. Where none
    `strikes` nothing moves against its mode after it, by which others would seem to part.
    """
    k, fastest, struck = links.k, 0.0, -energy_gained(c, links.k)
    for i in range(k):
        pulls = c.friction.pulls[i] != 0.0
        stays = not pulls and c.problem.form[i] != OFF and c.mode[i] != FREE
        if stays:
            fastest = max(fastest, c.problem.after[3 * i])
        slip = math.hypot(c.problem.after[3 * i + 1], c.problem.after[3 * i + 2])
        slow = slip <= own_rest_speed(c, i, rest_speed) and c.mu[i] > 0.0
        rests = slow if strikes else c.mode[i] == STUCK
        stays = stays and not is_resistance(c, i)  # it may roll on
        if not pulls:
            c.problem.form[i] = OFF if not stays else (CONE if rests else RAY)
        elif c.problem.form[i] != OFF:
            c.problem.form[i] = DOUBLE if rests else LINE
        c.problem.along[i, 0], c.problem.along[i, 1] = 0.0, 0.0
    if fastest > RESTING:
        for i in range(3 * k):
            c.scratch.residuals[i], c.scratch.start[i], c.before[i] = c.F[i], c.before[i], c.problem.after[i]
        stopped = stop(links, c)
        for i in range(3 * k):
            c.F[i] = c.F[i] + c.scratch.residuals[i] if stopped else c.scratch.residuals[i]
            c.before[i] = c.scratch.start[i]
        write_after(c, k)
    c.event.energy_lost = -energy_gained(c, k)
    c.event.energy_rested = c.event.energy_lost - struck


@kernel
def lessened_restitution(links: ContactLinks, c: Contacts, rest_speed: float) -> float:
    """Return the largest factor of all e, up to 2^-40, with which there are impulses that create no energy.

    Velocities scale: contacts that cannot part with any speed asked for cannot with a small one, and there is no
    restitution.
    """
    low, high, missing = 0.0, 1.0, 0
    if not solve_with(links, c, SMALL, rest_speed):
        return 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        found = solve_with(links, c, middle, rest_speed)
        if found and energy_gained(c, links.k) <= 0.0:
            low = middle
        else:
            high = middle
            missing += 0 if found else 1
            if missing == HALVINGS:
                break
    return low


@kernel
def solve_with(links: ContactLinks, c: Contacts, share: float, rest_speed: float) -> bool:
    """Solve for the impulses with restitution times `share`; `after` is then u⁺. Without there always are some."""
    k, found = links.k, True
    for i in range(3 * k):
        c.problem.q[i] = c.before[i]
    for i in range(k):
        bounce = -share * c.restitution[i] * c.before[3 * i]
        if c.event.struck[i] != 0.0 and links.chattering == 0 and bounce >= own_rest_speed(c, i, rest_speed):
            c.problem.q[3 * i] -= bounce
    if share > 0.0:
        found = solve_contacts(links, c, 0.0, STIFF)
    else:
        solve_impulses(links, c, 0.0)
    write_after(c, k)
    return found


@kernel
def own_rest_speed(c: Contacts, i: int, rest_speed: float) -> float:
    """Return the speed below which contact i is at rest, m/s (rad/s): `rest_speed` where it has none of its own."""
    return float(c.rest_speed[i] if c.rest_speed[i] > 0.0 else rest_speed)
