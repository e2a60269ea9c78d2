"""The instant at which the first of several slow slips ends within a step.

All are those of the problem of `closedloop.mechanics.contacts.turning`, which is solved for steps τ of other lengths.
"""

from __future__ import annotations

import math

from closedloop.jit.dual8 import along, has_derivatives, settled, slope_of, sought
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import CONE, LINE, OFF, RAY, Contacts
from closedloop.mechanics.contacts.resistance import is_resistance
from closedloop.mechanics.contacts.turning import left_of_slips, level_of, pack_problem, solve_within, unpack_problem

# Of the search for τ: evaluations on each side, the factor of the first, how near to its edge friction is found then;
# and by which share of 1/τ before it derivatives are taken.
SEARCHES, WIDER, ON_EDGE, BESIDE_EDGE = 30, 4.0, 1e-12, 1e-8


@kernel
def stop_slips(c: Contacts, k: int, h: float) -> float:
    """Return the time after which the first of several slow slips ends, s, if in this step; else infinity.

    Until then constant forces, `TimeStep.force`, act as in a time step (`closedloop.mechanics.contacts.time_step`):
    every contact is in its cone with what is left of its slip. So all that stops together does so, and no contact stops
    another. The slip of one contact alone ends where its own friction stops it.
    """
    if c.problem.ends == 0.0:
        return math.inf
    for r in range(3 * k):
        c.before[r] = c.F[r]
    count, rate = pack_problem(c, k, h, True), 0.0 * h
    c.problem.steps = 0.0
    if count > 1 and solve_within(c, count, 1.0 / h):
        rate = shorten(c, count, h)
    unpack_problem(c, k, count)
    for i in range(k):
        if c.problem.form[i] != OFF and not is_resistance(c, i):
            put_into_cone(c, i)
    for r in range(3 * k):
        c.step.force[r] = c.F[r] - c.viscous[r]
        c.F[r] = c.before[r]
    return float(1.0 / rate) if rate > 0.0 else math.inf


@kernel
def put_into_cone(c: Contacts, i: int) -> None:
    """Replace the force of contact i, which may be outside its cone by what the solution is off, by one inside."""
    F, form = c.F[3 * i : 3 * i + 3], c.problem.form[i]
    mu = level_of(c, i) if form in (RAY, LINE) else c.mu[i]
    size, most = math.hypot(F[1], F[2]), mu * abs(F[0])
    if F[0] < 0.0 and form in (RAY, CONE):
        F[0], F[1], F[2] = 0.0, 0.0, 0.0
    elif size > most:
        F[1], F[2] = F[1] * (most / size), F[2] * (most / size)


@kernel
def shorten(c: Contacts, k: int, h: float) -> float:
    """Return 1/τ of the τ at which the first slip ends just then, s⁻¹, within the step; zero if that was not found."""
    low, at_low = 1.0 / h, left_of_slips(c, k)
    if not at_low < 0.0:
        return 0.0 * low
    high, at_high = low, at_low
    for _ in range(SEARCHES):
        high *= WIDER
        if not solve_within(c, k, high):
            return 0.0 * low
        at_high = left_of_slips(c, k)
        if at_high >= 0.0:
            break
        low, at_low = high, at_high
    if not at_high >= 0.0:
        return 0.0 * low
    rate, side = high, 0
    for _ in range(SEARCHES if at_high > ON_EDGE else 0):  # the method of Illinois
        rate = (low * at_high - high * at_low) / (at_high - at_low)
        if not solve_within(c, k, rate):
            return 0.0 * low
        now = left_of_slips(c, k)
        if abs(now) <= ON_EDGE or high - low <= ON_EDGE * high:
            break
        if now < 0.0:
            low, at_low, at_high, side = rate, now, at_high * (0.5 if side < 0 else 1.0), -1
        else:
            high, at_high, at_low, side = rate, now, at_low * (0.5 if side > 0 else 1.0), 1
    return settle(c, k, rate) if has_derivatives(rate) else rate


@kernel
def settle(c: Contacts, k: int, rate: float) -> float:
    """Return the 1/τ that was found with its derivatives, s⁻¹, and solve the problem there once more.

    A search that ends at an end of its bracket, as where friction is on its edge at once, has found none. Its equation
    is asked a little before slip ends: at the edge itself rounding would decide between two slopes.
    """
    beside = (1.0 + BESIDE_EDGE) * sought(rate)
    for r in range(3 * k):
        c.path.point[r] = c.F[r]
    if not solve_within(c, k, along(beside)):
        return 0.0 * rate
    slope = slope_of(left_of_slips(c, k))
    for r in range(3 * k):
        c.F[r] = c.path.point[r]
    if not solve_within(c, k, beside):
        return 0.0 * rate
    rate = settled(sought(rate), left_of_slips(c, k), slope)
    return rate if solve_within(c, k, rate) else 0.0 * rate
