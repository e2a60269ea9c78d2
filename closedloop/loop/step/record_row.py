"""The rows of the record: their columns, and the kernel that writes one."""

import math
from typing import Annotated, Any

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.control.reference.desired import TableRow
from closedloop.control.sensor import SensorParameters, bias_at, sense, signal_of
from closedloop.jit.blocks import Block
from closedloop.jit.calls import integers_at, row_of
from closedloop.jit.dual8 import has_derivatives
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.simd8 import every, select
from closedloop.loop.step.closed_loops import REACTION, missing_torque
from closedloop.loop.step.contact_rows import asked
from closedloop.loop.step.energy_supplied import applied_torque
from closedloop.loop.step.locate import sensor_feels
from closedloop.loop.step.memory import RIGID_STICK, Constants, K, N, State, Work, ask_loops, loop_at
from closedloop.mechanics.closure.conditioning import (
    BATCH,
    LONG_ARM,
    add_to_batch,
    condition_number,
    condition_numbers_of_batch,
)
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.closure.solve import closure_residual, motion_residual
from closedloop.mechanics.contacts.friction import remember_speed
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.contacts.resistance import resistance_of
from closedloop.mechanics.contacts.soft import rests
from closedloop.mechanics.surface.contact import ask_at
from closedloop.mechanics.surface.geometry import turned_back


class Row(Block, sizes=("n",)):
    """A recorded row of n joints, columns in their order; `Row.count(n)` is its length."""

    q: Annotated[Array, N]
    v: Annotated[Array, N]
    acceleration: Annotated[Array, N]
    torque: Annotated[Array, N]
    position: Annotated[Array, 3]
    velocity: Annotated[Array, 3]
    surface_normal: Annotated[Array, 3]
    slip_velocity: Annotated[Array, 3]
    friction_force: Annotated[Array, 3]
    joint_friction: Annotated[Array, N]
    contact_force: float
    stabiliser_force: float
    closure_error: float
    closure_rate: float
    mode: float
    residual_motion: float
    residual_closure: float
    residual_contacts: float
    kkt_condition: float
    normal_mobility: float
    kinetic_energy: float
    measured_force: float
    energy_supplied: float


RECORDED = tuple(Row.layout.at)


class ArmRow(Block, sizes=("n",)):
    """What stands behind a `Row` where the scenario asks for the drives, encoders or transmissions of a real arm."""

    torque_limited: Annotated[Array, N]
    measured_position: Annotated[Array, N]
    measured_velocity: Annotated[Array, N]
    motor_position: Annotated[Array, N]
    motor_velocity: Annotated[Array, N]
    transmitted_torque: Annotated[Array, N]


class ContactRow(Block, sizes=("k",)):
    """What stands behind these where links have k contacts besides the tip; along their tangents first and second.

    The tangents of a surface that moves are those that it would have if it did not turn: see `turned_back`.
    """

    link_modes: Annotated[Array, K]
    link_gaps: Annotated[Array, K]
    link_forces: Annotated[Array, K]
    link_frictions: Annotated[Array, 2 * K]
    link_slips: Annotated[Array, 2 * K]
    link_rolling_moments: Annotated[Array, 2 * K]
    link_pivoting_moments: Annotated[Array, K]


CONTACT_RECORDED = tuple(ContactRow.layout.at)
ARM_RECORDED = tuple(ArmRow.layout.at)


def row_width(n: int, arm: bool, contacts: int = 0, states: int = 0) -> int:
    """Return the numbers in a row of n joints.

    Behind it are an `ArmRow` if `arm`, the `ContactRow` of k `contacts`, and so many `states` of law and compensation.
    """
    return Row.count(n) + (ArmRow.count(n) if arm else 0) + ContactRow.count(contacts) + states


