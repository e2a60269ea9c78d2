"""One evaluation of the equation of motion: law, friction, contact and Eq. 24 at one state, and the row it leaves.

The caller provides H, C, Jᵣ, r and J̇ᵣq̇ of the state, from Pinocchio or from anything else; nothing here asks further.
`closedloop.machine` decides which states are evaluated, and when.

Everything exists in two forms, which numba makes of one source: `more` is None for the paper's law on a smooth surface,
and a number for all that may come on top: other laws, friction of the tip and of the joints, a force sensor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import entry_kernel, kernel, kernel_inlined
from closedloop.condition import LONG, condition_of_long, conditions, leave
from closedloop.contact import (
    FREE,
    IMMOBILE,
    PRESSED,
    STUCK,
    accelerate,
    baumgarte_acceleration,
    factorise,
    into_contact_frame,
    pressed_force,
    residuals,
    stuck_force,
    unloaded,
)
from closedloop.control.laws import law_rates, law_torque, start_states
from closedloop.control.moment import Moment
from closedloop.control.paper import paper_law
from closedloop.control.sensor import continuous_reading, sense, sensor_rates
from closedloop.friction.laws import holding, memory_delay, rates, sliding
from closedloop.joint_friction import add_joint_friction, hold_joints, joint_friction_rates
from closedloop.octet import every, select
from closedloop.solve import DIVERGED, OK, PAINLEVE, SINGULAR
from closedloop.workspace import (
    DELAYED,
    FRAME,
    FRICTION,
    FRICTION_AT,
    FRICTION_STATES,
    FRICTION_WIDTH,
    GAP,
    H_STEP,
    JOINT_FRICTION,
    JOINTS,
    LAW,
    LAW_STATES,
    LAW_WIDTH,
    MEASURED,
    MODE,
    NODE,
    OFFSET_D,
    PD_AT,
    PENDING,
    PER_STEP,
    RATE,
    RIGID,
    RIGID_STICK,
    ROW,
    S_P,
    S_V,
    SAMPLED,
    SEMI_IMPLICIT,
    SENSOR_AT,
    SENSOR_RING,
    SENSOR_SAMPLED,
    SENSOR_STATES,
    SMOOTH,
    SPRING_STICK,
    STARTED,
    STEPS,
    STICKING,
    TIME,
    UNILATERAL,
    Whole,
    Work,
    law_at,
)

Array = NDArray[np.float64]

# A joint at 10⁴ rad/s (m/s) is no robot any more; the run stops there, long before the numbers overflow.
SPEED_LIMIT = 1e4

# The law is evaluated outside (a user's Python function), or here: a number of `closedloop.control.places.LAWS`.
LAW_GIVEN = -1


@kernel_inlined
def reference_row(t: float, spacing: float, table: Array, n: int, row: Array) -> None:
    """Write what is desired at time t: between the table's instants, a cubic in position and lines for the rest.

    Parameters
    ----------
    t, spacing : float
        Time, and time between two rows of the table, s.
    table : (P, >= 2 n + 10) array
        q_des, q̇_des, and in the contact frame p_des, u_des and u̇_des, then f_des.
    row : (2 n + 10,) array
        Written.
    """
    x = t / spacing
    at = round(x)
    width = row.shape[0]
    if abs(x - at) < 1e-6 or at >= table.shape[0]:
        at = min(at, table.shape[0] - 1)
        for j in range(width):
            row[j] = table[at, j]
        return
    at = min(int(x), table.shape[0] - 2)
    s = x - at
    for j in range(width):
        row[j] = (1.0 - s) * table[at, j] + s * table[at + 1, j]
    for block in range(2):
        begin = 0 if block == 0 else 2 * n
        size = n if block == 0 else 3
        for j in range(begin, begin + size):
            rise = table[at + 1, j] - table[at, j]
            v0, v1 = spacing * table[at, j + size], spacing * table[at + 1, j + size]
            row[j] = table[at, j] + s * (v0 + s * (3.0 * rise - 2.0 * v0 - v1 + s * (v0 + v1 - 2.0 * rise)))


@kernel_inlined
def locate_tip(w: Work, k: Array) -> None:
    """Write the tip's motion in the contact frame, and the gap and its rate."""
    into_contact_frame(k[FRAME : FRAME + 9], w.J, w.r, w.drift, w.v, w.A, w.p, w.u, w.drift_c)
    w.now[GAP] = w.p[0] - k[OFFSET_D]
    w.now[RATE] = w.u[0]


