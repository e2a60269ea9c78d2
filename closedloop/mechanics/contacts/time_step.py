"""One time step at the level of impulses, where no modes are found with which forces and accelerations agree.

    u⁺ = u + h a + W P,     P ∈ K,     u⁺ + μ|u⁺_t| n ∈ K*,     Pᵀ(u⁺ + μ|u⁺_t| n) = 0

the step of time-stepping schemes (J. J. Moreau, in Nonsmooth Mechanics and Applications, Springer, 1988; D. E. Stewart
and J. C. Trinkle, Int. J. Numer. Methods Eng. 39, 1996) for the contacts that touch, without restitution. It has a
solution where accelerations have none: where a contact slides so that pressing harder pulls it in (P. Painlevé, 1895),
its impulse stops the slip at once, as in an impact without collision (F. Génot and B. Brogliato, Eur. J. Mech. A 18,
1999). The forces are P/h until the step has ended; then the modes are sought anew.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.closure.solve import OK, PAINLEVE
from closedloop.mechanics.contacts.complementarity import largest_mobility, solve_contacts, sweep, write_residuals
from closedloop.mechanics.contacts.continuation import force_size
from closedloop.mechanics.contacts.memory import CONE, LINE, OFF, RAY, ContactLinks, Contacts
from closedloop.mechanics.contacts.modes import happened_to, touches

Array = NDArray[np.float64]

# Length of the step, s; sweeps where nothing else finds the impulses, and the residual, of the largest, they may then
# have.
SPAN, SWEEPS, NEAR = 2e-5, 2000, 1e-6
# What happened to a contact, as the kinds of `closedloop.loop.events.table`.
TIME_STEP = 10.0


@kernel
def begin_time_step(links: ContactLinks, c: Contacts, time: float) -> int:
    """Write the forces of a step that begins at this time, s, the modes after it, and no impulse.

    Returns
    -------
    int
        OK, or PAINLEVE if no impulses were found.
    """
    k = links.k
    for i in range(3 * k):
        c.F[i], c.before[i], c.q[i] = 0.0, c.u[i], c.u[i] + SPAN * c.a[i]
    for i in range(k):
        c.along[i, 0], c.along[i, 1] = 0.0, 0.0
        if c.kind[i] != LINE:
            c.kind[i] = OFF
            if touches(links, c, i):
                c.kind[i] = CONE if c.mu[i] > 0.0 else RAY
    if not solve_contacts(c, k) and not come_near(c, k):
        return PAINLEVE
    links.stepped, c.step_end = 1, time + SPAN
    told = False
    for i in range(k):
        at = 3 * i
        for j in range(at, at + 3):
            c.step_force[j] = c.F[j] / SPAN
        c.happened[i], c.start_slip[i] = 0.0, 0.0
        if c.kind[i] == LINE:
            continue
        mode = PRESSED if c.F[at] > 0.0 else FREE  # what sticks after the step is found then
        c.happened[i] = happened_to(c, i, mode)
        if mode == FREE and c.kind[i] != OFF:
            c.risen[i], c.floor[i] = 0.0, min(c.located[at], 0.0)
        if mode != FREE and not told:
            c.happened[i], told = TIME_STEP, True
        c.mode[i] = mode
    for i in range(3 * k):
        c.F[i], c.after[i] = 0.0, c.u[i]
    c.energy_lost = c.energy_rested = 0.0
    return OK


@kernel
def come_near(c: Contacts, k: int) -> bool:
    """Write F by sweeps of Gauss and Seidel's method alone; return whether it is near a solution."""
    largest, asked = largest_mobility(c, k), force_size(c.q, 3 * k)
    if not largest > 0.0:
        return False
    for i in range(3 * k):
        c.F[i] = 0.0
    for _ in range(SWEEPS):
        sweep(c, k, c.F, largest)
    c.penalty = 1.0
    c.residual = write_residuals(c, k, c.F, largest)
    return bool(c.residual <= NEAR * max(asked / largest, force_size(c.F, 3 * k)))
