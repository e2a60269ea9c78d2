"""The instant at which the first of several slow slips ends within a step.

All are those of the problem of `closedloop.mechanics.contacts.turning`, which is solved for steps τ of other lengths.
"""

from __future__ import annotations

import math

from closedloop.jit.dual8 import along, has_derivatives, settled, slope_of, sought
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import Contacts
from closedloop.mechanics.contacts.turning import left_of_slips, pack_problem, solve_within, unpack_problem
from closedloop.mechanics.root import next_share

# Of the search for τ: evaluations on each side, the factor of the first, by which share friction is then inside its
# cone, and how near to that.
SEARCHES, WIDER, INSIDE, NEAR = 30, 4.0, 1e-9, 1e-13


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
    for r in range(3 * k):
        c.step.force[r] = c.F[r] - c.viscous[r]
        c.F[r] = c.before[r]
    return float(1.0 / rate) if rate > 0.0 else math.inf


@kernel
def shorten(c: Contacts, k: int, h: float) -> float:
    """Return 1/τ of the τ at which the first slip has just ended, s⁻¹, within the step; zero if that was not found.

    All forces there are inside their cones, and the slips that end are zero: which of two slopes a derivative has, and
    how much slip is left, is not up to rounding.
    """
    low, at_low = 1.0 / h, just_ended(c, k)
    if not at_low < 0.0:
        return 0.0 * low
    high, at_high = low, at_low
    for _ in range(SEARCHES):
        high *= WIDER
        if not solve_within(c, k, high):
            return 0.0 * low
        at_high = just_ended(c, k)
        if at_high >= 0.0:
            break
        low, at_low = high, at_high
    if not at_high >= 0.0:
        return 0.0 * low
    rate, now, share = high, at_high, at_high / (at_high - at_low)
    for _ in range(SEARCHES):
        if abs(now) <= NEAR or high - low <= NEAR * high:
            break
        rate += share * (low - high if rate == high else high - low)
        if not solve_within(c, k, rate):
            return 0.0 * low
        now = just_ended(c, k)
        if now < 0.0:
            old, at_old, low, at_low = low, at_low, rate, now
            share = next_share(low, now, high, at_high, old, at_old)
        else:
            old, at_old, high, at_high = high, at_high, rate, now
            share = next_share(high, now, low, at_low, old, at_old)
    return settle(c, k, rate) if has_derivatives(rate) else rate


@kernel
def just_ended(c: Contacts, k: int) -> float:
    """Return `left_of_slips` where that is not zero but a little below."""
    return left_of_slips(c, k) + INSIDE


@kernel
def settle(c: Contacts, k: int, rate: float) -> float:
    """Return the 1/τ that was found with its derivatives, s⁻¹, and solve the problem there once more."""
    for r in range(3 * k):
        c.path.point[r] = c.F[r]
    if not solve_within(c, k, along(rate)):
        return 0.0 * rate
    slope = slope_of(left_of_slips(c, k))
    for r in range(3 * k):
        c.F[r] = c.path.point[r]
    if not solve_within(c, k, sought(rate)):
        return 0.0 * rate
    rate = settled(sought(rate), left_of_slips(c, k), slope)
    return rate if solve_within(c, k, rate) else 0.0 * rate