@kernel_inlined
def evaluate(H: Array, C: Array, w: Work, k: Array, state: Whole, table: Array, rows: Array, more: int | None) -> int:
    """Evaluate law, friction, contact and Eq. 24 at the state in `w`.

    Parameters
    ----------
    H, C : (n, n), (n,) arrays
        Terms of the state, H's upper triangle.
    w : Work
        In: now[TIME], q, q̇, z, Jᵣ, r, J̇ᵣq̇ (and the torque, if the law is given or held). Written: everything else.
    k : array
        Constants, see `closedloop.workspace`.
    state : array of int
        See `closedloop.workspace`.
    table : (P, 2 n + 11) array
        See `reference_row`; the last column is the noise of the force sensor.
    rows : (N, width) array
        The rows recorded so far: what the memory of friction reads.
    more : int or None
        None: the paper's law, given or held, on a smooth surface.

    Returns
    -------
    int
        OK, SINGULAR, NOT_POSITIVE_DEFINITE, PAINLEVE or DIVERGED.
    """
    n = w.q.shape[0]
    locate_tip(w, k)
    status = factorise(H, w.A, w.L, w.X, w.S)
    if status != OK:
        return status
    law = state[LAW]
    if more is None:
        if law != LAW_GIVEN and state[SAMPLED] != 0:
            reference_row(w.now[TIME], k[NODE], table, n, w.reference)
            w.scratch[0], w.scratch[1] = w.reference[2 * n + 9], k[PD_AT]
            gains, path = k[JOINTS + n : JOINTS + 3 * n].reshape(2, n), w.reference[: 2 * n].reshape(2, n)
            paper_law(w.now[TIME], w.scratch, gains, path, w.q, w.v, C, w.A, w.torque)
        status = contact_force(C, w, k, state)
        if status != OK:
            return status
    else:
        reference_row(w.now[TIME], k[NODE], table, n, w.reference)
        at, count = law_at(n), state[LAW_STATES]
        par, gains = k[at : at + LAW_WIDTH + 2 * n], k[JOINTS + n : JOINTS + 3 * n].reshape(2, n)
        ref = w.reference
        x = Moment(
            w.now[TIME], w.q, w.v, C, H, w.L, w.A, w.X, w.S, w.drift_c, w.p, w.u, ref[0:n], ref[n : 2 * n],
            ref[2 * n : 2 * n + 3], ref[2 * n + 3 : 2 * n + 6], ref[2 * n + 6 : 2 * n + 9], ref[2 * n + 9],
            w.now[MEASURED], 0.0 if state[MODE] == FREE else 1.0,
        )  # fmt: skip
        if law != LAW_GIVEN:
            if state[STARTED] == 0:
                start_states(law, x, par, w.z[0:count])
            if state[SAMPLED] != 0:
                law_torque(law, x, par, gains, w.z[0:count], w.scratch, w.torque)
        state[STARTED] = 1
        surface_friction(w, k, state, rows)
        add_joint_friction(w, k, state, rows)
        status = contact_force(C, w, k, state)
        if status != OK:
            return status
        if state[JOINT_FRICTION] > 0 and hold_joints(w, k, state):
            status = contact_force(C, w, k, state)
            if status != OK:
                return status
        reading = w.now[MEASURED]
        sensor, s = state[SENSOR_STATES], k[SENSOR_AT : SENSOR_AT + 4]
        if state[SENSOR_SAMPLED] == 0:
            reading = continuous_reading(w.F[0], s, w.z[count : count + sensor])
        if law != LAW_GIVEN:
            law_rates(law, x, par, w.z[0:count], reading, w.torque, w.scratch, w.dz[0:count])
        sensor_rates(w.F[0], s, w.z[count : count + sensor], w.dz[count : count + sensor])
        at = count + sensor
        for i in range(at, w.z.shape[0]):
            w.dz[i] = 0.0  # with the semi-implicit scheme friction's states advance by themselves
        if state[SEMI_IMPLICIT] == 0:
            here = at + state[FRICTION_STATES]
            if state[MODE] != FREE:
                rates(
                    state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH], w.u[1:3], state[MODE] == STUCK,
                    w.z[at:here], w.dz[at:here],
                )  # fmt: skip
            joint_friction_rates(w, k, state)
    return OK if bounded(w) else DIVERGED


