"""How tip and joints share what holds an arm at rest: rigid bodies do not determine it; least friction is given.

While all joints rest within their friction, a force δF more at the tip and a torque −Aᵀ δF more in the joints hold the
arm as before: the contact force is not determined by rigid bodies. Of all F and joint torques d that hold it, with d
within its limits and a tip that sticks within its cone, the ones are taken whose friction has the least norm,

    |F_t|² + |d|²        N and N m (N) alike, as for reactions of loops that are not unique

and f is what then balances: the f of an arm without friction, if that is at rest too. Where the cone leaves this out,
F_t weighs more, as much as it takes. So f depends on the state alone, not on the rounding of a velocity.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.loop.step.memory import RIGID_STICK, SMOOTH, Constants, State, Work
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.friction.answers import LIMIT
from closedloop.mechanics.friction.law import AT_REST
from closedloop.mechanics.limits import AT_EDGE, EXACT, ITERATIONS, SWEEPS

# The weight of F_t at most.
HEAVIEST = 1e8


@kernel
def at_rest(w: Work, constants: Constants) -> bool:
    """Return whether every joint has friction that may hold it, and rests at the end of a step too."""
    for j in range(w.q.shape[0]):
        if (
            not w.joint_friction.limit[j] > 0.0
            or abs(w.v[j]) > AT_REST
            or abs(w.v[j] + constants.h * w.qdd[j]) > AT_REST
        ):
            return False
    return True


@kernel
def share_friction(w: Work, constants: Constants, state: State) -> None:
    """Replace F, and the friction of the joints, by those of least friction that hold the arm alike, where it rests."""
    n = w.q.shape[0]
    held = state.mode == STUCK and state.friction.sticking == RIGID_STICK
    if state.mode == FREE or state.loops.entry != 0 or state.coupled != 0 or not at_rest(w, constants):
        return
    if not held and (state.compliance.entry != 0 or state.friction.sticking != SMOOTH):
        return
    first, count = 1 if state.compliance.entry != 0 else 0, 3 if held else 1
    at = 16 + n
    d = w.scratch.numbers[at : at + n]
    multipliers, change, trial = (
        w.scratch.numbers[at + n : at + 2 * n],
        w.scratch.numbers[at + 2 * n :][:3],
        w.scratch.numbers[at + 2 * n :][3:6],
    )
    inverse = w.scratch.numbers[at + 2 * n + 6 :][:9]
    for j in range(n):
        d[j] = w.joint_friction.torque[j] + w.joint_friction.viscous[j]
    if held:
        call_at(state.friction.entry, state.address, LIMIT)
    if not weigh(w, d, 1.0, first, count, inverse, multipliers, change):
        return
    if held and not in_cone(w, change):
        low, high = 0.0, math.log(HEAVIEST)
        if not weigh(w, d, HEAVIEST, first, count, inverse, multipliers, change) or not in_cone(w, change):
            return  # it cannot stick, or f would have to be another: what the joints have found stays
        for _ in range(ITERATIONS):
            middle = 0.5 * (low + high)
            if weigh(w, d, math.exp(middle), first, count, inverse, multipliers, trial) and in_cone(w, trial):
                high = middle
                for i in range(3):
                    change[i] = trial[i]
            else:
                low = middle
    move_force(w, change)


@kernel
def in_cone(w: Work, change: Array) -> bool:
    """Return whether F with this change is in the cone of friction of a tip that sticks."""
    size = math.hypot(w.tip.F[1] + change[1], w.tip.F[2] + change[2])
    return bool(size <= (1.0 - AT_EDGE) * w.friction.stick_limit * (w.tip.F[0] + change[0]))


@kernel
def move_force(w: Work, change: Array) -> None:
    """Add a change to F and take its torque from the joints' friction: q̈ stays; what Eq. 24 was solved from moves."""
    for i in range(3):
        w.tip.F[i] += change[i]
        for k in range(3):
            w.tip.a[i] -= w.tip.S[i, k] * change[k]
        for j in range(w.q.shape[0]):
            w.joint_friction.torque[j] -= w.tip.A[i, j] * change[i]
            w.y[j] -= w.tip.X[i, j] * change[i]
    w.tip.rigid_force += change[0]


@kernel
def weigh(
    w: Work, d: Array, weight: float, first: int, count: int, inverse: Array, multipliers: Array, change: Array
) -> bool:
    """Write the change (3,) of F for the least weight |F_t|² + |d|², with |d| within its limits; False if none is.

    C. Hildreth's method (Naval Res. Logist. Q. 4, 1957): the least of all, then one limit after the other.
    """
    n = w.q.shape[0]
    if not invert(w, weight, first, count, inverse):
        return False
    for i in range(3):
        change[i] = 0.0
    for j in range(n):
        multipliers[j] = 0.0
    for k in range(first, first + min(count, 3 - first)):
        b = -weight * w.tip.F[k] if k > 0 else 0.0
        for j in range(n):
            b += w.tip.A[k, j] * d[j]
        for i in range(3):
            change[i] += inverse[3 * i + k] * b
    for _ in range(SWEEPS):
        most = 0.0
        for j in range(n):
            gain, torque = 0.0, d[j]
            for i in range(3):
                torque -= w.tip.A[i, j] * change[i]
                for k in range(3):
                    gain += w.tip.A[i, j] * inverse[3 * i + k] * w.tip.A[k, j]
            if not gain > 0.0:
                continue
            free = torque - multipliers[j] * gain
            most_torque = w.joint_friction.limit[j]
            new = (min(max(free, -most_torque), most_torque) - free) / gain
            for i in range(3):
                for k in range(3):
                    change[i] -= inverse[3 * i + k] * w.tip.A[k, j] * (new - multipliers[j])
            most = max(most, abs(new - multipliers[j]) * gain)
            multipliers[j] = new
        if most <= EXACT:
            return True
    return False


@kernel
def invert(w: Work, weight: float, first: int, count: int, inverse: Array) -> bool:
    """Write the inverse (9,) of A Aᵀ + weight·diag(0, 1, 1) in the directions in which F is free, zero in others."""
    m = inverse
    for i in range(3):
        for k in range(3):
            s = 0.0
            if first <= i < first + count and first <= k < first + count:
                for j in range(w.q.shape[0]):
                    s += w.tip.A[i, j] * w.tip.A[k, j]
                if i == k and i > 0:
                    s += weight
            elif i == k:
                s = 1.0
            m[3 * i + k] = s
    a, b, c, e, f, g = m[0], m[1], m[2], m[4], m[5], m[8]
    p, q, r = e * g - f * f, c * f - b * g, b * f - c * e
    det = a * p + b * q + c * r
    if not det > 0.0:
        return False
    m[0], m[1], m[2], m[4], m[5], m[8] = (
        p / det,
        q / det,
        r / det,
        (a * g - c * c) / det,
        (b * c - a * f) / det,
        (a * e - b * b) / det,
    )
    m[3], m[6], m[7] = m[1], m[2], m[5]
    for i in range(3):
        if not first <= i < first + count:
            m[4 * i] = 0.0
    return True
