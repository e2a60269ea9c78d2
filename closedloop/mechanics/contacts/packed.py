"""The contacts that take part in a problem, without the others: what it costs to solve grows with their number cubed.

Boxes that may touch each other have many contacts, faces, corners and edges, of which few are closed at a time.
"""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import OFF, Contacts
from closedloop.mechanics.contacts.mobility import write_mobility


@kernel
def pack(c: Contacts, k: int) -> int:
    """Write W, q, mu, form, along and F of the contacts whose form is not OFF before all others; return their number.

    `unpack` restores what they were.
    """
    a, p = 0, c.scratch.packed
    write_mobility(c, k)
    for i in range(k):
        if c.problem.form[i] != OFF:
            p.contact[a] = i
            a += 1
    if a == k:
        return k
    for i in range(3 * a):
        p.q[i] = c.problem.q[i]
        for j in range(3 * a):
            p.W[i, j] = c.W[i, j]
    for i in range(a):
        p.mu[i], p.form[i] = c.mu[i], c.problem.form[i]
        p.along[i, 0], p.along[i, 1] = c.problem.along[i, 0], c.problem.along[i, 1]
    # In this order nothing is overwritten before it is read: no contact moves to a later place.
    for i in range(a):
        at = int(p.contact[i])
        c.mu[i], c.problem.form[i] = c.mu[at], c.problem.form[at]
        c.problem.along[i, 0], c.problem.along[i, 1] = c.problem.along[at, 0], c.problem.along[at, 1]
        for r in range(3):
            c.F[3 * i + r], c.problem.q[3 * i + r] = c.F[3 * at + r], c.problem.q[3 * at + r]
            for j in range(a):
                column = 3 * int(p.contact[j])
                for s in range(3):
                    c.W[3 * i + r, 3 * j + s] = c.W[3 * at + r, column + s]
    return a


@kernel
def unpack(c: Contacts, k: int, a: int) -> None:
    """Put the a contacts of `pack` back to where they were: F is that of each, zero of the others."""
    p = c.scratch.packed
    if a == k:
        return
    for i in range(3 * a, 3 * k):
        c.F[i] = 0.0
    for i in range(a - 1, -1, -1):  # no contact moves to an earlier place
        at = int(p.contact[i])
        for r in range(3):
            f, c.F[3 * i + r] = c.F[3 * i + r], 0.0
            c.F[3 * at + r] = f
    for i in range(a):
        c.mu[i], c.problem.form[i] = p.mu[i], p.form[i]
        c.problem.along[i, 0], c.problem.along[i, 1] = p.along[i, 0], p.along[i, 1]
    for i in range(3 * a):
        c.problem.q[i] = p.q[i]
        for j in range(3 * a):
            c.W[i, j] = p.W[i, j]
