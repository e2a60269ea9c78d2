"""The contacts of the links in a step: watched while they are open, else solved, the tip's among them, together.

With H = L Lᵀ, y = L⁻¹(Q − C) of the tree, less what loops bind (`closedloop.loop.step.closed_loops`), and X = L⁻¹Gᵀ of
all contacts, likewise, the acceleration of the contacts is u̇ = X y + drift + X Xᵀ F. An event
(`closedloop.loop.events.contacts`) is dealt with in two parts: impacts, if contacts come together, then at the state
after them the modes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.jit.pointers import row_of
from closedloop.loop.step.contact_rows import locate_contacts, locate_points, place_contacts
from closedloop.loop.step.locate import set_anchor
from closedloop.loop.step.memory import State, Work, loop_at
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK, accelerate, pressed_force, stuck_force
from closedloop.mechanics.closure.solve import OK, PAINLEVE, back_substitute
from closedloop.mechanics.contacts.given_modes import (
    keep_in_cones,
    kinds_of_modes,
    own_mobility,
    solve_modes,
    write_after,
)
from closedloop.mechanics.contacts.impact import RESTING, STRUCK_AND_LEFT, STRUCK_AND_STAYED, apply_impulses
from closedloop.mechanics.contacts.memory import LINE, OFF, RAY, ContactLinks, Contacts, contacts_at
from closedloop.mechanics.contacts.modes import CLOSED_GAP, HOVERING, decide, touches
from closedloop.mechanics.contacts.soft import soft_margin
from closedloop.mechanics.contacts.time_step import begin_time_step
from closedloop.mechanics.impact import energy_lost

Array = NDArray[np.float64]

# What the contacts are asked for.
FORCE, WATCH, SAVE, PLACE, IMPULSE, DECIDE = range(6)


@entry_kernel
def contacts_in_step(address: int, what: int) -> int:
    """Answer for the contacts, by the address of their memory; return a status of `closedloop.mechanics.closure.solve`.

    FORCE    write the forces at the state in `Work`, q̈, and the margin of the event function
    WATCH    write the gaps of the links' contacts, all of them open, and the least as that margin
    SAVE     keep what a substep begins with
    PLACE    write where the contacts are, and which of them strikes alone
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
    elif what == WATCH:
        status = locate_points(links, c, w, constants, state)
        c.margin = math.inf
        for i in range(1, links.k - links.stops):
            c.margin = min(c.margin, open_margin(c, i))
        w.contact_margin = c.margin
    elif what == SAVE:
        save_contacts(links, c)
    elif what == PLACE:
        place_contacts(links, c, w)
        state.striking = striking_alone(links, c)
    elif what == IMPULSE:
        if state.striking < 0:
            status = apply_impulses(links, c, constants.rest_speed)
        else:
            apply_impulse_alone(links, c, w, state.striking, state.kind == int(STRUCK_AND_LEFT))
        move(links, c, w)
    else:
        place_contacts(links, c, w)
        status = PAINLEVE
        if links.tired < 2:
            status = decide(links, c, (3.0 if state.steps < 0 else 1.0) * constants.stick_speed)
        if status == PAINLEVE and links.fresh == 0:
            status = begin_time_step(links, c, w.time)
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
    elif links.stepped != 0:
        for i in range(3 * k):
            c.F[i] = c.rigid[i] = c.step_force[i]
        c.margin = c.step_end - w.time
        for i in range(k):
            if c.mode[i] == FREE and c.kind[i] != LINE:
                c.margin = min(c.margin, open_margin(c, i))
    else:
        kinds_of_modes(c, k)
        status = solve_closed(c, k)
        if c.kind[0] == LINE and c.rigid[0] < 0.0 and (c.along[0, 0] != 0.0 or c.along[0, 1] != 0.0):
            c.along[0, 0], c.along[0, 1] = -c.along[0, 0], -c.along[0, 1]  # what pulls rubs with |f|
            status = solve_modes(c, k)
        keep_in_cones(c, k)
        c.margin = margin_of(c, k, STICK_SPEED, 2.0 * STICK_SPEED if state.steps < 0 else 0.0)
        if status != OK and w.time > 0.0:  # these modes end here: others, or a time step, go on
            status, c.margin = OK, NO_FORCES
    w.contact_margin, w.contact_power, w.contact_power_rate = c.margin, 0.0, 0.0
    for i in range(3):
        w.F[i], w.b[i], w.stabiliser_force[i] = c.F[i], c.b[i], c.F[i] - c.rigid[i]
    w.rigid_force = c.rigid[0]
    for j in range(n):
        w.contact_torque[j] = 0.0
    for i in range(3, 3 * k):
        if c.F[i] == 0.0:
            continue
        w.contact_power += c.F[i] * (c.u[i] + c.carried[i])
        for j in range(n):
            w.contact_torque[j] += c.G[i, j] * c.F[i]
            w.y[j] += c.X[i, j] * c.F[i]
    accelerate(w.L, w.X, w.y, w.F, w.qdd)
    for i in range(3, 3 * k if state.stages == 1 else 0):
        growth = c.drift[i] - c.turning[i]
        for j in range(n):
            growth += c.G[i, j] * w.qdd[j]
        w.contact_power_rate += c.F[i] * growth
    return status


