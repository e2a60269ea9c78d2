"""The impulse of a tangential impact: it stops a slip at once where pressing harder pulls the contact in.

    u⁺ = u + W P,     P ∈ K,     u⁺ + μ|u⁺_t| n ∈ K*,     Pᵀ(u⁺ + μ|u⁺_t| n) = 0

No contacts come together, so P = 0 is a solution; this is another one (A. P. Ivanov, J. Appl. Math. Mech. 50, 1986; F.
Génot and B. Brogliato, Eur. J. Mech. A 18, 1999: impact without collision). It never creates energy. Newton's method
finds it from the impulses of an impact near it, where contacts come together: that has no solution near P = 0.
"""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.contacts.complementarity import (
    LAST_ROUNDS,
    SOFTNESS,
    largest_mobility,
    polish,
    solve_contacts,
    solve_from_here,
)
from closedloop.mechanics.contacts.given_modes import energy_gained, write_after
from closedloop.mechanics.contacts.memory import OFF, ContactLinks, Contacts
from closedloop.mechanics.contacts.mobility import write_mobility
from closedloop.mechanics.contacts.packed import pack, unpack
from closedloop.mechanics.contacts.resistance import is_resistance

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
