"""All contacts together: forces in Coulomb's cones, and the velocities or accelerations that go with them.

With F = (f, F_t) of each contact, u = q + W F of all of them and the mobility W = X Xᵀ, the problem is

    F ∈ K,   u + μ|u_t| n ∈ K*,   Fᵀ(u + μ|u_t| n) = 0,        K = {|F_t| <= μ f},  K* its dual

(G. de Saxcé and Z.-Q. Feng, Math. Comput. Model. 28, 1998): no force off the surface, within the cone where it
sticks, and on its edge against the slip where it slides. q is the velocity before an impact, with what restitution
adds to it, and F an impulse; or q is the acceleration without contacts and F a force. Contacts that slide already
have a direction: F = f (1, −μ d), f >= 0, u_n >= 0, f u_n = 0. `closedloop.mechanics.contacts.joint_space` solves it.
"""

from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.joint_space import (
    ALONG,
    GIVEN,
    HOLDS,
    IN_CONE,
    OWNED,
    PUSHES,
    find_exactly,
    is_wedged,
    solve_softly,
)
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, ContactLinks, Contacts, joints_of
from closedloop.mechanics.contacts.resistance import is_resistance
from closedloop.mechanics.limits import ITERATIONS, STIFF, WEDGED


@kernel
def solve_contacts(
    links: ContactLinks, c: Contacts, share: float = 1.0, most: float = WEDGED, again: bool = False
) -> bool:  # fmt: skip
    """Write F and `after`, u = q + W F, of the contacts whose form is not OFF; return whether they were found.

    X, q, form, mu and along are read, and `share` of the normal forces that are known. Forces `most` times what is
    asked for are none: contacts are then wedged. What was not found just before is sought `again` with less effort.
    """
    a = pack_contacts(links, c, share)
    found = a == 0 or (find_exactly(c.stepping, a, links.n, again) and not is_wedged(c.stepping, a, most))
    unpack_contacts(links, c, a)
    return bool(found)


@kernel
def solve_impulses(links: ContactLinks, c: Contacts, span: float, again: bool = False) -> bool:
    """Do `solve_contacts` for impulses of a time, s: there always are; those of compliant contacts if none is found."""
    found = solve_contacts(links, c, span, STIFF, again)
    if not found:
        a = pack_contacts(links, c, span)
        solve_softly(c.stepping, a, links.n, ITERATIONS)
        c.problem.off = max(c.problem.off, c.stepping.residual)
        unpack_contacts(links, c, a)
    return found


@kernel
def is_known(links: ContactLinks, c: Contacts, i: int) -> bool:
    """Whether the normal force of contact i is known: of a soft surface, or what stands for the friction of a joint."""
    return bool(c.soft[i] != 0.0 or i >= links.joints)


@kernel
def pack_contacts(links: ContactLinks, c: Contacts, share: float) -> int:
    """Write the problem of the contacts whose form is not OFF, with `share` of known forces; return how many."""
    s, a = c.stepping, 0
    s.asked = s.largest = s.residual = s.held = 0.0
    for i in range(links.k):
        s.packed_at[i] = -1.0
        form = c.problem.form[i]
        if form == OFF:
            continue
        at = 3 * i
        s.normal[a] = HOLDS if form in (LINE, DOUBLE) else PUSHES
        s.tangent[a] = IN_CONE if form in (CONE, DOUBLE) else ALONG
        s.mu[a], s.given[a], s.falls[a] = c.mu[i], 0.0, 0.0
        s.ahead[a, 0], s.ahead[a, 1] = c.problem.along[i, 0], c.problem.along[i, 1]
        if is_resistance(c, i):
            s.normal[a], s.given[a] = OWNED, s.packed_at[int(c.friction.resistance.owner[i])]
        elif is_known(links, c, i):
            s.normal[a], s.given[a] = GIVEN, share * c.problem.known[i]
        first, end = joints_of(c, i)
        s.first[a], s.end[a], s.mobility[a] = first, end, 0.0
        for r in range(3):
            of, to, square = row_of(c.X, at + r), row_of(s.X, 3 * a + r), 0.0
            whole = r > 0 or s.normal[a] <= HOLDS
            for j in range(first, end):
                x = of[j] if whole else 0.0
                to[j] = x
                square += x * x
            s.mobility[a] = max(s.mobility[a], square)
            s.q[3 * a + r] = c.problem.q[at + r] if whole else 0.0
            s.asked = max(s.asked, abs(s.q[3 * a + r]))
        if not s.mobility[a] > 0.0:
            continue
        s.asked = max(s.asked, abs(s.given[a]) * s.mobility[a] if s.normal[a] == GIVEN else 0.0)
        s.largest = max(s.largest, s.mobility[a])
        s.number[a], s.packed_at[i] = i, a
        a += 1
    return a


@kernel
def unpack_contacts(links: ContactLinks, c: Contacts, a: int) -> None:
    """Write F and `after` of all contacts, from what was found of those that take part."""
    s, k = c.stepping, links.k
    for r in range(3 * k):
        c.F[r], c.problem.after[r] = 0.0, c.problem.q[r]
    for i in range(a):
        at = 3 * int(s.number[i])
        for r in range(3):
            c.F[at + r] = s.P[3 * i + r]
        if s.normal[i] == OWNED:
            c.F[at] = s.P[3 * int(s.given[i])]
    for i in range(k if a > 0 else 0):
        known = s.packed_at[i] >= 0.0 and s.normal[int(s.packed_at[i])] > HOLDS
        first, end = joints_of(c, i)
        for r in range(3 * i, 3 * i + 3 if c.near[i] != 0.0 else 0):
            for j in range(first, end):
                c.problem.after[r] += c.X[r, j] * s.y[j]
        if known:
            c.problem.after[3 * i] = 0.0
