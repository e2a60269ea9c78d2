"""One evaluation of the equation of motion: law, friction, contact and Eq. 24 at one state.

The caller provides H, C, Jᵣ, r and J̇ᵣq̇ of the state, from Pinocchio or another source. `closedloop.events` decides
which states are evaluated, and when.

The paper's law on a smooth surface is part of the loop: `State.law` is 0. For everything else (other laws, friction of
the tip and of the joints, a force sensor) it is the address of the law's entry.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    accelerate,
    baumgarte_acceleration,
    free_acceleration,
    normal_rounding,
    pressed_force,
    stuck_force,
)
from closedloop.closure.solve import DIVERGED, LAW_FAILED, NOT_POSITIVE_DEFINITE, OK, PAINLEVE, PUSHED, SINGULAR
from closedloop.control.drives import cut_torque
from closedloop.control.laws.paper import PaperLaw, paper_law
from closedloop.control.seen import Seen
from closedloop.control.sensor import SensorParameters, continuous_reading, sensor_rates
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import every
from closedloop.parameters import parameter_block
from closedloop.reference.joint_path import cubic
from closedloop.step.closed_loops import BIND_LOAD, DRIVE, factorise_tip
from closedloop.step.contacts import DRIVE as DRIVE_CONTACTS
from closedloop.step.contacts import FORCE
from closedloop.step.energy_supplied import driving_torque
from closedloop.step.entries import RATES, START, TORQUE
from closedloop.step.joint_friction import add_joint_friction, hold_joints
from closedloop.step.locate import in_contact_frame, locate_tip, off_anchor
from closedloop.step.memory import RIGID_STICK, SPRING_STICK, Constants, Reference, State, Work
from closedloop.step.seen import keep_terms, see
from closedloop.step.singular import force_in_singular_pose, pushed_on_the_way
from closedloop.step.soft_contact import soft_contact_force
from closedloop.step.tip_friction import surface_friction, turn_with_slip
from closedloop.step.transmission import motor_rates, transmit

Array = NDArray[np.float64]

# Joint speed, rad/s (m/s), at which a run stops as diverged, long before the numbers overflow.
SPEED_LIMIT = 1e4

# Bound of forces and accelerations; the summary of a run takes squares, which are finite below it.
LARGEST = 1e100

# Parameters of the paper's law.
PaperParameters = parameter_block(PaperLaw)


@kernel_inlined
def reference_row(t: float, spacing: float, table: Array, n: int, row: Array) -> None:
    """Write the reference at time t: between the table's rows positions are cubics and the rest is linear.

    Parameters
    ----------
    t, spacing : float
        Time, and time between two rows of the table, s.
    table : (P, >= 2 n + 10) array
        q_des, q̇_des, then r_des, ṙ_des and r̈_des of the tip in base axes, then f_des.
    row : (2 n + 10,) array
        Written.
    """
    x = t / spacing
    at = nearest_row(t, spacing, table.shape[0])
    width = row.shape[0]
    if abs(x - at) < 1e-6 or round(x) > at:
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
            row[j], _, _ = cubic(
                table[at, j], table[at + 1, j], table[at, j + size], table[at + 1, j + size], spacing, s
            )


@kernel_inlined
def nearest_row(t: float, spacing: float, count: int) -> int:
    """Return which of the table's rows is nearest to time t, s."""
    return min(round(t / spacing), count - 1)


@kernel
def desired_acceleration(t: float, spacing: float, table: Array, qdd: Array) -> None:
    """Write q̈_des (n,) at the table's row nearest to t, s, of the rates q̇_des on either side of it.

    It is the smaller of the two slopes, and zero where they differ in sign: so a velocity that jumps, as at the start
    of a line, asks for no acceleration, and a smooth one for its own, to first order in the spacing.
    """
    n, at = qdd.shape[0], nearest_row(t, spacing, table.shape[0])
    for j in range(n):
        qdd[j] = 0.0
        if 0 < at < table.shape[0] - 1:
            before = (table[at, n + j] - table[at - 1, n + j]) / spacing
            after = (table[at + 1, n + j] - table[at, n + j]) / spacing
            if before * after > 0.0:
                qdd[j] = before if abs(before) < abs(after) else after


