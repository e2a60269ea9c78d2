"""Soft contacts: f as a function of depth and speed, and their friction beside others.

Contacts whose surface gives way: f is a function of depth and speed (`closedloop.mechanics.surface.surface`).

In the problems of several contacts such a contact is like any other, but that its normal row is its own: with f known,
its part of all other rows is in their free acceleration, and

    u̇_n = −w f_known + w f

so that every method finds f = f_known, with friction in the cone of that f. There is no impulse along its normal.

Friction of soft contacts beside others, which has no mode of sticking: against the slip that is left after a step.

The normal force f of a soft contact is known from its depth. Its friction, |F_t| <= μ f against u_t + h u̇_t, is then
determined, but for how feet of one body share it; `closedloop.mechanics.contacts.turning` solves for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.calls import Entry, address_of, call_at, integers_at, vector_at
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import pack, parameter_block
from closedloop.jit.user_code import RAISED, function_of, member_entry, of_users
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.memory import LINE, OFF, RAY, SPRING_STICK, ContactLinks, Contacts, joints_rub
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.contacts.shortest import solve_any_rank
from closedloop.mechanics.contacts.surfaces import Called
from closedloop.mechanics.surface.surface import POINTS, WEIGHTS, Compliance

# What stands before the parameters of a compliance: depth, m, its rate, m/s, and the force, N, that the entry writes.
QUERY = 3
# N/m by which a gap becomes a force, for the event function alone: its sign decides.
AS_FORCE = 1e6
# The share of its mobility that is added along the surface: contacts of one body then share their friction in one way.
# Where joints have dry friction contacts stick, and slip against each other as a body rocks on them: there it is more.
CREEP, CREEP_BESIDE_DRY = 1e-8, 1e-5


@cache
def depth_entry(member: type[Compliance]) -> Entry:
    """Return the entry of a compliance at an address of `QUERY` numbers and its parameters."""
    Parameters, force = parameter_block(member), function_of(member, "force")
    size = QUERY + Parameters.count(1)

    def entry(address: int, what: int) -> int:
        query = vector_at(address, size)
        query[2] = force(query[0], query[1], Parameters(query[3:], 1))
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_depth_{member.__name__}"
    return member_entry(entry, member)


class ContactCompliances(NamedTuple):
    """The compliances of k contacts as the loop reads them: addresses of entry and memory, and what they are of."""

    addresses: IntArray  # (2 k,), zero of a rigid one
    members: dict[int, tuple[Compliance, Array]]  # by the number of the contact

    def entries(self) -> list[Called]:
        """Return the entry kernels of the compliances, and what they are of."""
        return [
            Called(i, "compliance", section, depth_entry(type(section)), address_of(memory))
            for i, (section, memory) in self.members.items()
        ]

    def connect(self, address: Callable[[Any], int]) -> None:
        """Write where the entries are, by what gives the address of one."""
        for i, (section, memory) in self.members.items():
            self.addresses[2 * i : 2 * i + 2] = address(depth_entry(type(section))), address_of(memory)


def is_soft(section: ContactSection) -> bool:
    """Whether the surface of a contact gives way."""
    return section.compliance is not None and section.compliance.kind != "none"


def compliances_of(
    tip: Compliance, sections: tuple[ContactSection, ...], names: tuple[str, ...], k: int
) -> ContactCompliances:
    """Return the compliances of k contacts, that of the tip's the first."""
    members: dict[int, tuple[Compliance, Array]] = {}
    places = ["compliance", *(f"contact {name!r}: compliance" for name in names)]
    for i, (own, where) in enumerate(zip((tip, *(each.compliance for each in sections)), places, strict=True)):
        if own is None or own.kind == "none":
            continue
        with of_users(own, f"{where}.kind"):
            members[i] = own, np.concatenate([np.zeros(QUERY), pack(own, 1, where)])
    return ContactCompliances(np.zeros(2 * k, dtype=np.int64), members)


@kernel
def write_soft_forces(links: ContactLinks, c: Contacts) -> None:
    """Write f of the soft contacts that touch, of their gaps and rates, and make their normal rows their own.

    Mobility W, free acceleration a and what the stabiliser asks for, b, are those of all contacts before.
    """
    if links.compliances == 0:
        return
    m, where = 3 * links.k, integers_at(links.compliances, 2 * links.k)
    for i in range(links.k):
        if c.soft[i] == 0.0:
            continue
        n, f = 3 * i, 0.0
        if c.past_edge[i] == 0.0 and (c.mode[i] != FREE or c.located[n] <= 0.0):
            query = vector_at(where[2 * i + 1], QUERY)
            query[0], query[1] = -c.located[n], -c.u[n]
            f = soft_force(links, i, query)
            f = f if c.friction.pulls[i] != 0.0 else max(f, 0.0)
        own = max(c.W[n, n], c.W[n + 1, n + 1], c.W[n + 2, n + 2])
        for j in range(m):
            c.a[j] += c.W[j, n] * f
            c.W[j, n], c.W[n, j] = 0.0, 0.0
        c.W[n, n], c.a[n], c.b[n] = own, -own * f, 0.0
        for j in range(n + 1, n + 3):
            c.W[j, j] += (CREEP_BESIDE_DRY if joints_rub(links) else CREEP) * own


