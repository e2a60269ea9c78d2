"""A step at the level of impulses: the whole step, and the impulse of a tangential impact.

The impulse of a tangential impact: it stops a slip at once where pressing harder pulls the contact in.

    u⁺ = u + W P,     P ∈ K,     u⁺ + μ|u⁺_t| n ∈ K*,     Pᵀ(u⁺ + μ|u⁺_t| n) = 0

No contacts come together, so P = 0 is a solution; this is another one (A. P. Ivanov, J. Appl. Math. Mech. 50, 1986; F.
Génot and B. Brogliato, Eur. J. Mech. A 18, 1999: impact without collision). It never creates energy. Newton's method
finds it from the impulses of an impact near it, where contacts come together: that has no solution near P = 0.

One time step at the level of impulses, where no modes are found with which forces and accelerations agree.

    u⁺ = u + h a + W P,     P ∈ K,     u⁺ + μ|u⁺_t| n ∈ K*,     Pᵀ(u⁺ + μ|u⁺_t| n) = 0

the step of time-stepping schemes (J. J. Moreau, in Nonsmooth Mechanics and Applications, Springer, 1988; D. E. Stewart
and J. C. Trinkle, Int. J. Numer. Methods Eng. 39, 1996) for the contacts that touch, without restitution. It has a
solution where accelerations have none. Where a contact slides so that pressing harder pulls it in (P. Painlevé, 1895) a
tangential impact is tried first. The forces are P/h until the step has ended; then the modes are sought anew.
"""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.closure.solve import OK, PAINLEVE
from closedloop.mechanics.contacts.complementarity import (
    LAST_ROUNDS,
    SOFTNESS,
    largest_mobility,
    polish,
    size_of_q,
    solve_contacts,
    solve_from_here,
    sweep_long,
)
from closedloop.mechanics.contacts.continuation import force_size
from closedloop.mechanics.contacts.friction import take_kinetic
from closedloop.mechanics.contacts.given_modes import energy_gained, write_after
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, RAY, ContactLinks, Contacts
from closedloop.mechanics.contacts.mobility import pack, unpack, write_mobility
from closedloop.mechanics.contacts.modes import happened_to, touches, write_before
from closedloop.mechanics.contacts.resistance import form_of_resistance, is_resistance, mode_of_resistance

# Speeds at which contacts come together in the problems near it, of the largest speed.
COMING = (0.1, 0.01)
# What changes velocities by a smaller share of the largest is no impact.
LEAST_CHANGE = 1e-3
# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
TANGENTIAL_IMPACT = 11.0


@kernel
def stop_at_once(links: ContactLinks, c: Contacts) -> bool:
    """Write in F the impulses of a tangential impact; return whether there is one.

    The contacts whose form is not OFF take part; `before` and `after` are the velocities. Each contact that an impulse
    acts on is closed after it.
    """
    k, found = links.k, False
    for coming in COMING:
        found = found or from_impact(c, k, coming)
    if not found:
        return False
    told = False
    for i in range(k):
        c.event.happened[i], c.friction.start_slip[i] = 0.0, 0.0
        if c.friction.pulls[i] != 0.0 or is_resistance(c, i) or not c.F[3 * i] > 0.0:
            continue
        c.mode[i], c.event.struck[i] = PRESSED, 1.0
        if not told:
            c.event.happened[i], told = TANGENTIAL_IMPACT, True
    c.event.energy_lost, c.event.energy_rested = -energy_gained(c, k), 0.0
    return True


