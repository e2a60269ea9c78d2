"""The contacts that take part in a problem, and their mobility.

The mobility W = X Xᵀ of the contacts that are near, 1/kg, with X = L⁻¹Gᵀ: elsewhere it is zero.

Contacts move each other through the joints that both move. Of bodies that no joint connects these are few, so products
are taken over the joints that `Contacts.moves` says.

The contacts that take part in a problem, without the others: what it costs to solve grows with their number cubed.

Boxes that may touch each other have many contacts, faces, corners and edges, of which few are closed at a time.
"""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import OFF, Contacts, joints_of


@kernel
def own_mobilities(c: Contacts, k: int) -> None:
    """Write of W = X Xᵀ the blocks of the contacts that are near by themselves, (3, 3) each."""
    for i in range(k):
        if c.near[i] != 0.0:
            write_block(c, i, i)
    c.problem.whole = 0.0


@kernel
def write_mobility(c: Contacts, k: int) -> None:
    """Write the rest of W, unless it is there; most steps do without."""
    if c.problem.whole != 0.0:
        return
    for i in range(k):
        for j in range(i if c.near[i] != 0.0 else 0):
            if c.near[j] != 0.0:
                write_block(c, i, j)
    c.problem.whole = 1.0


@kernel
def write_block(c: Contacts, i: int, j: int) -> None:
    """Write the rows of contact i and the columns of contact j of W, and the block opposite."""
    a, b, W = 3 * i, 3 * j, c.W
    w00 = w01 = w02 = w10 = w11 = w12 = w20 = w21 = w22 = 0.0
    x0, x1, x2 = row_of(c.X, a), row_of(c.X, a + 1), row_of(c.X, a + 2)
    y0, y1, y2 = row_of(c.X, b), row_of(c.X, b + 1), row_of(c.X, b + 2)
    (first, end), (begin, until) = joints_of(c, i), joints_of(c, j)
    for m in range(max(first, begin), min(end, until)):
        w00, w01, w02 = w00 + x0[m] * y0[m], w01 + x0[m] * y1[m], w02 + x0[m] * y2[m]
        w10, w11, w12 = w10 + x1[m] * y0[m], w11 + x1[m] * y1[m], w12 + x1[m] * y2[m]
        w20, w21, w22 = w20 + x2[m] * y0[m], w21 + x2[m] * y1[m], w22 + x2[m] * y2[m]
    W[a, b], W[a, b + 1], W[a, b + 2] = w00, w01, w02
    W[a + 1, b], W[a + 1, b + 1], W[a + 1, b + 2] = w10, w11, w12
    W[a + 2, b], W[a + 2, b + 1], W[a + 2, b + 2] = w20, w21, w22
    if i != j:
        W[b, a], W[b + 1, a], W[b + 2, a] = w00, w01, w02
        W[b, a + 1], W[b + 1, a + 1], W[b + 2, a + 1] = w10, w11, w12
        W[b, a + 2], W[b + 1, a + 2], W[b + 2, a + 2] = w20, w21, w22


@kernel
def own_mobility(c: Contacts, i: int, S: Array) -> None:
    """Write the mobility of contact i by itself, S (3, 3), 1/kg."""
    for j in range(3):
        for m in range(3):
            S[j, m] = c.W[3 * i + j, 3 * i + m]


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