def recorded(rows: Array, n: int, name: str, contacts: int = 0, states: int = 0) -> Array:
    """Return a copy of one of the columns `RECORDED` or `ARM_RECORDED`, (N,) or (N, k), of rows of n joints.

    A column of `ARM_RECORDED` is NaN where the rows do not have it. Those of `CONTACT_RECORDED` are of k `contacts`;
    behind them are so many `states`, see `row_width`.
    """
    rows = rows[:, : rows.shape[1] - states]
    if name in CONTACT_RECORDED:
        return rows[:, rows.shape[1] - ContactRow.count(contacts) :][:, ContactRow.place(name, contacts)].copy()
    rows = rows[:, : rows.shape[1] - ContactRow.count(contacts)]
    if name in ARM_RECORDED:
        if rows.shape[1] == Row.count(n):
            return np.full((rows.shape[0], n), np.nan)
        return rows[:, Row.count(n) :][:, ArmRow.place(name, n)].copy()
    return rows[:, Row.place(name, n)].copy()


@kernel_inlined
def kinetic_energy(H: Array, v: Array, ends: IntArray) -> float:
    """Return ½ q̇ᵀH q̇, J, from H's upper triangle, whose blocks end at `ends`."""
    total = 0.0
    for i in range(v.shape[0]):
        total += 0.5 * H[i, i] * v[i] * v[i]
        for j in range(i + 1, ends[i]):
            total += H[i, j] * v[i] * v[j]
    return total


@kernel
def record_conditions(batch: Array, rows: Array, state: State, done: int, n: int) -> None:
    """Write the condition numbers of the last rows up to `done`: those with a lane in `batch`.

    Of Eq. 24 with the normal row alone; of H while the tip is free.
    """
    count = state.batched
    state.batched = 0
    if count > 0:
        condition_numbers_of_batch(batch, n, count)
    for r in range(count):
        row = Row(row_of(rows, done - count + r), n)
        row.kkt_condition = batch[batch.shape[0] - 1, r]


@entry_kernel
def complete_record(address: int, rows: Array, done: int) -> None:
    """Write the condition numbers that the last of `done` rows still lack, at the end of a run; see `record`."""
    state, _, w = loop_at(address)
    record_conditions(w.batch, rows, state, done, state.n)


def rows_there(state: State, done: int, n: int) -> int:
    """Return how many rows are recorded: `done`, or one more that was not counted yet.

    Each row adds a lane to the batch, and a full batch is emptied.
    """
    return done if n > LONG_ARM or state.batched == done % BATCH else done + 1


@kernel
def record(
    H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, rows: Array, place: int
) -> None:
    """Write a row in the order of `Row`, and take the sample of the force sensor that is part of it."""
    record_state(H, C, w, state, rows, place)
    if state.contacts.entry != 0:  # not in `record_state`, which lanes share: their numbers are not a contact's
        record_contacts(w, state, row_of(rows, place))
    if state.settings.general == 0:
        return
    n = w.q.shape[0]
    take_sample(w, constants, state, row_of(table, place * state.settings.nodes_per_step), place)
    if state.settings.arm_at != 0:
        record_arm(w, state, row_of(rows, place)[state.settings.arm_at :])
    Row(row_of(rows, place), n).measured_force = w.sensing.measured
    if state.settings.states_at != 0:
        for k in range(state.law_states):
            row_of(rows, place)[state.settings.states_at + k] = w.z[k]


@kernel
def take_sample(w: Work, constants: Constants, state: State, drawn: Array, place: int) -> None:
    """Take the sample of the force sensor at row `place`, whose row of the table is `drawn`."""
    par: Any = SensorParameters(constants.sensor, 0)
    sensing = w.sensing
    numbers, last = TableRow(drawn, w.q.shape[0]).sensor, state.law_states + state.sensor.states
    late = par.jitter / constants.h * numbers[3]
    for axis in range(state.sensor.axes):
        feels = sensor_feels(axis, w, par, state)
        signal = signal_of(feels, par, w.z[min(state.law_states + axis, last) : last])
        sampled = signal - late * (signal - sensing.signal[axis])
        sensing.signal[axis] = signal
        bias, ring = bias_at(w.time, axis, par), row_of(sensing.ring, axis)
        reading = sense(sampled, bias, place, par, numbers[axis], ring[0 : state.sensor.ring])
        if axis == 0:
            sensing.measured = reading
        else:
            sensing.tangential[axis - 1] = reading