@kernel_inlined
def bounded(w: Work) -> bool:
    """Whether F, q̈ and q̇ are numbers, and q̇ within `SPEED_LIMIT`."""
    total = abs(w.F[0])
    for j in range(w.q.shape[0]):
        total += abs(w.qdd[j])
        if not every(abs(w.v[j]) <= SPEED_LIMIT):
            return False
    return every(total < math.inf)


@kernel_inlined
def contact_force(C: Array, w: Work, k: Array, state: Whole) -> int:
    """Solve Eq. 24 in the present mode for the contact force F and the acceleration q̈; return a status."""
    for j in range(w.q.shape[0]):
        w.column[j] = w.torque[j] + w.loss[j]
    unloaded(w.L, w.X, w.drift_c, w.column, C, w.y, w.a)
    w.now[RIGID] = 0.0
    for i in range(3):
        w.F[i] = 0.0
        w.share[i] = 0.0
        w.b[i] = 0.0
    if state[MODE] == PRESSED or (state[MODE] == STUCK and state[STICKING] == SPRING_STICK):
        b = baumgarte_acceleration(k[S_V], k[S_P], w.now[RATE], w.now[GAP])
        status, share = pressed_force(w.S, w.a, b, w.c, w.w, w.F)
        rubbed = w.c[0] != 0.0 or w.c[1] != 0.0
        if state[UNILATERAL] == 0 and rubbed and (status == PAINLEVE or (status == OK and w.F[0] < 0.0)):
            # A closure that pulls presses as hard from the other side. If it does, that it cannot push is no paradox.
            w.c[0], w.c[1] = -w.c[0], -w.c[1]
            wedged = status == PAINLEVE
            status, share = pressed_force(w.S, w.a, b, w.c, w.w, w.F)
            if status == OK and wedged and not w.F[0] < 0.0:
                status = PAINLEVE
        if status != OK:
            return status
        sticking = state[STICKING]
        if state[MODE] == PRESSED and state[STEPS] > 0 and sticking in (RIGID_STICK, SPRING_STICK):
            for _ in range(2):  # f and the direction of slip depend on each other
                if not turn_with_slip(w, k[H_STEP]):
                    break
                status, share = pressed_force(w.S, w.a, b, w.c, w.w, w.F)
                if status != OK:
                    return status
        rigid = w.F[0] - share
        if state[UNILATERAL] != 0 and w.F[0] < 0.0 <= rigid:
            # The surface may push less to let the stabiliser have its way, down to nothing, but it cannot pull.
            share = -rigid
            b = share * (w.S[0, 0] - w.S[0, 1] * w.c[0] - w.S[0, 2] * w.c[1])
            w.F[0], w.F[1], w.F[2] = 0.0, -w.w[0], -w.w[1]
        w.now[RIGID] = rigid
        w.b[0], w.share[0] = b, share
    elif state[MODE] == STUCK:
        w.b[0] = baumgarte_acceleration(k[S_V], k[S_P], w.now[RATE], w.now[GAP])
        for i in range(1, 3):
            w.b[i] = baumgarte_acceleration(k[S_V], k[S_P], w.u[i], w.p[i] - w.anchor[i - 1])
        if stuck_force(w.S, w.a, w.b, w.F, w.share) != OK:
            return SINGULAR
        w.now[RIGID] = w.F[0] - w.share[0]
    accelerate(w.L, w.X, w.y, w.F, w.qdd)
    return OK


