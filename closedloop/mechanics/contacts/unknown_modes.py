"""All contacts together: forces in Coulomb's cones, and the velocities or accelerations that go with them.

With F = (f, F_t) of each contact, u = q + W F of all of them and the mobility W = X Xᵀ, the problem is

    F ∈ K,   u + μ|u_t| n ∈ K*,   Fᵀ(u + μ|u_t| n) = 0,        K = {|F_t| <= μ f},  K* its dual

(G. de Saxcé and Z.-Q. Feng, Math. Comput. Model. 28, 1998): no force off the surface, within the cone where it
sticks, and on its edge against the slip where it slides. q is the velocity before an impact, with what restitution
adds to it, and F an impulse; or q is the acceleration without contacts and F a force. Contacts that slide already
have a direction: F = f (1, −μ d), f >= 0, u_n >= 0, f u_n = 0. `closedloop.mechanics.contacts.joint_space` solves it.
"""

from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.joint_space import find_exactly, is_wedged, solve_softly
from closedloop.mechanics.contacts.memory import ContactLinks, Contacts
from closedloop.mechanics.contacts.packed import pack_contacts, unpack_contacts
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
        unpack_contacts(links, c, a)
    return found
