"""Friction in the joints, with the laws of `closedloop.mechanics.friction`, one joint beside the other.

Laws with states (dahl, lugre) and seven_parameter give a torque from the state of the joint. A law that sticks rigidly
(coulomb, coulomb_viscous, stribeck, karnopp) gives at rest whatever torque holds the joint, up to its limit: it is the
torque within its bounds that brings the joint's velocity nearest to zero at the end of the step, q̇ + h q̈ = 0. That
is solved for all joints together with the contact force, by projected Gauss-Seidel on what Eq. 24 makes of a torque in
each joint (Moreau's time stepping). Friction then never adds energy, and no joint chatters about rest.

How tip and joints share what holds an arm at rest rigid bodies do not determine; least friction is given. While all
joints rest within their friction, a force δF more at the tip and a torque −Aᵀ δF more in the joints hold the arm as
before: the contact force is not determined by rigid bodies. Of all F and joint torques d that hold it, with d within
its limits and a tip that sticks within its cone, the ones are taken whose friction has the least norm,

    |F_t|² + |d|²        N and N m (N) alike, as for reactions of loops that are not unique

and f is what then balances: the f of an arm without friction, if that is at rest too. Where the cone leaves this out,
F_t weighs more, as much as it takes. So f depends on the state alone, not on the rounding of a velocity.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at, integers_at, row_of
from closedloop.jit.kernel import kernel
from closedloop.loop.step.closed_loops import BIND_ANSWER
from closedloop.loop.step.contacts import ANSWER
from closedloop.loop.step.memory import (
    RIGID_STICK,
    SMOOTH,
    SPRING_STICK,
    Constants,
    State,
    Work,
    ask_contacts,
    ask_loops,
)
from closedloop.loop.step.tendons import add_along, joint_limits, part_of, rate_along
from closedloop.mechanics.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    accelerate,
    pressed_force,
    stuck_force,
    stuck_tangentially,
)
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.friction.answers import ADVANCE_STATES, LIMIT, SLIDE
from closedloop.mechanics.friction.answers import STICK as END_OF_SLIP
from closedloop.mechanics.friction.law import AT_REST
from closedloop.mechanics.limits import EXACT, ITERATIONS, SWEEPS
from robot_models.tendon import DAMPING


@kernel
def _delayed(w: Work, constants: Constants, state: State, rows: Array, j: int) -> float:
    """Return the speed of joint j by which its friction is behind, on a line between recorded rows."""
    n, delay = w.q.shape[0], constants.joint_lag[j]
    speed: float = abs(w.v[j])
    last = state.row - 1
    if delay <= 0.0 or last < 0:
        return speed
    x = max((w.time - delay) / constants.h, 0.0)
    i = int(x)
    if i >= last:
        since = w.time - last * constants.h
        s = (w.time - delay - last * constants.h) / since if since > 0.0 else 1.0
        return float(max((1.0 - s) * abs(rows[last, n + j]) + s * speed, 0.0))
    return float((1.0 - (x - i)) * abs(rows[i, n + j]) + (x - i) * abs(rows[i + 1, n + j]))


@kernel
def _ask_slide(w: Work, constants: Constants, state: State, rows: Array) -> None:
    """Ask what friction is on each joint at its velocity, where no motion is to start."""
    for j in range(w.q.shape[0]):
        w.joint_friction.slip[j], w.joint_friction.direction[j] = w.v[j], 0.0
        w.joint_friction.lagged[j] = _delayed(w, constants, state, rows, j)
    call_at(state.joint_friction.entry, state.address, SLIDE)


@kernel
def add_joint_friction(w: Work, constants: Constants, state: State, rows: Array) -> None:
    """Write the torque of friction on each joint, joint_friction (n,), N m, as far as the state determines it.

    The dampers of tendons are part of it.
    """
    n, sticking = w.q.shape[0], state.joint_friction.sticking
    if sticking != SMOOTH:
        _ask_slide(w, constants, state, rows)
    for j in range(n):
        w.joint_friction.torque[j] = 0.0
        if sticking == RIGID_STICK:
            w.joint_friction.torque[j] = -w.joint_friction.viscous[j]
        elif sticking != SMOOTH:
            w.joint_friction.torque[j] = -w.joint_friction.dry[j] - w.joint_friction.viscous[j]
    for t in range(state.tendons):
        rate, b = rate_along(constants, n + t, w.v), row_of(constants.tendons, t)
        force = -rate * (b[DAMPING] + abs(rate) * b[DAMPING + 1] + rate * rate * b[DAMPING + 2])
        add_along(constants, n + t, force, w.joint_friction.torque)


@kernel
def hold_joints(w: Work, constants: Constants, state: State) -> bool:
    """Add the dry friction of a law that sticks rigidly to the torque of friction on each joint, and that of tendons.

    Reads q̈ and F of Eq. 24 without it. Returns whether Eq. 24 is to be solved again: not without dry friction.
    """
    n, h, some = w.q.shape[0], constants.h, False
    F, y, a, target = w.scratch.force, w.scratch.column, w.scratch.acceleration, w.scratch.target
    limit, dry, none = w.joint_friction.limit, w.joint_friction.held, w.scratch.none
    none[0], none[1] = 0.0, 0.0
    if state.coupled != 0:
        links, _ = contacts_at(state.contacts.at)
        if links.undecided != 0:  # the modes and the friction of joints are sought together
            return False
    joint_limits(w, constants, state)
    for r in range(n + state.tendons):
        dry[r] = w.joint_friction.mobility[r] = 0.0
        if not limit[r] > 0.0:
            continue
        some = True
        # Row r of the answer: q̈ to a torque of 1 N m in joint r, or a force in tendon r − n, the contact as it is.
        for i in range(n):
            y[i] = part_of(constants, r, i)
        first = r if r < n else 0
        for i in range(first, n):
            s = y[i]
            for m in range(first, i):
                s -= w.L[i, m] * y[m]
            y[i] = s * w.L[i, i]
        alone = 0.0
        for i in range(first, n):
            alone += y[i] * y[i]
        ask_loops(state, BIND_ANSWER)
        for i in range(3):
            F[i] = 0.0
            a[i] = 0.0
            for m in range(n):
                a[i] += w.tip.X[i, m] * y[m]
        if state.coupled != 0:
            ask_contacts(state, ANSWER)
        elif state.compliance.entry != 0:  # f follows the depth, which a torque does not change at once
            if state.mode == STUCK and state.friction.sticking == RIGID_STICK:
                for i in range(3):
                    target[i] = 0.0
                stuck_tangentially(w.tip.S, a, target, F)
        elif state.mode == PRESSED or (state.mode == STUCK and state.friction.sticking == SPRING_STICK):
            pressed_force(w.tip.S, a, 0.0, w.friction.c, none, F)
        elif state.mode != FREE:
            for i in range(3):
                target[i] = 0.0
            stuck_force(w.tip.S, a, target, F, w.scratch.unused)
        answer = row_of(w.joint_friction.gain, r)
        accelerate(w.L, w.tip.X, y, F, answer, integers_at(state.addresses.group_ends, state.n))
        own = rate_along(constants, r, answer)
        if own > EXACT * alone:
            w.joint_friction.mobility[r] = own
    for _ in range(SWEEPS if some else 0):
        change = 0.0
        for r in range(n + state.tendons):
            own = w.joint_friction.mobility[r]
            if not own > 0.0:
                continue
            wanted = dry[r] - (rate_along(constants, r, w.v) / h + rate_along(constants, r, w.qdd)) / own
            new = min(max(wanted, -limit[r]), limit[r])
            moved = new - dry[r]
            dry[r] = new
            change = max(change, abs(moved) / limit[r])
            for i in range(n):
                w.qdd[i] += w.joint_friction.gain[r, i] * moved
        if change <= EXACT:
            break
    for r in range(n + state.tendons):
        add_along(constants, r, dry[r], w.joint_friction.torque)
    return some


@kernel
def advance_joint_friction(w: Work, state: State, h: float) -> None:
    """Advance the joints' friction states by h seconds at the velocity of the step's beginning."""
    if state.joint_friction.states == 0:
        return
    n = w.q.shape[0]
    for j in range(n):
        w.joint_friction.slip[j] = w.start.state[n + j]
    w.friction.span = h
    call_at(state.joint_friction.entry, state.address, ADVANCE_STATES)


@kernel
def stick_or_slip_joints(w: Work, constants: Constants, state: State, rows: Array) -> None:
    """At a row, let joints stick whose motion has turned, and slip whose spring is stretched out."""
    n, i = w.q.shape[0], state.row
    if state.joint_friction.sticking != SPRING_STICK or i == 0:
        return
    _ask_slide(w, constants, state, rows)
    call_at(state.joint_friction.entry, state.address, LIMIT)
    for j in range(n):
        before = rows[i - 1, n + j]
        if w.joint_friction.stuck[j] != 0.0:
            if abs(w.joint_friction.dry[j]) >= w.joint_friction.limit[j]:
                w.joint_friction.stuck[j] = 0.0
        elif w.v[j] * before <= 0.0:
            w.joint_friction.direction[j] = 1.0 if before > 0.0 else -1.0
    call_at(state.joint_friction.entry, state.address, END_OF_SLIP)
    for j in range(n):
        if w.joint_friction.direction[j] != 0.0:
            w.joint_friction.stuck[j] = 1.0


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
    return bool(size <= (1.0 - EXACT) * w.friction.stick_limit * (w.tip.F[0] + change[0]))


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
