"""Soft contacts: f as a function of depth and speed, and their friction beside others.

Contacts whose surface gives way: f is a function of depth and speed (`closedloop.mechanics.surface.surface`).

In the problems of several contacts such a contact has no normal row: f is known, what it does is in the free
acceleration of all rows, and friction is in the cone of that f. There is no impulse along its normal.

Friction of soft contacts beside others, which has no mode of sticking: against the slip that is left after a step.

The normal force f of a soft contact is known from its depth. Its friction, |F_t| <= μ f against u_t + h u̇_t, is then
determined, but for how feet of one body share it; `closedloop.mechanics.contacts.turning` solves for it. An integrator
that chooses its steps has no h. There friction is a smooth function of the state, that of the slip with a rise of the
width v_c, far below every speed that counts:

    F_t = −μ f tanh(|u_t|/v_c) u_t/|u_t|

It is Coulomb's to the last bit from 19 v_c on. What rests creeps at less than v_c, and the equation of motion is stiff,
for which the integrator has a scheme (`closedloop.simulation.engines.adaptive`).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.calls import Entry, address_of, call_at, integers_at, vector_at
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import pack, parameter_block
from closedloop.jit.user_code import RAISED, function_of, member_entry, of_users
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.joint_space import eliminate
from closedloop.mechanics.contacts.memory import LINE, OFF, RAY, SPRING_STICK, ContactLinks, Contacts, joints_of
from closedloop.mechanics.contacts.mobility import added
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.contacts.surfaces import Called
from closedloop.mechanics.limits import EXACT, SMALL, STICK_SPEED
from closedloop.mechanics.loops.solve import orthonormal_basis
from closedloop.mechanics.surface.surface import POINTS, WEIGHTS, Compliance
from robot_models.cached import cached

# What stands before the parameters of a compliance: depth, m, its rate, m/s, and the force, N, that the entry writes.
QUERY = 3
# N/m by which a gap becomes a force, for the event function alone: its sign decides.
AS_FORCE = 1e6


@cached
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
    """Write f of the soft contacts that touch, of their gaps and rates, and what it adds to all free accelerations."""
    if links.compliances == 0:
        return
    for j in range(links.n):
        c.scratch.motion[j] = 0.0
    for i in range(links.k):
        if c.soft[i] == 0.0:
            continue
        n, f = 3 * i, 0.0
        if c.past_edge[i] == 0.0 and (c.mode[i] != FREE or soft_gap(c, i) <= 0.0):
            f = force_at(links, i, -soft_gap(c, i), -c.u[n])
            f = f if c.friction.pulls[i] != 0.0 else max(f, 0.0)
        c.problem.known[i], c.b[n] = f, 0.0
        first, end = joints_of(c, i)
        for j in range(first, end if c.near[i] != 0.0 else first):
            c.scratch.motion[j] += c.X[n, j] * f
    for j in range(links.n):
        c.problem.pushed[j] += c.scratch.motion[j]
    for r in range(3 * links.joints):
        c.a[r] += added(c, r)


@kernel
def soft_gap(c: Contacts, i: int) -> float:
    """Return the gap of a soft contact, m, above where its force is zero: below its surface where it began inside."""
    return float(c.located[3 * i] - c.gaps.unloaded[i])


@kernel
def soft_force(links: ContactLinks, i: int, query: Array) -> float:
    """Return what the compliance of contact i gives at the depth and rate in `query`, N."""
    where = integers_at(links.compliances, 2 * links.k)
    if call_at(where[2 * i], where[2 * i + 1], 0) == RAISED:
        links.raised, query[2] = 1, 0.0
    return float(query[2])


@kernel
def force_at(links: ContactLinks, i: int, depth: float, rate: float) -> float:
    """Return what the compliance of contact i gives at this depth, m, and rate, m/s, N."""
    query = vector_at(integers_at(links.compliances, 2 * links.k)[2 * i + 1], QUERY)
    query[0], query[1] = depth, rate
    return float(soft_force(links, i, query))


@kernel
def stored_in(links: ContactLinks, c: Contacts, i: int) -> float:
    """Return what the spring of a soft contact has stored, J; see `closedloop.mechanics.surface.surface`."""
    query = vector_at(integers_at(links.compliances, 2 * links.k)[2 * i + 1], QUERY)
    gap, stored = soft_gap(c, i), 0.0
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
    left = -AS_FORCE * soft_gap(c, i)
    return float(left if c.u[3 * i] > 0.0 else max(left, 0.0))


@kernel
def write_shared(links: ContactLinks, c: Contacts) -> None:
    """Write of each soft contact beside other closed ones the largest |F_t|/f, as `along` has it, or μ.

    Of its resistances likewise.

    With f known, friction that points to where the slips are at the end of a step is determined, but for how feet of
    one body share it. Such contacts have no mode of sticking: their slips end by themselves, in a step or a few.
    Joints with dry friction stop at an instant, and what moves them with it: contacts of theirs stick as others do.
    """
    closed, k = 0, links.k
    for i in range(k):
        closed += 1 if c.problem.form[i] != OFF else 0
    for i in range(k):
        owner = int(c.friction.resistance.owner[i])
        ends = c.soft[i if owner < 0 else owner] != 0.0 and stops_slipping(c, i)
        ends = ends and c.friction.sticks[i] != SPRING_STICK
        level = math.hypot(c.problem.along[i, 0], c.problem.along[i, 1])
        c.friction.shared[i] = 0.0
        if closed > 1 and ends and c.moves.dry[i] == 0.0 and c.problem.form[i] != OFF:
            c.friction.shared[i] = level if c.problem.form[i] in (RAY, LINE) else c.mu[i]


@kernel
def some_share(c: Contacts, k: int) -> bool:
    """Whether a soft contact is closed beside others, see `write_shared`."""
    most = 0.0
    for i in range(k):
        most = max(most, c.friction.shared[i])
    return bool(most > 0.0)


@kernel
def let_friction_rise(c: Contacts, k: int) -> None:
    """Write `along` of soft contacts that share friction as a smooth function of their slips."""
    c.friction.rises = 1.0
    for i in range(k):
        speed = math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])
        if c.friction.shared[i] > 0.0 and c.problem.form[i] in (RAY, LINE):
            level = c.friction.shared[i] * (
                math.tanh(speed / STICK_SPEED) / speed if speed > 0.0 else 1.0 / STICK_SPEED
            )
            c.problem.along[i, 0], c.problem.along[i, 1] = level * c.u[3 * i + 1], level * c.u[3 * i + 2]


@kernel
def rests(c: Contacts, i: int) -> bool:
    """Whether contact i sticks, or as a soft one beside others is held by less than its friction can."""
    size, most = math.hypot(c.F[3 * i + 1], c.F[3 * i + 2]), c.friction.shared[i] * abs(c.F[3 * i])
    return bool(c.mode[i] == STUCK or size < (1.0 - EXACT) * most)


@kernel
def shared_friction(c: Contacts) -> float:
    """Return the largest friction of all contacts that share it together, N."""
    most = 0.0
    for i in range(c.friction.shared.shape[0]):
        most += c.friction.shared[i] * abs(c.F[3 * i])
    return float(most)


@kernel
def drop_contradictions(c: Contacts, k: int) -> None:
    """Take from q of packed soft contacts, and of points, along their surfaces, what hardly any motion of bodies has.

    Feet of one body that turns accelerate towards its axis, with the square of its speed, and those at heights that
    hardly differ slip by what little it rocks. Friction that is to stop this would be as large as it can be, between
    feet that press against each other. With Z an orthonormal basis of the columns of X, each row divided by the root of
    its contact's mobility, q is to be what forces along Z do, X Xᵀ Z x, as much along Z as it was.
    """
    s, S, unknown, scale, p, n = c.stepping, c.scratch.columns, c.scratch.unknown, c.scratch.multiples, 0, c.X.shape[1]
    for i in range(k):
        j = int(s.number[i])
        if c.scratch.turned[j] != 0.0 and (c.friction.shared[j] > 0.0 or c.problem.points > 0.0):
            for r in range(3 * i + 1, 3 * i + 3):
                unknown[p], scale[p] = r, math.sqrt(s.mobility[i])
                for m in range(n):
                    S[m, p] = 0.0
                for m in range(int(s.first[i]), int(s.end[i])):
                    S[m, p] = s.X[r, m] / scale[p]
                p += 1
    rank = orthonormal_basis(S, n, p, SMALL)
    if rank == p:
        return
    moved, M, x, joints = c.scratch.moved, c.scratch.system, c.scratch.solution, c.scratch.sum
    for m in range(rank):
        x[m] = 0.0
        for j in range(n):
            joints[j] = 0.0
        for r in range(p):
            i = int(unknown[r]) // 3
            x[m] += S[m, r] * s.q[int(unknown[r])] / scale[r]
            for j in range(int(s.first[i]), int(s.end[i])):
                joints[j] += s.X[int(unknown[r]), j] * S[m, r] / scale[r]
        for r in range(p):
            i, moved[m, r] = int(unknown[r]) // 3, 0.0
            for j in range(int(s.first[i]), int(s.end[i])):
                moved[m, r] += s.X[int(unknown[r]), j] * joints[j] / scale[r]
        for t in range(rank):
            M[t, m] = 0.0
            for r in range(p):
                M[t, m] += S[t, r] * moved[m, r]
    for m in range(rank):
        s.until[m] = rank
    eliminate(M, x, s.until, rank)
    for r in range(p):
        left = 0.0
        for m in range(rank):
            left += moved[m, r] * x[m]
        s.q[int(unknown[r])] = scale[r] * left