@kernel
def soft_force(links: ContactLinks, i: int, query: Array) -> float:
    """Return what the compliance of contact i gives at the depth and rate in `query`, N."""
    where = integers_at(links.compliances, 2 * links.k)
    if call_at(where[2 * i], where[2 * i + 1], 0) == RAISED:
        links.raised, query[2] = 1, 0.0
    return float(query[2])


@kernel
def stored_in(links: ContactLinks, c: Contacts, i: int) -> float:
    """Return what the spring of a soft contact has stored, J; see `closedloop.mechanics.surface.surface`."""
    query = vector_at(integers_at(links.compliances, 2 * links.k)[2 * i + 1], QUERY)
    gap, stored = c.located[3 * i], 0.0
    for k in range(4):
        for side in range(2):
            s = 0.5 * (1.0 + (POINTS[k] if side == 0 else -POINTS[k]))
            query[0], query[1] = -gap * s * s, 0.0
            stored -= WEIGHTS[k] * soft_force(links, i, query) * gap * s
    return stored


@kernel
def soft_margin(c: Contacts, i: int) -> float:
    """Return what is left until a soft contact ends, in N: it does where its depth does.

    Just after it began the gap may be a rounding above zero: what moves into the surface is in contact.
    """
    left = -AS_FORCE * c.located[3 * i]
    return float(left if c.u[3 * i] > 0.0 else max(left, 0.0))


# Friction is at its limit within the first share. Of the accelerations that bodies have, the second is taken with those
# that they have not.
AT_EDGE, SHARE = 1e-9, 1e-5


@kernel
def write_shared(links: ContactLinks, c: Contacts) -> None:
    """Write of each soft contact beside other closed ones the largest |F_t|/f, as `along` has it, or μ.

    With f known, friction that points to where the slips are at the end of a step is determined, but for how feet of
    one body share it. Such contacts have no mode of sticking: their slips end by themselves, in a step or a few.
    Joints with dry friction stop at an instant, and what moves them with it: beside them contacts stick as others do.
    """
    closed, k, dry = 0, links.k, joints_rub(links)
    for i in range(k):
        closed += 1 if c.problem.form[i] != OFF else 0
    for i in range(k):
        ends = c.soft[i] != 0.0 and stops_slipping(c, i) and c.friction.sticks[i] != SPRING_STICK
        level = math.hypot(c.problem.along[i, 0], c.problem.along[i, 1])
        c.friction.shared[i] = 0.0
        if closed > 1 and ends and not dry and c.problem.form[i] != OFF:
            c.friction.shared[i] = level if c.problem.form[i] in (RAY, LINE) else c.mu[i]


@kernel
def some_share(c: Contacts, k: int) -> bool:
    """Whether a soft contact is closed beside others, see `write_shared`."""
    most = 0.0
    for i in range(k):
        most = max(most, c.friction.shared[i])
    return bool(most > 0.0)


@kernel
def rests(c: Contacts, i: int) -> bool:
    """Whether contact i sticks, or as a soft one beside others is held by less than its friction can."""
    size, most = math.hypot(c.F[3 * i + 1], c.F[3 * i + 2]), c.friction.shared[i] * abs(c.F[3 * i])
    return bool(c.mode[i] == STUCK or size < (1.0 - AT_EDGE) * most)


@kernel
def shared_friction(c: Contacts) -> float:
    """Return the largest friction of all contacts that share it together, N."""
    most = 0.0
    for i in range(c.friction.shared.shape[0]):
        most += c.friction.shared[i] * abs(c.F[3 * i])
    return float(most)


@kernel
def drop_contradictions(c: Contacts, k: int, largest: float) -> None:
    """Take from the accelerations of packed soft contacts, and of points, what no motion of their bodies has.

    Feet of one body that turns accelerate towards its axis, with the square of its speed. They do not slip by that,
    but friction that is to stop it would be as large as it can be.
    """
    S, unknown, p, contact = c.scratch.system, c.scratch.unknown, 0, c.scratch.packed.contact
    for i in range(k):
        j = int(contact[i])
        if c.scratch.turned[j] != 0.0 and (c.friction.shared[j] > 0.0 or c.problem.points > 0.0):
            unknown[p], unknown[p + 1] = 3 * i + 1, 3 * i + 2
            p += 2
    for r in range(p):
        row = int(unknown[r])
        for s in range(p):
            S[r, s] = c.W[row, int(unknown[s])]
        S[r, r] += SHARE * largest
        S[r, p] = c.drift[3 * int(contact[row // 3]) + row % 3]
    solve_any_rank(S, p, 1, c.scratch.column_order, c.scratch.solution, 0.0)
    for r in range(p):
        row = int(unknown[r])
        j = int(contact[row // 3])
        left = -c.drift[3 * j + row % 3]
        if c.friction.shared[j] > 0.0:
            left -= CREEP * c.W[row - row % 3, row - row % 3] * c.scratch.solution[0, r]
        for s in range(p):
            left += c.W[row, int(unknown[s])] * c.scratch.solution[0, s]
        c.scratch.sought[row] += left
