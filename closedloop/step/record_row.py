"""The rows of the record: their columns, and the kernel that writes one."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.conditioning import (
    BATCH,
    LONG_ARM,
    add_to_batch,
    condition_number,
    condition_numbers_of_batch,
)
from closedloop.closure.contact_force import FREE, STUCK, residuals
from closedloop.control.sensor import SensorParameters, sense
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.simd8 import select
from closedloop.step.memory import RIGID_STICK, Constants, State, Work, loop_at

Array = NDArray[np.float64]


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
    @lru_cache(maxsize=16)
    def of(cls, n: int) -> Row:
        """Lay out a row for n joints."""
        ends = np.cumsum((0, n, n, n, n, 3, 3, 3, n, len(SCALARS))).tolist()
        return cls(*ends)


SCALARS = (
    "contact_force", "stabiliser_force", "closure_error", "closure_rate", "mode", "residual_motion",
    "residual_closure", "kkt_condition", "normal_mobility", "kinetic_energy", "measured_force", "energy_supplied",
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
def record_conditions(batch: Array, rows: Array, state: State, done: int, n: int) -> None:
    """Write the condition numbers of the last rows up to `done`: those with a lane in `batch`.

    Of Eq. 24 with the normal row alone; of H while the tip is free.
    """
    count = state.batched
    state.batched = 0
    if count > 0:
        condition_numbers_of_batch(batch, n, count)
    at = 5 * n + 9 + KKT_CONDITION
    for r in range(count):
        rows[done - count + r, at] = batch[batch.shape[0] - 1, r]


@entry_kernel
def complete_record(address: int, rows: Array, done: int) -> None:
    """Write the condition numbers that the last of `done` rows still lack, at the end of a run; see `record`."""
    state, _, w = loop_at(address)
    record_conditions(w.batch, rows, state, done, state.n)


def rows_there(state: State, done: int, n: int) -> int:
    """Return how many rows are recorded when `done` of them, or one more that was not counted yet, may be.

    Each row adds a lane to the batch, and a full batch is emptied.
    """
    return done if n > LONG_ARM or state.batched == done % BATCH else done + 1


@kernel_inlined
def record(
    H: Array,
    C: Array,
    w: Work,
    constants: Constants,
    state: State,
    table: Array,
    rows: Array,
    place: int,
    general: int | None,
) -> None:
    """Write a row in the order of `Row`: the state, and the torques and forces at it.

    The condition number is written once a batch is full, or by `complete_record`.
    """
    n = w.q.shape[0]
    row, lane = rows[place], state.batched
    at = 4 * n + 9
    for j in range(n):
        row[j] = w.q[j]
        row[n + j] = w.v[j]
        row[2 * n + j] = w.qdd[j]
        row[3 * n + j] = w.torque[j]
        row[at + j] = w.joint_friction[j]
        w.column[j] = w.torque[j] + w.joint_friction[j]
    at = 4 * n
    for i in range(3):
        row[at + i] = w.r[i]
        speed = 0.0
        for j in range(n):
            speed += w.J[i, j] * w.v[j]
        row[at + 3 + i] = speed
        row[at + 6 + i] = constants.frame[1, i] * w.F[1] + constants.frame[2, i] * w.F[2]
    at += 9 + n
    mode = state.mode
    closures = 0 if mode == FREE else (3 if mode == STUCK and state.sticking == RIGID_STICK else 1)
    motion, closed = residuals(H, w.column, C, w.A, w.S, w.drift_c, w.b, w.a, w.qdd, w.F, 0, closures)
    trace = w.S[0, 0] + w.S[1, 1] + w.S[2, 2]
    row[at] = w.F[0]
    row[at + 1] = w.stabiliser_force[0]
    row[at + 2] = w.gap
    row[at + 3] = w.rate
    row[at + 4] = mode
    row[at + 5] = motion
    row[at + 6] = closed
    if n > LONG_ARM:
        row[at + 7] = condition_number(H, w.A[0], w.L, w.X[0], w.S[0, 0], mode != FREE, w.scratch)
    else:
        add_to_batch(H, w.A[0], w.L, w.X[0], w.S[0, 0], mode != FREE, w.batch, lane)
        state.batched = lane + 1
        if lane + 1 >= BATCH:
            record_conditions(w.batch, rows, state, place + 1, n)
    row[at + 8] = w.S[0, 0] / select(trace > 0.0, trace, 1.0)
    row[at + 9] = kinetic_energy(H, w.v)
    if general is None:
        w.measured = w.F[0]
    else:
        count, sensor = state.law_states, state.sensor_states
        w.measured = sense(
            w.F[0], place, SensorParameters(constants.sensor, 0), w.z[count : count + sensor],
            table[place * state.nodes_per_step, 2 * n + 10], w.ring[0 : state.sensor_ring],
        )  # fmt: skip
    row[at + 10] = w.measured
    row[at + 11] = w.supplied


RECORDED = tuple(name for name in Row._fields if name not in ("scalars", "width")) + SCALARS


def recorded(rows: Array, n: int, name: str) -> Array:
    """Return a copy of one of the columns `RECORDED`, (N,) or (N, k), of the rows of a robot of n joints."""
    layout = Row.of(n)
    if name in SCALARS:
        return rows[:, layout.scalars + SCALARS.index(name)].copy()
    place = Row._fields.index(name)
    return rows[:, layout[place] : layout[place + 1]].copy()
