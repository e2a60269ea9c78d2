"""Where the contacts of the links are: their gaps, velocities, rows and mobility, and what the stabiliser asks for.

A contact with a surface that is curved or moves has rows x, y, z of the frame that carries it, which are turned into n,
t1, t2 of the surface at the point; a stop of a joint has the row ± q̇ of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import integers_at, row_of, vector_at
from closedloop.loop.step.locate import off_anchor
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.mechanics.closure.contact_force import FREE, baumgarte_acceleration
from closedloop.mechanics.closure.solve import NO_NORMAL, OK, forward_substitute
from closedloop.mechanics.contacts.given_modes import mobility_of
from closedloop.mechanics.contacts.memory import LINE, OFF, ContactLinks, Contacts
from closedloop.mechanics.contacts.modes import HOVERING
from closedloop.mechanics.contacts.soft import write_soft_forces
from closedloop.mechanics.loops.memory import loops_at, tree_at
from closedloop.mechanics.loops.rows import ALONG, POINT, locate_rows, move_point, turn_direction
from closedloop.mechanics.loops.solve import leave_free
from closedloop.mechanics.surface.contact import CONTACT, FOUND, ask_at
from closedloop.mechanics.surface.geometry import Touch

Array = NDArray[np.float64]


@kernel
def locate_contacts(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> int:
    """Write rows, mobility and free acceleration of the contacts, and what the stabiliser asks for.

    Those of a contact that is open, and not about to close, are zero: it costs its gap.

    Returns
    -------
    int
        OK, or NO_NORMAL where a surface has none.
    """
    n, k = links.n, links.k
    if locate_points(links, c, w, constants, state) != OK:
        return NO_NORMAL
    locate_stops(links, c, w, constants)
    for i in range(3):
        c.located[i] = w.gap if i == 0 else off_anchor(w, state, i)
        c.u[i], c.drift[i], c.a[i], c.carried[i], c.turning[i] = w.u[i], w.drift_c[i], w.a[i], 0.0, 0.0
    for j in range(n):
        c.load[j] = w.y[j]
    for i in range(k):
        near = c.mode[i] != FREE or c.located[3 * i] <= HOVERING or (i == 0 and state.unilateral == 0)
        if near or c.near[i] != 0.0:
            write_mobility_rows(c, i, near, w, state)
        c.near[i] = 1.0 if near else 0.0
    mobility_of(c, k)
    for i in range(k):
        for j in range(3 * i, 3 * i + 3):
            off = c.located[j]
            if j > 3 * i and i > 0 and not asked(links, i):
                c.at[j] = c.located[j]
                off -= c.anchor[j]
            c.b[j] = baumgarte_acceleration(constants.s_v, constants.s_p, c.u[j], off)
    c.kind[0] = OFF
    if state.unilateral == 0:
        c.kind[0] = LINE
        for i in range(2):
            c.along[0, i], c.viscous[1 + i] = w.c[i], w.viscous[i]
    write_soft_forces(links, c)
    return int(OK)


@kernel
def locate_points(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> int:
    """Write gaps, velocities and rows of the contacts of links; return OK, or NO_NORMAL where a surface has none."""
    joints, rows = loops_at(links.rows)
    for j in range(links.n):
        rows.q[j], rows.v[j] = w.q[j], w.v[j]
    locate_rows(joints, rows)
    for r in range(joints.m):
        i = r + 3
        c.located[i], c.u[i], c.drift[i] = rows.error[r], rows.rate[r], rows.drift[r]
        for j in range(links.n):
            c.G[i, j] = rows.G[r, j]
    for i in range(1, links.k if links.surfaces != 0 else 0):
        if not turn_to_surface(links, c, i, w.time, constants.h, state):
            return int(NO_NORMAL)
    return int(OK)


@kernel
def write_mobility_rows(c: Contacts, i: int, near: bool, w: Work, state: State) -> None:
    """Write X = L⁻¹Gᵀ of contact i, less what loops bind, and its free acceleration; zeros if it is not near."""
    n = c.X.shape[1]
    for r in range(3 * i, 3 * i + 3):
        if i == 0:
            for j in range(n):
                c.G[r, j], c.X[r, j] = w.A[r, j], w.X[r, j] if near else 0.0
            continue
        for j in range(n):
            c.X[r, j] = c.G[r, j] if near else 0.0
        c.a[r] = c.drift[r]
        if not near:
            for j in range(c.W.shape[0]):
                c.W[r, j], c.W[j, r] = 0.0, 0.0
            continue
        forward_substitute(w.L, row_of(c.X, r))
        for j in range(n):
            c.a[r] += c.X[r, j] * w.y[j]
        if state.loops != 0:
            bound, loops = loops_at(state.loops_at)
            leave_free(bound, loops, row_of(c.X, r))


@kernel
def asked(links: ContactLinks, i: int) -> bool:
    """Whether the surface of contact i is asked for its normal."""
    return bool(links.surfaces != 0 and integers_at(links.surfaces, 2 * links.k)[2 * i] != 0)


@kernel
def turn_to_surface(links: ContactLinks, c: Contacts, i: int, time: float, h: float, state: State) -> bool:
    """Turn the rows of a contact from the axes of the frame that carries its surface to n, t1, t2 of that surface.

    Returns False where there is no normal, or a contact that touches comes to where there is none within the step h, s.
    """
    if not asked(links, i):
        return True
    where, n = integers_at(links.surfaces, 2 * links.k), 3 * i
    own, ask = ask_at(where[2 * i + 1])
    ask.time = time
    for j in range(3):
        ask.r[j], ask.velocity[j] = c.located[n + j], c.u[n + j]
    if call_at(where[2 * i], own.address, CONTACT) != FOUND:
        return False
    touch, N = Touch(ask.touch), ask.frame
    if c.mode[i] != FREE and touch.growth * h < -1.0:
        return False
    for j in range(links.n):
        g0, g1, g2 = c.G[n, j], c.G[n + 1, j], c.G[n + 2, j]
        for a in range(3):
            c.G[n + a, j] = N[a, 0] * g0 + N[a, 1] * g1 + N[a, 2] * g2
    d0, d1, d2 = c.drift[n], c.drift[n + 1], c.drift[n + 2]
    c.located[n] = touch.level / touch.size
    for a in range(3):
        c.carried[n + a], c.turning[n + a], c.at[n + a] = touch.carried[a], touch.turning[a], touch.at[a]
        c.u[n + a] = N[a, 0] * ask.velocity[0] + N[a, 1] * ask.velocity[1] + N[a, 2] * ask.velocity[2]
        c.u[n + a] -= touch.carried[a]
        c.drift[n + a] = N[a, 0] * d0 + N[a, 1] * d1 + N[a, 2] * d2 + touch.turning[a]
        if a > 0:
            c.located[n + a] = 0.0
            for j in range(3):
                c.located[n + a] += touch.local[a, j] * (touch.at[j] - c.anchor[n + j])
    return True


@kernel
def locate_stops(links: ContactLinks, c: Contacts, w: Work, constants: Constants) -> None:
    """Write rows, gaps and rates of the stops: of a joint that is at none the nearer of its two."""
    for i in range(links.k - links.stops, links.k):
        at, j = 3 * i, int(c.joint[i])
        low, high = w.q[j] - constants.lower_stop[j], constants.upper_stop[j] - w.q[j]
        if c.mode[i] == FREE:
            c.side[i] = 1.0 if low <= high else -1.0
        c.located[at] = low if c.side[i] > 0.0 else high
        c.u[at], c.G[at, j] = c.side[i] * w.v[j], c.side[i]


@kernel
def place_contacts(links: ContactLinks, c: Contacts, w: Work) -> None:
    """Write the axes of the contacts and where they are, base axes, at the state that was located last."""
    joints, rows = loops_at(links.rows)
    tree, work = tree_at(joints), vector_at(joints.scratch, joints.scratch_size)
    sides = integers_at(joints.bound, 3 * joints.m)
    for j in range(3):
        c.point[0, j] = w.r[j]
        for i in range(3):
            c.axes[i, j] = w.frame[i, j]
    a, b = row_of(rows.motions, 0), row_of(rows.motions, 1)
    for r in range(joints.m):
        move_point(tree, work, sides[joints.m + r], row_of(rows.at_a, r), a)
        turn_direction(tree, work, sides[2 * joints.m + r], row_of(rows.along_b, r), b)
        for j in range(3):
            c.axes[3 + r, j], c.point[1 + r // 3, j] = b[ALONG + j], a[POINT + j]
    for i in range(1, links.k if links.surfaces != 0 else 0):
        if asked(links, i):
            _, ask = ask_at(integers_at(links.surfaces, 2 * links.k)[2 * i + 1])
            for j in range(3):
                x, y, z = c.axes[3 * i, j], c.axes[3 * i + 1, j], c.axes[3 * i + 2, j]
                for axis in range(3):
                    turned = ask.frame[axis, 0] * x + ask.frame[axis, 1] * y + ask.frame[axis, 2] * z
                    c.axes[3 * i + axis, j] = turned
    for i in range(links.k - links.stops, links.k):
        for j in range(3):
            c.point[i, j] = w.r[j]