@kernel
def from_impact(c: Contacts, k: int, coming: float) -> bool:
    """Write F and `after` from the impulses with which contacts come together at this share of the largest speed."""
    write_mobility(c, k)
    fastest, softness, change = 0.0, SOFTNESS * largest_mobility(c, k), 0.0
    for i in range(3 * k):
        fastest = max(fastest, abs(c.before[i]) if c.problem.form[i // 3] != OFF else 0.0)
    for i in range(3 * k):
        c.F[i], c.step.diagonal[i] = 0.0, c.W[i, i]
        c.problem.q[i] = c.before[i] - (coming * fastest if i % 3 == 0 else 0.0)
        c.W[i, i] += softness
    solve_contacts(c, k, 0)
    for i in range(3 * k):
        c.W[i, i], c.problem.q[i] = c.step.diagonal[i], c.before[i]
    a = pack(c, k)
    found = solve_from_here(c, a, 0, LAST_ROUNDS)
    if found:
        polish(c, a)
    unpack(c, k, a)
    write_after(c, k)
    for i in range(3 * k):
        if c.problem.form[i // 3] != OFF:
            change = max(change, abs(c.problem.after[i] - c.before[i]))
    return bool(found and change > LEAST_CHANGE * fastest)


# Length of the step, s; the residual, of the largest, that impulses may have which long sweeps have found.
SPAN, NEAR = 2e-5, 1e-6
# Impulses of contacts that are wedged have no bound, and are in balance only where the bodies are: so many times what
# is asked for, they move bodies that turn within the step by a part in a thousand.
MOST_IMPULSE = 1e3
# Shares of friction that are tried where even so no impulses are found.
LESS_FRICTION = (0.5, 0.25, 0.0)
# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
TIME_STEP = 10.0


@kernel
def begin_time_step(links: ContactLinks, c: Contacts, time: float) -> int:
    """Write the impulses of a tangential impact; or the forces of a step that begins at this time, s, and no impulse.

    The modes after it are written, too. After an impact they are to be sought: `at_once` is 1. Where that is in vain
    only time steps follow, until there are modes again.

    Returns OK, or PAINLEVE if no impulses were found.
    """
    k = links.k
    take_kinetic(links, c)
    write_forms(links, c)
    write_before(c, k)
    c.step.in_vain = 1.0 if c.step.struck == time else c.step.in_vain
    if c.step.in_vain == 0.0 and stop_at_once(links, c):
        c.step.at_once, c.step.struck = 1.0, time
        return OK
    for i in range(3 * k):
        c.F[i], c.problem.q[i], c.before[i] = 0.0, c.before[i] + SPAN * c.a[i], c.u[i]
    if not find_with_less_friction(c, k):
        return PAINLEVE
    links.stepped, c.step.end = 1, time + SPAN
    told = False
    for i in range(k):
        at = 3 * i
        for j in range(at, at + 3):
            c.step.force[j] = c.F[j] / SPAN
        c.event.happened[i], c.friction.start_slip[i] = 0.0, 0.0
        if c.friction.pulls[i] != 0.0:
            continue
        if is_resistance(c, i):
            c.mode[i] = mode_of_resistance(c, i)
            continue
        mode = PRESSED if c.F[at] > 0.0 else FREE  # what sticks after the step is found then
        c.event.happened[i] = happened_to(c, i, mode)
        if mode == FREE and c.problem.form[i] != OFF:
            c.gaps.cleared[i], c.gaps.floor[i] = 0.0, min(c.located[at], 0.0)
        if mode != FREE and not told:
            c.event.happened[i], told = TIME_STEP, True
        c.mode[i] = mode
    for i in range(3 * k):
        c.F[i], c.problem.after[i] = 0.0, c.u[i]
    c.event.energy_lost = c.event.energy_rested = 0.0
    return OK


@kernel
def write_forms(links: ContactLinks, c: Contacts) -> None:
    """Write the form of each contact: all that touch are in their cones."""
    for i in range(links.k):
        c.problem.along[i, 0], c.problem.along[i, 1] = 0.0, 0.0
        c.problem.form[i] = OFF
        if c.friction.pulls[i] != 0.0:
            c.problem.form[i] = DOUBLE if c.mu[i] > 0.0 else LINE
        elif is_resistance(c, i):
            c.problem.form[i] = form_of_resistance(c, i, CONE)
        elif touches(links, c, i):
            c.problem.form[i] = CONE if c.mu[i] > 0.0 else RAY


@kernel
def find_with_less_friction(c: Contacts, k: int) -> bool:
    """Do `find_impulses`, if need be with all μ lessened by one factor, and return whether there is a solution.

    Without friction there is one: the problem is convex. A step that follows on another begins with the factor of that.
    """
    for i in range(k):
        c.scratch.mu[i] = c.mu[i]
    cut = c.step.friction_cut
    found = find_with_share(c, k, 1.0 - cut)
    for share in LESS_FRICTION:
        if not found and share < 1.0 - cut:
            found = find_with_share(c, k, share)
            c.step.friction_cut = 1.0 - share
    for i in range(k):
        c.mu[i] = c.scratch.mu[i]
    return found


@kernel
def find_with_share(c: Contacts, k: int, share: float) -> bool:
    """Do `find_impulses` with so much of each μ in `scratch`."""
    for i in range(k):
        c.mu[i] = share * c.scratch.mu[i]
        if c.problem.form[i] in (CONE, RAY):
            c.problem.form[i] = CONE if c.mu[i] > 0.0 else RAY
        elif c.problem.form[i] != OFF:
            c.problem.form[i] = DOUBLE if c.mu[i] > 0.0 else LINE
    for i in range(3 * k):
        c.F[i] = 0.0
    return find_impulses(c, k)


@kernel
def find_impulses(c: Contacts, k: int) -> bool:
    """Write the impulses F; return whether they were found."""
    found = solve_contacts(c, k)
    if not (found and bounded(c, k)):
        sweep_long(c, k)
        largest, asked = largest_mobility(c, k), size_of_q(c, k)
        found = largest * c.problem.residual <= NEAR * max(asked, largest * force_size(c.F, 3 * k))
    return bool(found and bounded(c, k))


@kernel
def bounded(c: Contacts, k: int) -> bool:
    """Whether the impulses are not those of contacts that are wedged."""
    return bool(largest_mobility(c, k) * force_size(c.F, 3 * k) <= MOST_IMPULSE * size_of_q(c, k))