@kernel
def turn_with_slip(w: Work, h: float) -> bool:
    """Turn the friction of a slow tip to where its slip points at the end of the step; return whether it was slow.

    Friction turns a slip u with the rate μ|f| s/|u|, s the mobility along the surface. Where that is above 1/h, a step
    that takes friction against the present u throws the tip from side to side, and at last no step is short enough.
    There the direction d is that of the slip u⁺ at the end of the step,

        u⁺ + h μ|f| S_t d = u + h (a_t + S_tn f − S_t w),    d = u⁺/|u⁺|

    as in time stepping (J. J. Moreau, 1988): one equation for |u⁺|, by bisection. If friction is enough to stop the tip
    within the step, d is such that the tip goes straight to rest.

    Parameters
    ----------
    w : Work
        In: u, direction, S, a, w, and c = ±μ u/|u| with the F of it (minus where the closure pulls). Written: c.
    h : float
        The step, s.
    """
    level, speed, f = math.hypot(w.c[0], w.c[1]), math.hypot(w.u[1], w.u[2]), w.F[0]
    reach = h * level * abs(f)
    if not reach * (w.S[1, 1] + w.S[2, 2]) > speed:
        return False
    if not w.u[1] * w.direction[0] + w.u[2] * w.direction[1] > 0.0:
        return False  # past the end of slip
    det = w.S[1, 1] * w.S[2, 2] - w.S[1, 2] * w.S[1, 2]
    if not det > IMMOBILE * (w.S[1, 1] + w.S[2, 2]) ** 2:
        return False  # a tip that moves along a line does not turn
    a1 = w.a[1] + w.S[1, 0] * f - w.S[1, 1] * w.w[0] - w.S[1, 2] * w.w[1]
    a2 = w.a[2] + w.S[2, 0] * f - w.S[1, 2] * w.w[0] - w.S[2, 2] * w.w[1]
    p1, p2 = (w.S[2, 2] * w.u[1] - w.S[1, 2] * w.u[2]) / det, (w.S[1, 1] * w.u[2] - w.S[1, 2] * w.u[1]) / det
    q1, q2 = (w.S[2, 2] * a1 - w.S[1, 2] * a2) / det, (w.S[1, 1] * a2 - w.S[1, 2] * a1) / det
    if math.hypot(p1 / h + q1, p2 / h + q2) < level * abs(f):
        along, square = p1 * q1 + p2 * q2, p1 * p1 + p2 * p2
        rate = (math.sqrt(along * along + square * ((level * f) ** 2 - q1 * q1 - q2 * q2)) - along) / square
        d1, d2 = rate * p1 + q1, rate * p2 + q2
    else:
        g11, g12, g22 = reach * w.S[1, 1], reach * w.S[1, 2], reach * w.S[2, 2]
        x1, x2 = w.u[1] + h * a1, w.u[2] + h * a2
        low, high, d1, d2 = 0.0, math.hypot(x1, x2), x1, x2
        for _ in range(60):
            s = 0.5 * (low + high)
            det = (s + g11) * (s + g22) - g12 * g12
            d1, d2 = ((s + g22) * x1 - g12 * x2) / det, ((s + g11) * x2 - g12 * x1) / det
            low, high = (s, high) if math.hypot(d1, d2) > 1.0 else (low, s)
            if high - low <= 1e-14 * high:
                break
    size = math.hypot(d1, d2)
    if not size > 0.0:
        return False
    along = math.copysign(level / size, f)
    w.c[0], w.c[1] = along * d1, along * d2
    return True