@kernel_inlined
def evaluate(H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, rows: Array) -> int:
    """Evaluate law, friction, contact and Eq. 24 at the state in `w`.

    Parameters
    ----------
    H, C : (n, n), (n,) arrays
        Terms of the state, H's upper triangle.
    w : Work
        In: w.time, q, q̇, z, Jᵣ, r, J̇ᵣq̇ (and the torque, if it is held). Written: everything else.
    constants, state
        See `closedloop.step.memory`.
    table : (P, 2 n + 11) array
        See `reference_row`; the last column is the noise of the force sensor.
    rows : (N, width) array
        The rows recorded so far: what the memory of friction reads.

    Returns
    -------
    int
        OK, SINGULAR, NOT_POSITIVE_DEFINITE, PAINLEVE, DIVERGED, LAW_FAILED or NO_NORMAL.
    """
    n = w.q.shape[0]
    status = locate_tip(w, constants, state)
    if status != OK:
        return status
    status = factorise_tip(H, w, constants, state)
    if status != OK:
        return status
    if state.law != 0 or state.sampled != 0:
        reference_row(w.time, constants.node, table, n, w.reference)
    if state.law == 0:
        if state.sampled != 0:
            paper_torque(C, w, constants, w.time)
    else:
        if state.feed_forward != 0:
            desired_acceleration(w.time, constants.node, table, w.qdd_des)
        if state.seen == 0:
            in_contact_frame(w.frame, w.carried, w.turning, Reference(w.reference, n))
            keep_terms(H, C, w)
        elif state.encoder == 0:
            if see(H, C, w, constants, state) != OK:
                return NOT_POSITIVE_DEFINITE
        else:  # the law has been asked at the state that the encoders read, see `evaluate_law`
            seen = Seen(w.seen, n)
            in_contact_frame(seen.frame, seen.carried, seen.turning, Reference(w.reference, n))
        if state.encoder == 0 and ask_law(w, constants, state) != OK:
            return LAW_FAILED
        if state.elastic != 0:
            transmit(w, constants)
        surface_friction(w, constants, state, rows)
        add_joint_friction(w, constants, state, rows)
    status = contact_force(C, w, constants, state)
    if status != OK:
        return status
    if state.law != 0:
        if state.joint_sticking == RIGID_STICK:
            hold_joints(w, constants, state)
            status = contact_force(C, w, constants, state)
            if status != OK:
                return status
        sensor = w.z[state.law_states : state.law_states + state.sensor_states]
        w.reading = w.measured
        if state.sensor_sampled == 0:
            w.reading = continuous_reading(w.F[0], SensorParameters(constants.sensor, 0), sensor)
        call_law(state, RATES)
        at = state.law_states + state.sensor_states
        sensor_rates(w.F[0], SensorParameters(constants.sensor, 0), sensor, w.dz[state.law_states : at])
        for i in range(at, w.z.shape[0]):
            w.dz[i] = 0.0  # with the semi-implicit scheme friction's states advance by themselves
        if state.semi_implicit == 0:
            if state.mode != FREE and state.friction_states > 0:
                w.slip[0], w.slip[1] = w.u[1], w.u[2]
                call_at(state.friction, state.address, RATES)
            if state.joint_states > 0:
                call_at(state.joint_friction, state.address, RATES)
        if state.elastic != 0:
            motor_rates(w, constants)
        if state.raised != 0:
            return LAW_FAILED
    return OK if bounded(w) else DIVERGED


@kernel_inlined
def paper_torque(C: Array, w: Work, constants: Constants, t: float) -> None:
    """Write the torque of the paper's law at t, s, with what is desired in the reference."""
    n = w.q.shape[0]
    par, wanted = PaperParameters(constants.law, n), Reference(w.reference, n)
    paper_law(t, wanted.force, par, wanted.q, wanted.v, w.q, w.v, C, w.A, w.torque)


@kernel
def evaluate_law(H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array) -> int:
    """Ask the law at the state in `w`, which is what the encoders read, and return a status, as `evaluate` does."""
    status = locate_tip(w, constants, state)
    if status != OK:
        return status
    reference_row(w.time, constants.node, table, w.q.shape[0], w.reference)
    if state.feed_forward != 0:
        desired_acceleration(w.time, constants.node, table, w.qdd_des)
    if see(H, C, w, constants, state) != OK:
        return NOT_POSITIVE_DEFINITE
    return ask_law(w, constants, state)


@kernel
def ask_law(w: Work, constants: Constants, state: State) -> int:
    """Write the torque of the law and its compensation, if they are sampled here; return OK or LAW_FAILED."""
    if state.started == 0:
        call_law(state, START)
    if state.sampled != 0 and drive_torque(w, constants, state) != 0:
        return LAW_FAILED
    state.started = 1
    return OK


@kernel
def drive_torque(w: Work, constants: Constants, state: State) -> int:
    """Write the torque that the law asks for, as the drives can give it; return 0, or the law's error."""
    if state.drives != 0 and w.time != w.sampled_at:  # a sample may be taken anew, after an event in the step before it
        w.sampled_at = w.time
        for j in range(w.q.shape[0]):
            w.torque_before[j] = w.torque[j]
    failed = call_law(state, TORQUE)
    if state.loops != 0:
        call_at(state.loops, state.seen_loops_at if state.seen_loops_at != 0 else state.loops_at, DRIVE)
    elif state.contacts != 0:
        call_at(state.contacts, state.contacts_at, DRIVE_CONTACTS)
    if state.drives != 0 and failed == 0:
        cut_torque(
            w.torque, w.torque_before, constants.torque_change, constants.torque_limit, not w.time > 0.0,
            w.torque_limited,
        )  # fmt: skip
    return failed


