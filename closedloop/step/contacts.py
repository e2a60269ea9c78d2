"""The contacts of the links in a step: all of them, the tip's among them, solved together.

With H = L Lᵀ, y = L⁻¹(Q − C) of the tree, less what loops bind (`closedloop.step.closed_loops`), and X = L⁻¹Gᵀ of all
contacts, likewise, the acceleration of the contacts is u̇ = X y + drift + X Xᵀ F. An event
(`closedloop.events.contacts`) is dealt with in two parts: impacts, if contacts come together, then at the state after
them the modes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED, STUCK, accelerate
from closedloop.closure.solve import OK, back_substitute
from closedloop.contacts.given_modes import kinds_of_modes, solve_modes
from closedloop.contacts.impact import apply_impulses
from closedloop.contacts.memory import LINE, ContactLinks, Contacts, contacts_at
from closedloop.contacts.modes import CLOSED_GAP, HOVERING, decide
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.step.contact_rows import locate_contacts, place_contacts
from closedloop.step.locate import set_anchor
from closedloop.step.memory import State, Work, loop_at

Array = NDArray[np.float64]

# What the contacts are asked for.
FORCE, SAVE, IMPULSE, DECIDE = range(4)


@entry_kernel
def contacts_in_step(address: int, what: int) -> int:
    """Answer for the contacts, by the address of their memory; return a status of `closedloop.closure.solve`.

    FORCE    write the forces at the state in `Work`, q̈, and the margin of the event function
    SAVE     keep what a substep begins with
    IMPULSE  apply the impulses of contacts that come together to q̇; `happened` says what
    DECIDE   write the modes after an event or at the start, `happened` likewise, and take what velocity they have not
    """
    links, c = contacts_at(address)
    state, constants, w = loop_at(links.loop)
    status = OK
    if what == FORCE:
        status = locate_contacts(links, c, w, constants, state)
        if status == OK:
            status = contact_forces(links, c, w, state)
    elif what == SAVE:
        save_contacts(links, c)
    elif what == IMPULSE:
        place_contacts(links, c, w)
        status = apply_impulses(links, c, constants.rest_speed)
        move(links, c, w)
    else:
        place_contacts(links, c, w)
        status = decide(links, c, (3.0 if state.steps < 0 else 1.0) * constants.stick_speed)
        move(links, c, w)
        if c.mode[0] == STUCK and c.happened[0] != 0.0:
            set_anchor(w, state)
    return int(status)


@kernel
def contact_forces(links: ContactLinks, c: Contacts, w: Work, state: State) -> int:
    """Write the forces in the present modes, none while these are not decided, and q̈."""
    n, k, status = links.n, links.k, OK
    if links.undecided != 0:
        for i in range(3 * k):
            c.F[i], c.rigid[i] = 0.0, 0.0
        c.margin = -1.0
    else:
        kinds_of_modes(c, k)
        status = solve_modes(c, k)
        if c.kind[0] == LINE and c.rigid[0] < 0.0 and (c.along[0, 0] != 0.0 or c.along[0, 1] != 0.0):
            c.along[0, 0], c.along[0, 1] = -c.along[0, 0], -c.along[0, 1]  # what pulls rubs with |f|
            status = solve_modes(c, k)
        c.margin = margin_of(c, k, STICK_SPEED, 2.0 * STICK_SPEED if state.steps < 0 else 0.0)
    w.contact_margin, w.contact_power, w.contact_power_rate = c.margin, 0.0, 0.0
    for i in range(3):
        w.F[i], w.b[i], w.stabiliser_force[i] = c.F[i], c.b[i], c.F[i] - c.rigid[i]
    w.rigid_force = c.rigid[0]
    for j in range(n):
        w.contact_torque[j] = 0.0
    for i in range(3, 3 * k):
        growth = c.a[i]
        for j in range(3 * k):
            growth += c.W[i, j] * c.F[j]
        w.contact_power += c.F[i] * (c.u[i] + c.carried[i])
        w.contact_power_rate += c.F[i] * (growth - c.turning[i])
        for j in range(n):
            w.contact_torque[j] += c.G[i, j] * c.F[i]
            w.y[j] += c.X[i, j] * c.F[i]
    accelerate(w.L, w.X, w.y, w.F, w.qdd)
    return status


# The speed of slip below which it is none, m/s.
STICK_SPEED = 1e-7


@kernel
def margin_of(c: Contacts, k: int, slow: float, rest: float) -> float:
    """Return what is left until the mode of a contact ends: a gap, m, a force, N, or a speed of slip, m/s.

    Slip ends at the speed `rest`, m/s: 0 with steps of fixed length. An integrator that chooses its steps would need
    endlessly many for the turns of the direction at the very end.
    """
    least = math.inf
    for i in range(k):
        n = 3 * i
        if c.kind[i] == LINE:
            continue
        if c.mode[i] == FREE:
            least = min(least, c.located[n] - c.floor[i] + (CLOSED_GAP if c.risen[i] != 0.0 else HOVERING))
            continue
        least = min(least, c.rigid[n] + c.rounding)
        if c.mode[i] == STUCK:
            left = c.mu[i] * c.rigid[n] - math.hypot(c.rigid[n + 1], c.rigid[n + 2])
            least = min(least, left + c.rounding)
        elif c.mu[i] > 0.0:
            along = c.u[n + 1] * c.direction[i, 0] + c.u[n + 2] * c.direction[i, 1]
            least = min(least, along + (slow if c.start_slip[i] <= max(slow, rest) else -rest))
    return float(least)


@kernel
def save_contacts(links: ContactLinks, c: Contacts) -> None:
    """Keep speed and direction of the slips at the beginning of a substep, and which contacts have come clear."""
    for i in range(links.k):
        speed = math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])
        c.start_slip[i] = speed
        if c.mode[i] == PRESSED and speed > STICK_SPEED:
            c.direction[i, 0], c.direction[i, 1] = c.u[3 * i + 1] / speed, c.u[3 * i + 2] / speed
        if c.located[3 * i] > HOVERING:
            c.risen[i], c.floor[i] = 1.0, 0.0


@kernel
def move(links: ContactLinks, c: Contacts, w: Work) -> None:
    """Add to q̇ what the impulses F of the contacts make of it, L⁻ᵀ Xᵀ F."""
    for j in range(links.n):
        s = 0.0
        for i in range(3 * links.k):
            s += c.X[i, j] * c.F[i]
        w.column[j] = s
    back_substitute(w.L, w.column)
    for j in range(links.n):
        w.v[j] += w.column[j]