@kernel
def solve_closed(c: Contacts, k: int) -> int:
    """Write F, `rigid` and `rounding` in the present modes: of one contact by its closed form, else of all."""
    alone = -1
    for i in range(k):
        if c.kind[i] != OFF:
            if alone >= 0 or c.kind[i] == LINE:
                return int(solve_modes(c, k))
            alone = i
    if alone < 0 or not solve_one(c, k, alone):
        return int(solve_modes(c, k))
    return int(OK)


@kernel
def solve_one(c: Contacts, k: int, i: int) -> bool:
    """Do `solve_modes` for contact i, the only one closed, by the closed form of the tip, where there is one."""
    at, n, asked = 3 * i, c.X.shape[1], 0.0
    S, a, b, F, rigid = c.slope, c.a[at : at + 3], c.b[at : at + 3], c.F[at : at + 3], c.rigid[at : at + 3]
    own_mobility(c, i, S)
    for j in range(3 * k):
        c.F[j], c.rigid[j] = 0.0, 0.0
    if c.kind[i] == RAY:
        along, viscous = row_of(c.along, i), c.viscous[at + 1 : at + 3]
        status, share = pressed_force(S, a, b[0], along, viscous, F)
        if status != OK:
            return False
        rigid[0] = F[0] - share
        rigid[1], rigid[2] = -along[0] * rigid[0] - viscous[0], -along[1] * rigid[0] - viscous[1]
    else:
        if stuck_force(S, a, b, F, rigid) != OK:
            return False
        for j in range(3):
            rigid[j] = F[j] - rigid[j]
    size, most = 0.0, 0.0
    for r in range(at, at + (1 if c.kind[i] == RAY else 3)):
        s = abs(c.drift[r]) + abs(c.b[r])
        for j in range(n):
            s += abs(c.X[r, j] * c.load[j])
        asked = max(asked, s)
    for j in range(3):
        size, most = max(size, abs(rigid[j])), max(most, S[j, j])
    c.rounding = 1e-10 * max(size, asked / most)
    return True


# The margin where no forces go with the modes.
NO_FORCES = -1e30
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
            least = min(least, open_margin(c, i))
            continue
        least = min(least, c.rigid[n] + c.rounding if c.soft[i] == 0.0 else soft_margin(c, i))
        if c.mode[i] == STUCK:
            left = c.mu[i] * c.rigid[n] - math.hypot(c.rigid[n + 1], c.rigid[n + 2])
            least = min(least, left + c.rounding)
        elif c.mu[i] > 0.0:
            along = c.u[n + 1] * c.direction[i, 0] + c.u[n + 2] * c.direction[i, 1]
            least = min(least, along + (slow if c.start_slip[i] <= max(slow, rest) else -rest))
    return float(least)


@kernel
def open_margin(c: Contacts, i: int) -> float:
    """Return what is left until contact i, which is open, closes, m."""
    return float(c.located[3 * i] - c.floor[i] + (CLOSED_GAP if c.risen[i] != 0.0 else HOVERING))


@kernel
def striking_alone(links: ContactLinks, c: Contacts) -> int:
    """Return the contact that strikes while no other is closed or closes, −1 if there is none such."""
    alone = -1
    for i in range(links.k):
        if c.soft[i] != 0.0:
            continue
        if c.kind[i] == LINE or (touches(links, c, i) and (alone >= 0 or c.mode[i] != FREE)):
            return -1
        if touches(links, c, i):
            alone = i
    if alone < 0 or alone >= links.k - links.stops or not c.u[3 * alone] < -RESTING:
        return -1
    return alone


@kernel
def apply_impulse_alone(links: ContactLinks, c: Contacts, w: Work, i: int, leaves: bool) -> None:
    """Write what the impulse of a contact that strikes alone does, which `collide` has left in `Work`."""
    k, at = links.k, 3 * i
    for j in range(3 * k):
        c.F[j], c.before[j] = 0.0, c.u[j]
    for j in range(k):
        c.happened[j], c.struck[j], c.pulled[j], c.outside[j] = 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        c.F[at + j] = w.compression[j] + w.decompression[j]
    write_after(c, k)
    c.energy_lost, c.restitution_share, c.struck[i] = energy_lost(w.before, w.after, c.F[at : at + 3]), 1.0, 1.0
    c.energy_rested = w.energy_rested
    c.happened[i] = STRUCK_AND_LEFT if leaves else STRUCK_AND_STAYED
    c.mode[i], c.risen[i], c.floor[i] = FREE if leaves else PRESSED, 1.0, min(c.located[at], 0.0)


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
