"""The two phases of an impact, piece by piece: the kernel `impact`.

See `closedloop.mechanics.impact` for the theory. A piece ends where slip stops, where the normal velocity changes its
sign (the phase changes), where it turns round (so that inside a piece it is monotone and has one zero at most), at the
end of a series, or at the end of the impact.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.solve import DIVERGED, OK, SINGULAR
from closedloop.mechanics.impact.begin import (
    CUT,
    JAM,
    NEWTON,
    POISSON,
    RECOMPRESSION,
    RESTING,
    REVERSAL,
    SLIP,
    STILL,
    STRONGE,
    TURNING,
    WEDGE,
    begin_piece,
    to_extremum,
)
from closedloop.mechanics.impact.taylor import ORDER, ImpactWork, first_reach, value
from closedloop.mechanics.limits import AT_EDGE, EXACT, FOUND

# An approach, m/s, or a restitution below this is none: its square, in the work, would underflow.
TINY = 1e-150
# Random impacts need less than a tenth of it; more is that of a velocity that no tip with this S can have.
MOST_PIECES = 1000

# How a piece ends.
GOES_ON, STOPS, PHASE, ENDS = 0, 1, 2, 3


@kernel
def impact(
    S: Array, u: Array, restitution: float, law: int, mu: float, work: Array, phases: tuple[Array, Array], after: Array
) -> int:
    """Write the impulses of the two phases and the tip velocity after the impact.

    Parameters
    ----------
    S : (3, 3) array
        Mobility of the tip A H⁻¹Aᵀ in the contact frame (n, t1, t2), 1/kg, symmetric positive semidefinite.
    u : (3,) array
        Tip velocity before, m/s, in the contact frame. Unless u[0] < 0 nothing happens.
    restitution : float
        ε in [0, 1].
    law : int
        NEWTON, POISSON or STRONGE.
    mu : float
        Coulomb coefficient μ >= 0 of the circle |P_t| <= μ P_n.
    work : (ImpactWork.count(),) array
        Scratch. Written: `ImpactWork.happened`, what happened, a sum of the bits of
        `closedloop.mechanics.impact.begin`.
    phases : two (3,) arrays
        Written: impulse on the robot while u_n < 0, of compression, and while u_n > 0, of decompression, N s, in the
        contact frame.
    after : (3,) array
        Written: u + S (compression + decompression), m/s; its normal part is never negative.

    Returns
    -------
    status : int
        OK; SINGULAR if no impulse ends the approach (S_nn = 0, or u is no velocity of a tip with this S); DIVERGED if
        something is not finite. Unless OK, the impulses are zero and after = u.
    """
    compression, decompression = phases
    total = restitution + mu
    for i in range(3):
        compression[i] = 0.0
        decompression[i] = 0.0
        after[i] = u[i]
        total += u[i]
        for j in range(3):
            total += S[i, j]
    c = ImpactWork(work)
    c.happened = 0.0
    if not math.isfinite(total):
        return DIVERGED
    if not S[0, 0] > 0.0:
        return SINGULAR
    if u[0] > -TINY:
        after[0] = max(u[0], 0.0)
        return OK
    if restitution < TINY:
        restitution = 0.0
    happened = _collide(S, u, restitution, law, mu, c, compression, decompression)
    if happened < 0:
        for i in range(3):
            compression[i] = 0.0
            decompression[i] = 0.0
        return SINGULAR
    c.happened = happened
    for i in range(3):
        for j in range(3):
            after[i] += S[i, j] * (compression[j] + decompression[j])
    after[0] = max(after[0], 0.0)
    return OK


@kernel
def energy_lost(u: Array, after: Array, impulse: Array) -> float:
    """Return the kinetic energy that an impact took, J: −½ (u + u⁺)·P.

    `u`, `after` (3,), m/s, and the whole `impulse` P (3,), N s, in one frame. It is ½ vᵀHv before less after, for the
    joint velocity changes by H⁻¹AᵀP.
    """
    gained: float = 0.0
    for i in range(3):
        gained += 0.5 * (u[i] + after[i]) * impulse[i]
    return -gained


@kernel
def _collide(
    S: Array, u: Array, restitution: float, law: int, mu: float, c: ImpactWork, compression: Array, decompression: Array
) -> int:
    """Add up the pieces of the impact; return what happened, or -1 if it does not end."""
    c.w1[0], c.w2[0], c.un[0] = u[1], u[2], u[0]
    speed = math.hypot(u[0], math.hypot(u[1], u[2]))
    c.pn[0], c.p1[0], c.p2[0], c.work[0], c.energy[0] = 0.0, 0.0, 0.0, 0.0, 0.0
    slid = math.hypot(u[1], u[2]) > STILL * speed
    rebound = -restitution * u[0]
    compressing, happened = True, 0
    owed, energy = 0.0, 0.0  # what decompression still has to deliver, N s or J; the change of energy so far
    for _ in range(MOST_PIECES):
        kind, length, bits = begin_piece(S, mu, speed, c)
        happened |= bits
        if kind == RESTING and bits == SLIP and slid:
            happened |= REVERSAL
        degree = ORDER if kind == TURNING else 2
        end = STOPS if math.isfinite(length) else GOES_ON
        if kind == TURNING:
            end = GOES_ON
            length = to_extremum(S, mu, length, c)
        elif c.un[1] > AT_EDGE * S[0, 0]:
            enough = _enough(compressing, law, rebound, owed, c)
            if enough < length:
                length, end = enough, GOES_ON
        elif end == GOES_ON:
            # The normal velocity stays what it is, whatever the impulse.
            if abs(c.un[0]) > FOUND * speed:
                return -1
            happened |= WEDGE
            end, length = ENDS, max(owed, 0.0) if law == POISSON else 0.0
            compressing = False
        if end != ENDS:
            length, end, cut = _end_piece(compressing, law, rebound, owed, energy, (length, end, degree), c)
            happened |= cut
        if compressing and value(c.un, degree, length) < c.un[0]:
            happened |= JAM
        phase = compression if compressing else decompression
        normal, power = value(c.pn, degree, length), value(c.work, degree, length)
        phase[0] += normal
        phase[1] += value(c.p1, degree, length)
        phase[2] += value(c.p2, degree, length)
        energy += value(c.energy, degree, length)
        if law == POISSON:
            owed += restitution * normal if compressing else -normal
        elif law == STRONGE:
            owed += -restitution * restitution * power if compressing else -power
        if end == ENDS:
            return happened
        _move_on(degree, length, end, c)
        if end == PHASE:
            compressing = not compressing
            if compressing:
                happened |= RECOMPRESSION
            elif restitution == 0.0:
                return happened
    return -1


@kernel
def _enough(compressing: bool, law: int, rebound: float, owed: float, c: ImpactWork) -> float:
    """Return a normal impulse beyond the end of this phase, for a straight piece with du_n/dP_n > 0."""
    a: float = c.un[1]
    rate: float = c.un[0]
    if compressing:
        return -2.0 * rate / a
    if law == NEWTON:
        return 2.0 * max(rebound - rate, 0.0) / a
    if law == POISSON:
        return 2.0 * owed
    return 2.0 * math.sqrt(2.0 * max(owed, 0.0) / a)


@kernel
def _end_piece(
    compressing: bool,
    law: int,
    rebound: float,
    owed: float,
    energy: float,
    piece: tuple[float, int, int],
    c: ImpactWork,
) -> tuple[float, int, int]:  # fmt: skip
    """Return the length of a piece inside which u_n is monotone, how it ends, and CUT if energy ends it.

    `piece` has the length and the end that are known of it, and the degree of its polynomials.
    """
    length, end, degree = piece
    beyond = value(c.un, degree, length)
    if compressing:
        if beyond >= 0.0:
            return first_reach(c.un, degree, 0.0, length), PHASE, 0
        return length, end, 0
    if beyond < 0.0:
        length, end = first_reach(c.un, degree, 0.0, length), PHASE
    row, level = c.un, rebound
    if law == POISSON:
        row, level = c.pn, owed
    elif law == STRONGE:
        row, level = c.work, owed
    if level <= row[0]:
        return 0.0, ENDS, 0
    if value(row, degree, length) >= level:
        length, end = first_reach(row, degree, level, length), ENDS
    if law == NEWTON and energy < 0.0 and energy + value(c.energy, degree, length) > -EXACT * energy:
        return first_reach(c.energy, degree, -energy, length), ENDS, CUT
    return length, end, 0


@kernel
def _move_on(degree: int, length: float, end: int, c: ImpactWork) -> None:
    """Begin the next piece with the velocities at the end of this one."""
    x, y, normal = value(c.w1, degree, length), value(c.w2, degree, length), value(c.un, degree, length)
    c.w1[0], c.w2[0] = x, y
    c.un[0] = 0.0 if end == PHASE else normal
    if end == STOPS:
        c.w1[0], c.w2[0] = 0.0, 0.0