@kernel
def surface_friction(w: Work, k: Array, state: Whole, rows: Array) -> None:
    """Write c and w of the tip's friction F_t = −c f − w in the present mode; zero where there is none."""
    w.c[0], w.c[1], w.w[0], w.w[1] = 0.0, 0.0, 0.0, 0.0
    sticking = state[STICKING]
    if sticking == SMOOTH or state[MODE] == FREE or (state[MODE] == STUCK and sticking == RIGID_STICK):
        return
    kind, par = state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH]
    at = state[LAW_STATES] + state[SENSOR_STATES]
    z = w.z[at : at + state[FRICTION_STATES]]
    if state[MODE] == STUCK:
        holding(kind, par, z, w.c, w.w)
        return
    speed = math.hypot(w.u[1], w.u[2])
    w.now[DELAYED] = delayed_speed(w, k, state, rows, memory_delay(kind, par), speed)
    s = w.scratch[0:2]
    s[0], s[1] = w.u[1], w.u[2]
    along = s[0] * w.direction[0] + s[1] * w.direction[1]
    if sticking != RIGID_STICK and sticking != SPRING_STICK:
        along = 1.0
    if along < 0.0:
        # Past the instant at which slip stops the law goes on as before, so that the instant can be found.
        s[0], s[1] = speed * w.direction[0], speed * w.direction[1]
    sliding(kind, par, s, w.now[DELAYED], z, w.direction, w.c, w.w)


@kernel
def delayed_speed(w: Work, k: Array, state: Whole, rows: Array, delay: float, speed: float) -> float:
    """Return the speed of slip `delay` seconds ago, m/s, on a line between rows; `speed` is the present one."""
    if delay <= 0.0:
        return speed
    n = w.q.shape[0]
    x = (w.now[TIME] - delay) / k[H_STEP]
    last = state[ROW] - 1
    if x <= 0.0 or last < 0:
        return slip_of(rows[0], n, k) if last >= 0 else speed
    i = int(x)
    if i >= last:
        since = w.now[TIME] - last * k[H_STEP]
        s = (w.now[TIME] - delay - last * k[H_STEP]) / since if since > 0.0 else 1.0
        return float((1.0 - s) * slip_of(rows[last], n, k) + s * speed)
    return float((1.0 - (x - i)) * slip_of(rows[i], n, k) + (x - i) * slip_of(rows[i + 1], n, k))


@kernel
def slip_of(row: Array, n: int, k: Array) -> float:
    """Return the tip's tangential speed in a recorded row, m/s."""
    total = 0.0
    for t in range(1, 3):
        u = 0.0
        for i in range(3):
            u += k[FRAME + 3 * t + i] * row[4 * n + 3 + i]
        total += u * u
    return math.sqrt(total)


class Row(NamedTuple):
    """Where each column begins in a recorded row; `width` is the row's length."""

    q: int
    v: int
    acceleration: int
    torque: int
    position: int
    velocity: int
    friction_force: int
    joint_friction: int
    scalars: int
    width: int

    @classmethod
    def of(cls, n: int) -> Row:
        """Lay out a row for n joints."""
        ends = np.cumsum((0, n, n, n, n, 3, 3, 3, n, len(SCALARS))).tolist()
        return cls(*ends)


SCALARS = (
    "contact_force", "stabiliser_force", "closure_error", "closure_rate", "mode", "residual_motion",
    "residual_closure", "kkt_condition", "normal_mobility", "kinetic_energy", "measured_force",
)  # fmt: skip


KKT_CONDITION = SCALARS.index("kkt_condition")


