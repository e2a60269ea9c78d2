"""The friction of contacts that slip slowly, solved with the forces, see `closedloop.mechanics.friction.turning`."""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import row_of
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.given_modes import own_mobility
from closedloop.mechanics.contacts.memory import LINE, RAY, Contacts
from closedloop.mechanics.friction.turning import turn_friction


@kernel
def turn_slips(c: Contacts, k: int, h: float) -> bool:
    """Turn the friction of slow slips, with the forces F that are known, as `along`; return whether there are any."""
    turned = False
    for i in range(k):
        n = 3 * i
        rubs = c.problem.along[i, 0] != 0.0 or c.problem.along[i, 1] != 0.0
        if not (rubs and c.problem.form[i] in (RAY, LINE) and c.mode[i] == PRESSED and stops_slipping(c, i)):
            continue
        for t in (1, 2):  # the acceleration without this friction
            c.scratch.vector[t] = c.a[n + t]
            for j in range(3 * k):
                F = -c.viscous[j] if j == n + 1 or j == n + 2 else c.F[j]
                c.scratch.vector[t] += c.W[n + t, j] * F
        own_mobility(c, i, c.scratch.slope)
        if turn_friction(
            c.scratch.slope,
            c.scratch.vector[1],
            c.scratch.vector[2],
            c.u[n : n + 3],
            row_of(c.direction, i),
            c.F[n],
            h,
            row_of(c.problem.along, i),
        ):
            turned = True
    return turned