@kernel_inlined
def record_state(H: Array, C: Array, w: Work, state: State, rows: Array, place: int) -> None:
    """Do `write_row` with row `place`, and see to its condition number.

    That is written once a batch is full, or by `complete_record`; with loops it is that of H. Of dual numbers it and
    the residuals are NaN.
    """
    row = Row(row_of(rows, place), w.q.shape[0])
    keep_condition(H, w, state, write_row(H, C, w, state, row), row, rows, place)


@kernel_inlined
def keep_condition(H: Array, w: Work, state: State, bordered: Any, row: Row, rows: Array, place: int) -> None:
    """See to the condition number of row `place`; whether Eq. 24 has the row of the contact may differ in lanes."""
    n, lane = w.q.shape[0], state.batched
    if has_derivatives(row.contact_force):
        row.kkt_condition = math.nan
    elif n > LONG_ARM:
        row.kkt_condition = condition_number(
            H,
            row_of(w.tip.A, 0),
            w.L,
            row_of(w.tip.X, 0),
            w.tip.S[0, 0],
            every(bordered),
            w.scratch.numbers,
            integers_at(state.addresses.group_ends, state.n),
        )
    else:
        add_to_batch(H, row_of(w.tip.A, 0), w.L, row_of(w.tip.X, 0), w.tip.S[0, 0], bordered, w.batch, lane)
        state.batched = lane + 1
        if lane + 1 >= BATCH:
            record_conditions(w.batch, rows, state, place + 1, n)


@kernel_inlined
def write_row(H: Array, C: Array, w: Work, state: State, row: Row) -> bool:
    """Write a row but for its condition number: the state, torques and forces at it, the reading of f without error.

    Returns whether Eq. 24 has the row of the contact there.
    """
    write_columns(H, C, w, state, row)
    mode = state.mode
    # in a singular pose Eq. 24 has no row
    closed_by_row = mode != FREE and state.compliance.entry == 0 and every(w.tip.S[0, 0] > 0.0)
    last = 3 if mode == STUCK and state.friction.sticking == RIGID_STICK else 1
    row.mode = mode
    if has_derivatives(row.contact_force):
        row.residual_closure = math.nan
    else:
        row.residual_closure = closure_residual(w.qdd, w.tip, (0 if closed_by_row else 1, last))
    return closed_by_row and state.loops.entry == 0


@kernel_inlined
def write_columns(H: Array, C: Array, w: Work, state: State, row: Row) -> None:
    """Write what of a row does not depend on the contact's mode."""
    n, ends = w.q.shape[0], integers_at(state.addresses.group_ends, state.n)
    for j in range(n):
        row.q[j] = w.q[j]
        row.v[j] = w.v[j]
        row.acceleration[j] = w.qdd[j]
        row.torque[j] = w.torque[j]
        row.joint_friction[j] = w.joint_friction.torque[j]
        w.scratch.column[j] = applied_torque(w, state, j)
    for i in range(3):
        row.position[i] = w.r[i]
        speed = 0.0
        for j in range(n):
            speed += w.J[i, j] * w.v[j]
        row.velocity[i] = speed
        row.friction_force[i] = w.tip.frame[1, i] * w.tip.F[1] + w.tip.frame[2, i] * w.tip.F[2]
        row.slip_velocity[i] = w.tip.frame[1, i] * w.tip.u[1] + w.tip.frame[2, i] * w.tip.u[2]
        row.surface_normal[i] = w.tip.frame[0, i]
    if state.loops.entry != 0:
        missing_torque(H, C, w, state)
        ask_loops(state, REACTION)
        for j in range(n):
            w.scratch.column[j] += applied_torque(w, state, j)
    if state.coupled != 0:
        for j in range(n):
            w.scratch.column[j] += w.contacts.torque[j]
    trace = w.tip.S[0, 0] + w.tip.S[1, 1] + w.tip.S[2, 2]
    row.contact_force = w.tip.F[0]
    row.stabiliser_force = w.tip.stabiliser_force[0]
    row.closure_error = w.tip.gap
    row.closure_rate = w.tip.rate
    if has_derivatives(trace):  # it says how well Eq. 24 is solved, which is not worth a third of a step
        row.residual_motion = math.nan
    else:
        row.residual_motion = motion_residual(H, w.scratch.column, C, w.qdd, w.tip, ends)
    row.residual_contacts = 0.0 * trace  # see `record_contacts`
    row.normal_mobility = w.tip.S[0, 0] / select(trace > 0.0, trace, 1.0)
    row.kinetic_energy = kinetic_energy(H, w.v, ends)
    w.sensing.measured = w.tip.F[0]
    row.measured_force = w.sensing.measured
    row.energy_supplied = w.supply.energy


