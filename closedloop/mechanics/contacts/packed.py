"""The contacts that take part in a problem, as `closedloop.mechanics.contacts.joint_space` has them."""

from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.joint_space import ALONG, GIVEN, HOLDS, IN_CONE, OWNED, PUSHES
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, ContactLinks, Contacts, joints_of
from closedloop.mechanics.contacts.resistance import is_resistance


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
