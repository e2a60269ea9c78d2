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

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.contacts.friction import take_kinetic
from closedloop.mechanics.contacts.given_modes import energy_gained
from closedloop.mechanics.contacts.joint_space import find_exactly, solve_in_joint_space
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, RAY, ContactLinks, Contacts
from closedloop.mechanics.contacts.modes import happened_to, touches, write_before
from closedloop.mechanics.contacts.resistance import form_of_resistance, is_resistance, mode_of_resistance
from closedloop.mechanics.contacts.unknown_modes import pack_contacts, solve_impulses, unpack_contacts
from closedloop.mechanics.limits import SMALL, TENTH, TIME_STEP_SPAN

# Speeds at which contacts come together in the problems near it, of the largest speed.
COMING = (TENTH, TENTH * TENTH)
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
        found = found or from_impact(links, c, coming)
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
def from_impact(links: ContactLinks, c: Contacts, coming: float) -> bool:
    """Write F and `after` from the impulses with which contacts come together at this share of the largest speed."""
    s, k, fastest, change = c.stepping, links.k, 0.0, 0.0
    for r in range(3 * k):
        c.problem.q[r] = c.before[r]
        fastest = max(fastest, abs(c.before[r]) if c.problem.form[r // 3] != OFF else 0.0)
    a = pack_contacts(links, c, 0.0)
    for i in range(a):
        s.q[3 * i] -= coming * fastest
    found = find_exactly(s, a, links.n)
    for i in range(a):
        s.q[3 * i] += coming * fastest
    s.alike = 1.0
    found = found and solve_in_joint_space(s, a, links.n, TENTH)
    unpack_contacts(links, c, a)
    for i in range(3 * k):
        if c.problem.form[i // 3] != OFF:
            change = max(change, abs(c.problem.after[i] - c.before[i]))
    return bool(found and change > SMALL * fastest)


# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
TIME_STEP = 10.0
# `TimeStep.follows`.
FOLLOWS, COMPLIANT = 1.0, 2.0


@kernel
def begin_time_step(links: ContactLinks, c: Contacts, time: float) -> None:
    """Write the impulses of a tangential impact; or the forces of a step that begins at this time, s, and no impulse.

    The modes after it are written, too. After an impact they are to be sought: `at_once` is 1. Where that is in vain
    only time steps follow, until there are modes again.
    """
    k, span = links.k, TIME_STEP_SPAN
    take_kinetic(links, c)
    write_forms(links, c)
    write_before(c, k)
    c.step.in_vain = 1.0 if c.step.struck == time else c.step.in_vain
    if c.step.in_vain == 0.0 and stop_at_once(links, c):
        c.step.at_once, c.step.struck = 1.0, time
        return
    for r in range(3 * k):
        c.problem.q[r], c.before[r] = c.before[r] + span * c.a[r], c.u[r]
    for i in range(links.points + links.stops):  # a compliant one sinks in
        if c.soft[i] == 0.0 and c.problem.form[i] != OFF:
            c.problem.q[3 * i] += TENTH * min(c.located[3 * i], 0.0) / span
    found = solve_impulses(links, c, span, c.step.follows == COMPLIANT)
    c.step.follows = FOLLOWS if found else COMPLIANT
    links.stepped, c.step.end = 1, time + span
    told = False
    for i in range(k):
        at = 3 * i
        for r in range(at, at + 3):
            c.step.force[r] = c.F[r] / span
        c.event.happened[i], c.friction.start_slip[i] = 0.0, 0.0
        if c.friction.pulls[i] != 0.0:
            continue
        if is_resistance(c, i):
            c.mode[i] = mode_of_resistance(c, i)
            continue
        mode = PRESSED if c.step.force[at] > 0.0 else FREE  # what sticks after the step is found then
        c.event.happened[i] = happened_to(c, i, mode)
        if mode == FREE and c.problem.form[i] != OFF:
            c.gaps.cleared[i], c.gaps.floor[i] = 0.0, min(c.located[at], 0.0)
        if mode != FREE and not told:
            c.event.happened[i], told = TIME_STEP, True
        c.mode[i] = mode
    for i in range(3 * k):
        c.F[i], c.problem.after[i] = 0.0, c.u[i]
    c.event.energy_lost = c.event.energy_rested = 0.0


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