@kernel
def call_law(state: State, what: int) -> int:
    """Call the law and its compensation, see `closedloop.step.entries`; return 0, or the law's error."""
    failed = call_at(state.law, state.address, what)
    if failed == 0 and state.compensation != 0:
        call_at(state.compensation, state.address, what)
    return failed


@kernel_inlined
def bounded(w: Work) -> bool:
    """Whether F, q̈ and q̇ are numbers, F and q̈ within `LARGEST`, and q̇ within `SPEED_LIMIT`."""
    total = abs(w.F[0])
    for j in range(w.q.shape[0]):
        total += abs(w.qdd[j])
        if not every(abs(w.v[j]) <= SPEED_LIMIT):
            return False
    return every(total < LARGEST)


@kernel_inlined
def contact_force(C: Array, w: Work, constants: Constants, state: State) -> int:
    """Solve Eq. 24 in the present mode for the contact force F and the acceleration q̈; return a status."""
    for j in range(w.q.shape[0]):
        w.column[j] = driving_torque(w, state, j) + w.joint_friction[j]
    free_acceleration(w.L, w.X, w.drift_c, w.column, C, w.y, w.a)
    if state.loops != 0:
        call_at(state.loops, state.loops_at, BIND_LOAD)
    if state.contacts != 0:
        return call_at(state.contacts, state.contacts_at, FORCE)
    w.rigid_force = 0.0
    for i in range(3):
        w.F[i] = 0.0
        w.stabiliser_force[i] = 0.0
        w.b[i] = 0.0
    if state.compliance != 0 and state.mode != FREE:
        soft_contact_force(w, constants, state)
        return OK
    if state.mode == PRESSED or (state.mode == STUCK and state.sticking == SPRING_STICK):
        b = baumgarte_acceleration(constants.s_v, constants.s_p, w.rate, w.gap)
        status, share = pressed_force(w.S, w.a, b, w.c, w.viscous, w.F)
        rubbed = w.c[0] != 0.0 or w.c[1] != 0.0
        if state.unilateral == 0 and rubbed and (status == PAINLEVE or (status == OK and w.F[0] < 0.0)):
            # A bilateral closure may pull: friction is then that of |f| on the other side, and there is no paradox if
            # that solution exists.
            w.c[0], w.c[1] = -w.c[0], -w.c[1]
            wedged = status == PAINLEVE
            status, share = pressed_force(w.S, w.a, b, w.c, w.viscous, w.F)
            if status == OK and wedged and not w.F[0] < 0.0:
                status = PAINLEVE
        if status == SINGULAR and state.mode == PRESSED:
            return force_in_singular_pose(C, w, constants, state)
        if status != OK:
            return status
        sticking = state.sticking
        if state.mode == PRESSED and state.steps > 0 and sticking in (RIGID_STICK, SPRING_STICK):
            for _ in range(2):  # f and the direction of slip depend on each other
                if not turn_with_slip(w, constants.h):
                    break
                status, share = pressed_force(w.S, w.a, b, w.c, w.viscous, w.F)
                if status != OK:
                    return status
        rigid = w.F[0] - share
        if state.approached > 0 and pushed_on_the_way(C, w, constants, rigid):
            return PUSHED
        w.rigid_force = kept_force(rigid, C, w, state)
        if state.unilateral != 0 and w.F[0] < 0.0 <= w.rigid_force:
            # The stabiliser may reduce f of a unilateral contact to zero, but not below.
            share = -rigid
            b = share * (w.S[0, 0] - w.S[0, 1] * w.c[0] - w.S[0, 2] * w.c[1])
            w.F[0], w.F[1], w.F[2] = 0.0, -w.viscous[0], -w.viscous[1]
        w.b[0], w.stabiliser_force[0] = b, share
    elif state.mode == STUCK:
        w.b[0] = baumgarte_acceleration(constants.s_v, constants.s_p, w.rate, w.gap)
        for i in range(1, 3):
            w.b[i] = baumgarte_acceleration(constants.s_v, constants.s_p, w.u[i], off_anchor(w, state, i))
        if stuck_force(w.S, w.a, w.b, w.F, w.stabiliser_force) != OK:
            return SINGULAR
        w.rigid_force = kept_force(w.F[0] - w.stabiliser_force[0], C, w, state)
    accelerate(w.L, w.X, w.y, w.F, w.qdd)
    return OK


@kernel_inlined
def kept_force(rigid: float, C: Array, w: Work, state: State) -> float:
    """Return the force of the rigid closure, N, that decides liftoff: the tip lifts off where it is negative.

    For a unilateral contact it is corrected by its rounding: with f_des = 0 the computed force is rounding, of either
    sign, and the tip stays in contact.
    """
    kept = rigid
    if state.unilateral != 0 and rigid < 0.0:
        kept += normal_rounding(w.L, w.X, w.drift_c, w.torque, w.joint_friction, C, w.column) / w.S[0, 0]
    return kept
