"""The modes of contacts after an event: those with which accelerations and forces agree.

Of the contacts that touch without velocity along the normal, those that slide have a direction, and those that do not
are in Coulomb's cone, with the acceleration in place of the velocity (P. Lötstedt, SIAM J. Appl. Math. 42, 1982). The
problem of `closedloop.mechanics.contacts.complementarity` says which of them part, which slide, and which stick.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE
from closedloop.mechanics.contacts.complementarity import solve_contacts
from closedloop.mechanics.contacts.given_modes import energy_gained, stopping_impulses, write_after
from closedloop.mechanics.contacts.memory import CONE, LINE, OFF, RAY, ContactLinks, Contacts

Array = NDArray[np.float64]

# Within the first gap a contact touches, m; after it has parted, until it has been clear by the second. At the start
# the second counts: a posture is given in few digits.
TOUCHING, CLOSED_GAP, HOVERING = 1e-12, 1e-13, 1e-9
# A contact that parts slower than this does not, m/s. A slip that has turned round is none below the second, m/s.
PARTING, TURNED = 1e-8, 1e-6
# An acceleration below this share of the terms that it is made of is none.
NO_ACCELERATION = 1e-11
# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
CAME, LEFT, STUCK_NOW, SLIPPED, TURNED_ROUND = 2.0, 3.0, 4.0, 5.0, 6.0


@kernel
def touches(links: ContactLinks, c: Contacts, i: int) -> bool:
    """Whether a contact is closed, or about to be."""
    return bool(c.mode[i] != FREE or c.located[3 * i] <= (HOVERING if links.fresh != 0 else TOUCHING))


@kernel
def decide(links: ContactLinks, c: Contacts, slow: float) -> int:
    """Write the modes of all contacts, what happened to each, and in F the impulses that remove what is left of motion.

    Returns
    -------
    int
        OK, or PAINLEVE if no forces in the cones were found, with any modes.
    """
    k = links.k
    size = choose_kinds(links, c, slow)
    for i in range(3 * k):
        c.F[i], c.q[i] = 0.0, c.a[i]
    for i in range(3 * k):
        for j in range(3 * k):
            c.q[i] -= c.W[i, j] * c.viscous[j]
    found = solve_contacts(c, k)
    if not found:
        return PAINLEVE
    for i in range(k):
        if c.kind[i] != LINE:
            mode = mode_after(c, i, NO_ACCELERATION * size, links.tired != 0)
            c.happened[i] = 0.0 if links.fresh != 0 else happened_to(c, i, mode)
            if mode == STUCK and c.mode[i] != STUCK:
                for j in range(3 * i, 3 * i + 3):
                    c.anchor[j] = c.at[j]
            if mode == FREE and c.mode[i] != FREE:
                c.risen[i], c.floor[i] = 0.0, min(c.located[3 * i], 0.0)
            if mode == FREE:  # it parts from where it is, be that inside by the error of a step
                c.floor[i] = min(c.floor[i], c.located[3 * i])
            c.mode[i] = mode
    return remove_motion(c, k)


@kernel
def choose_kinds(links: ContactLinks, c: Contacts, slow: float) -> float:
    """Write the kind of each contact and the direction of those that slide; return the size of accelerations."""
    n, size = c.X.shape[1], 0.0
    for i in range(links.k):
        at = 3 * i
        for row in range(at, at + 3):
            s = abs(c.drift[row])
            for j in range(n):
                s += abs(c.X[row, j] * c.load[j])
            size = max(size, s)
        if c.kind[i] == LINE:
            continue
        c.kind[i], c.along[i, 0], c.along[i, 1] = OFF, 0.0, 0.0
        if not touches(links, c, i) or (c.mode[i] == FREE and c.u[at] > PARTING and c.soft[i] == 0.0):
            continue
        if c.soft[i] != 0.0 and c.located[at] >= 0.0 and c.u[at] > 0.0:
            continue
        u1, u2 = c.u[at + 1], c.u[at + 2]
        speed = math.hypot(u1, u2)
        turned = c.mode[i] == PRESSED and u1 * c.direction[i, 0] + u2 * c.direction[i, 1] <= 0.0
        c.kind[i] = RAY
        if speed <= (TURNED if turned else slow):
            c.kind[i] = CONE if c.mu[i] > 0.0 else RAY
        elif c.mu[i] > 0.0:
            c.along[i, 0], c.along[i, 1] = c.mu[i] * u1 / speed, c.mu[i] * u2 / speed
    return size


@kernel
def mode_after(c: Contacts, i: int, nothing: float, tired: bool = False) -> int:
    """Return the mode that goes with force and acceleration of contact i, and write the direction of its slip.

    At the edge of the cone there is hardly any acceleration: a contact that is found to stick there again and again
    slips, against the friction that would have to hold it.
    """
    at = 3 * i
    if c.kind[i] == OFF or c.after[at] > nothing:
        return FREE
    # Where a force has just become zero there is hardly any acceleration; that the mode would have it pull says more.
    if c.pulled[i] != 0.0 and c.F[at] <= c.rounding:
        return FREE
    a1, a2 = c.after[at + 1], c.after[at + 2]
    size = math.hypot(a1, a2)
    if c.kind[i] == CONE:
        if size <= nothing:
            rub = math.hypot(c.F[at + 1], c.F[at + 2])
            if not (tired and c.outside[i] != 0.0 and rub > 0.0):
                return STUCK
            a1, a2, size = -c.F[at + 1], -c.F[at + 2], rub
        c.turned[i] = 1.0 if a1 * c.direction[i, 0] + a2 * c.direction[i, 1] < 0.0 else 0.0
        c.direction[i, 0], c.direction[i, 1] = a1 / size, a2 / size
    elif c.mu[i] > 0.0:
        c.turned[i] = 0.0
        c.direction[i, 0], c.direction[i, 1] = c.along[i, 0] / c.mu[i], c.along[i, 1] / c.mu[i]
    return PRESSED


@kernel
def happened_to(c: Contacts, i: int, mode: int) -> float:
    """Return what happened to a contact that has this mode now, 0.0 for nothing; an impact has been told already."""
    before = c.mode[i]
    if before == FREE:
        return CAME if mode != FREE else 0.0
    if mode == FREE:
        return LEFT
    if c.struck[i] != 0.0:
        return 0.0
    if mode == STUCK:
        return STUCK_NOW if before != STUCK else 0.0
    if before == STUCK:
        return SLIPPED
    return TURNED_ROUND if c.turned[i] != 0.0 and c.kind[i] == CONE else 0.0


@kernel
def remove_motion(c: Contacts, k: int) -> int:
    """Write in F the impulses after which contacts that stick or begin to slip are at rest, and others stay closed."""
    for i in range(k):
        if c.kind[i] != LINE and c.mode[i] == FREE:
            c.kind[i] = OFF
        c.start_slip[i] = math.hypot(c.u[3 * i + 1], c.u[3 * i + 2]) if c.kind[i] == RAY else 0.0
        c.along[i, 0], c.along[i, 1] = 0.0, 0.0
    for i in range(3 * k):
        c.before[i] = 0.0 if i % 3 == 0 and c.soft[i // 3] != 0.0 else c.u[i]
    stopping_impulses(c, k)
    write_after(c, k)
    c.energy_lost = c.energy_rested = -energy_gained(c, k)
    return OK