@kernel_inlined
def kinetic_energy(H: Array, v: Array) -> float:
    """Return ½ q̇ᵀH q̇, J, from H's upper triangle."""
    total = 0.0
    for i in range(v.shape[0]):
        total += 0.5 * H[i, i] * v[i] * v[i]
        for j in range(i + 1, v.shape[0]):
            total += H[i, j] * v[i] * v[j]
    return total


@kernel
def record_conditions(pending: Array, rows: Array, state: Whole, done: int, n: int) -> None:
    """Write the condition numbers of the last rows up to `done`: those that have their lanes in `pending`.

    Of Eq. 24 with the normal row alone; of H while the tip is free.
    """
    count = state[PENDING]
    state[PENDING] = 0
    if count > 0:
        conditions(pending, n, count)
    at = 5 * n + 9 + KKT_CONDITION
    for r in range(count):
        rows[done - count + r, at] = pending[pending.shape[0] - 1, r]


@entry_kernel
def complete_record(pending: Array, rows: Array, state: Whole, done: int, n: int) -> None:
    """Write what the last of `done` rows still lack, at the end of a run; see `record`."""
    record_conditions(pending, rows, state, done, n)


@kernel_inlined
def record(
    H: Array, C: Array, w: Work, k: Array, state: Whole, table: Array, rows: Array, place: int, more: int | None
) -> None:
    """Write a row in the order of `Row`: the state, and what acted in it.

    The condition number follows once the rows of `Work.pending` are full, or with `complete_record`.
    """
    n = w.q.shape[0]
    row, lane = rows[place], state[PENDING]
    at = 4 * n + 9
    for j in range(n):
        row[j] = w.q[j]
        row[n + j] = w.v[j]
        row[2 * n + j] = w.qdd[j]
        row[3 * n + j] = w.torque[j]
        row[at + j] = w.loss[j]
        w.column[j] = w.torque[j] + w.loss[j]
    at = 4 * n
    for i in range(3):
        row[at + i] = w.r[i]
        speed = 0.0
        for j in range(n):
            speed += w.J[i, j] * w.v[j]
        row[at + 3 + i] = speed
        row[at + 6 + i] = k[FRAME + 3 + i] * w.F[1] + k[FRAME + 6 + i] * w.F[2]
    at += 9 + n
    mode = state[MODE]
    closures = 0 if mode == FREE else (3 if mode == STUCK and state[STICKING] == RIGID_STICK else 1)
    motion, closed = residuals(H, w.column, C, w.A, w.S, w.drift_c, w.b, w.a, w.qdd, w.F, 0, closures)
    trace = w.S[0, 0] + w.S[1, 1] + w.S[2, 2]
    row[at] = w.F[0]
    row[at + 1] = w.share[0]
    row[at + 2] = w.now[GAP]
    row[at + 3] = w.now[RATE]
    row[at + 4] = mode
    row[at + 5] = motion
    row[at + 6] = closed
    if n > LONG:
        row[at + 7] = condition_of_long(H, w.A[0], w.L, w.X[0], w.S[0, 0], mode != FREE, w.scratch)
    else:
        leave(H, w.A[0], w.L, w.X[0], w.S[0, 0], mode != FREE, w.pending, lane)
        state[PENDING] = lane + 1
        if lane + 1 >= w.pending.shape[1]:
            record_conditions(w.pending, rows, state, place + 1, n)
    row[at + 8] = select(trace > 0.0, w.S[0, 0] / trace, 0.0)
    row[at + 9] = kinetic_energy(H, w.v)
    if more is None:
        w.now[MEASURED] = w.F[0]
    else:
        count, sensor = state[LAW_STATES], state[SENSOR_STATES]
        w.now[MEASURED] = sense(
            w.F[0], place, k[SENSOR_AT : SENSOR_AT + 4], w.z[count : count + sensor],
            table[place * state[PER_STEP], 2 * n + 10], w.ring[0 : state[SENSOR_RING]],
        )  # fmt: skip
    row[at + 10] = w.now[MEASURED]
