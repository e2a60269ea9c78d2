"""Friction of soft contacts beside others, which has no mode of sticking: against the slip that is left after a step.

The normal force f of a soft contact is known from its depth. Its friction, |F_t| <= μ f against u_t + h u̇_t, is then
determined, but for how feet of one body share it; `closedloop.mechanics.contacts.turning` solves for it.
"""

from __future__ import annotations

import math

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import STUCK
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.linear import solve_any_rank
from closedloop.mechanics.contacts.memory import LINE, OFF, RAY, SPRING_STICK, ContactLinks, Contacts, joints_rub
from closedloop.mechanics.contacts.soft import CREEP

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
    """Take from the accelerations of packed soft contacts what no motion of their bodies has.

    Feet of one body that turns accelerate towards its axis, with the square of its speed. They do not slip by that,
    but friction that is to stop it would be as large as it can be.
    """
    S, unknown, p, contact = c.scratch.system, c.scratch.unknown, 0, c.scratch.packed.contact
    for i in range(k):
        j = int(contact[i])
        if c.scratch.turned[j] != 0.0:
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