@kernel
def record_arm(w: Work, state: State, part: Array) -> None:
    """Write the part of a row that is an `ArmRow`; its readings are then those of the row before the next."""
    n = w.q.shape[0]
    row, motors = ArmRow(part, n), w.z.shape[0] - 2 * n
    for j in range(n):
        row.torque_limited[j] = w.drives.limited[j]
        row.measured_position[j] = w.encoders.last_q[j] = w.encoders.q[j]
        row.measured_velocity[j] = w.encoders.last_v[j] = w.encoders.v[j]
        row.transmitted_torque[j] = w.drives.transmitted[j]
        if state.settings.elastic != 0:
            row.motor_position[j], row.motor_velocity[j] = w.z[motors + j], w.z[motors + n + j]


@kernel
def record_contacts(w: Work, state: State, part: Array) -> None:
    """Write the part of a row that is a `ContactRow`, and by how much contact forces since the row before are off."""
    links, c = contacts_at(state.contacts.at)
    Row(part, w.q.shape[0]).residual_contacts, c.problem.off = c.problem.off, 0.0
    points = links.points
    if state.coupled == 0:
        for j in range(3):
            c.u[j] = w.tip.u[j]
    remember_speed(c, state.row)
    row = ContactRow(part[links.record_at :], points - 1)
    for i in range(1, points):
        at, to = 3 * i, i - 1
        row.link_modes[to] = STUCK if rests(c, i) else c.mode[i]
        row.link_gaps[to], row.link_forces[to] = c.located[at], c.F[at]
        rolling, pivoting, arm = resistance_of(c, i, 0), resistance_of(c, i, 1), c.friction.resistance.arm
        for a in range(2):
            row.link_frictions[2 * to + a], row.link_slips[2 * to + a] = c.F[at + 1 + a], c.u[at + 1 + a]
            row.link_rolling_moments[2 * to + a] = arm[rolling] * c.F[3 * rolling + 1 + a] if rolling >= 0 else 0.0
        row.link_pivoting_moments[to] = arm[pivoting] * c.F[3 * pivoting + 1] if pivoting >= 0 else 0.0
        if asked(links, i):
            surface, ask = ask_at(integers_at(links.surfaces, 2 * links.k)[2 * i + 1])
            if surface.motion != 0:
                along, across = turned_back(ask.axes, ask.frame)
                turn_pair(row.link_frictions, 2 * to, along, across)
                turn_pair(row.link_slips, 2 * to, along, across)
                turn_pair(row.link_rolling_moments, 2 * to, along, across)


@kernel
def turn_pair(x: Array, j: int, c: float, s: float) -> None:
    """Turn the two numbers of x from place j on, along axes, to those along axes of which c and s say the angle."""
    a, b = x[j], x[j + 1]
    x[j], x[j + 1] = c * a + s * b, c * b - s * a
