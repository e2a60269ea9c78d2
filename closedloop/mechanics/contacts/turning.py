"""The friction of contacts that slip slowly, solved with the forces, see `closedloop.mechanics.friction.turning`."""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import row_of
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.closed import solve_closed
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.given_modes import own_mobility
from closedloop.mechanics.contacts.memory import LINE, RAY, Contacts
from closedloop.mechanics.friction.turning import turn_friction

# Solutions at most in which the friction of slow slips is turned, and the change of the forces at which it agrees.
TURNS, SETTLED = 40, 1e-12


@kernel
def turn_and_solve(c: Contacts, k: int, h: float) -> int:
    """Turn the friction of slow slips to where they go in the step h, s, until it agrees with the forces.

    Where it does not, friction stays against the slip as it is. So it does where a contact that only presses would
    pull: its mode ends, and friction that is turned round with the force would drive the slip.
    """
    if some_pull(c, k):
        return int(OK)
    for i in range(k):
        c.scratch.start[2 * i], c.scratch.start[2 * i + 1] = c.problem.along[i, 0], c.problem.along[i, 1]
    for _ in range(TURNS):
        for r in range(3 * k):
            c.before[r] = c.F[r]
        if not turn_slips(c, k, h):
            return int(OK)
        if solve_closed(c, k) != OK or some_pull(c, k):
            break
        size, change = 0.0, 0.0
        for r in range(3 * k):
            size, change = max(size, abs(c.before[r])), max(change, abs(c.F[r] - c.before[r]))
        if change <= SETTLED * size:
            return int(OK)
    for i in range(k):
        c.problem.along[i, 0], c.problem.along[i, 1] = c.scratch.start[2 * i], c.scratch.start[2 * i + 1]
    return int(solve_closed(c, k))


@kernel
def some_pull(c: Contacts, k: int) -> bool:
    """Whether the force of a contact that slides, and only presses, would pull."""
    least = 0.0
    for i in range(k):
        least = min(least, c.F[3 * i] if c.problem.form[i] == RAY else 0.0)
    return bool(least < 0.0)


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
