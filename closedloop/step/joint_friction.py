"""Friction in the joints, with the laws of `closedloop.friction`, one joint beside the other.

Laws with states (dahl, lugre) and seven_parameter give a torque from the state of the joint. A law that sticks rigidly
(coulomb, coulomb_viscous, stribeck, karnopp) gives at rest whatever torque holds the joint, up to its limit: it is the
torque within its bounds that brings the joint's velocity nearest to zero at the end of the step, q̇ + h q̈ = 0. That
is solved for all joints together with the contact force, by projected Gauss-Seidel on what Eq. 24 makes of a torque in
each joint (Moreau's time stepping). Friction then never adds energy, and no joint chatters about rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED, STUCK, accelerate, pressed_force, stuck_force
from closedloop.friction.laws import (
    advance_states,
    capture_speed,
    holding,
    memory_delay,
    rates,
    sliding,
    stick_limit,
    stick_states,
)
from closedloop.friction.layout import DAHL, LUGRE, SEVEN_PARAMETER
from closedloop.jit.kernel import kernel
from closedloop.step.memory import SPRING_STICK, Constants, State, Work

Array = NDArray[np.float64]

# Sweeps of Gauss-Seidel at most, and the change of a torque, as a share of its limit, after which there is no other.
MOST_SWEEPS, SETTLED = 500, 1e-14


@kernel
def _states_at(state: State, j: int) -> int:
    """Return where the friction states of joint j begin in z."""
    return int(state.law_states + state.sensor_states + state.friction_states + j * state.joint_states)


@kernel
def _delayed(w: Work, constants: Constants, state: State, rows: Array, j: int, delay: float) -> float:
    """Return the speed of joint j of `delay` seconds ago, a line between recorded rows."""
    n = w.q.shape[0]
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
def add_joint_friction(w: Work, constants: Constants, state: State, rows: Array) -> None:
    """Write the torque of friction on each joint, `loss` (n,), N m, as far as the state determines it."""
    n, kind, count = w.q.shape[0], state.joint_friction, state.joint_states
    u, c, viscous, direction = w.scratch[0:1], w.scratch[1:2], w.scratch[2:3], w.scratch[3:4]
    for j in range(n):
        w.joint_friction[j] = 0.0
        if kind <= 0:
            continue
        par = constants.joint_friction[j]
        z = w.z[_states_at(state, j) : _states_at(state, j) + count]
        u[0], direction[0] = w.v[j], 0.0
        if kind == SEVEN_PARAMETER and w.stuck[j] != 0.0:
            holding(kind, par, z, c, viscous)
        else:
            sliding(
                kind, par, u, _delayed(w, constants, state, rows, j, memory_delay(kind, par)), z, direction, c, viscous
            )
        if kind in (DAHL, LUGRE, SEVEN_PARAMETER):
            w.joint_friction[j] = -c[0] - viscous[0]
        else:
            w.joint_friction[j] = -viscous[0]


@kernel
def hold_joints(w: Work, constants: Constants, state: State) -> bool:
    """Add the dry friction of laws that stick rigidly to `loss`; return whether there is any.

    Reads q̈ and F of Eq. 24 without it; afterwards Eq. 24 is to be solved again.
    """
    n, kind, h = w.q.shape[0], state.joint_friction, constants.h
    if kind in (DAHL, LUGRE, SEVEN_PARAMETER):
        return False
    F, y, a = w.before, w.column, w.after
    limit, dry = w.scratch[8 : 8 + n], w.scratch[8 + n : 8 + 2 * n]
    u, c, viscous, direction, none = (
        w.scratch[0:1], w.scratch[1:2], w.scratch[2:3], w.scratch[3:4], w.scratch[4:6],
    )  # fmt: skip
    none[0], none[1] = 0.0, 0.0
    for j in range(n):
        par = constants.joint_friction[j]
        u[0], direction[0] = w.v[j], 0.0
        sliding(kind, par, u, abs(u[0]), w.z[0:0], direction, c, viscous)
        limit[j] = stick_limit(kind, par, w.z[0:0]) if abs(u[0]) <= max(capture_speed(kind, par), 1e-9) else abs(c[0])
        dry[j] = 0.0
        # Column j of the answer: q̈ to a torque of 1 N m in joint j, the contact as it is.
        for i in range(n):
            y[i] = 0.0
        y[j] = 1.0
        for i in range(j, n):
            s = y[i]
            for m in range(j, i):
                s -= w.L[i, m] * y[m]
            y[i] = s * w.L[i, i]
        for i in range(3):
            F[i] = 0.0
            a[i] = 0.0
            for m in range(n):
                a[i] += w.X[i, m] * y[m]
        if state.mode == PRESSED or (state.mode == STUCK and state.sticking == SPRING_STICK):
            pressed_force(w.S, a, 0.0, w.c, none, F)
        elif state.mode != FREE:
            for i in range(3):
                w.b_stabiliser[i] = 0.0
            stuck_force(w.S, a, w.b_stabiliser, F, w.compression)
        accelerate(w.L, w.X, y, F, w.gain[j])
    for _ in range(MOST_SWEEPS):
        change = 0.0
        for j in range(n):
            if not (limit[j] > 0.0 and w.gain[j, j] > 0.0):
                continue
            wanted = dry[j] - (w.v[j] / h + w.qdd[j]) / w.gain[j, j]
            new = min(max(wanted, -limit[j]), limit[j])
            moved = new - dry[j]
            dry[j] = new
            change = max(change, abs(moved) / limit[j])
            for i in range(n):
                w.qdd[i] += w.gain[j, i] * moved
        if change <= SETTLED:
            break
    for j in range(n):
        w.joint_friction[j] += dry[j]
    return True


@kernel
def joint_friction_rates(w: Work, constants: Constants, state: State) -> None:
    """Write the rates of the joints' friction states."""
    n, kind, count = w.q.shape[0], state.joint_friction, state.joint_states
    if count == 0:
        return
    u = w.scratch[0:1]
    for j in range(n):
        u[0] = w.v[j]
        here = _states_at(state, j)
        rates(
            kind, constants.joint_friction[j], u, w.stuck[j] != 0.0,
            w.z[here : here + count], w.dz[here : here + count],
        )  # fmt: skip


@kernel
def advance_joint_friction(w: Work, constants: Constants, state: State, h: float) -> None:
    """Advance the joints' friction states by h seconds at the velocity of the step's beginning."""
    n, kind, count = w.q.shape[0], state.joint_friction, state.joint_states
    if count == 0:
        return
    u = w.scratch[0:1]
    for j in range(n):
        u[0] = w.begin[n + j]
        here = _states_at(state, j)
        advance_states(
            kind, constants.joint_friction[j], u, w.stuck[j] != 0.0, h,
            w.z[here : here + count],
        )  # fmt: skip


@kernel
def stick_or_slip_joints(w: Work, constants: Constants, state: State, rows: Array) -> None:
    """At a row, let joints of seven_parameter stick whose motion has turned, and slip whose spring is stretched out."""
    n, kind, count = w.q.shape[0], state.joint_friction, state.joint_states
    i = state.row
    if kind != SEVEN_PARAMETER or i == 0:
        return
    c, viscous, direction = w.scratch[1:2], w.scratch[2:3], w.scratch[3:4]
    for j in range(n):
        par = constants.joint_friction[j]
        here = _states_at(state, j)
        z = w.z[here : here + count]
        if w.stuck[j] != 0.0:
            holding(kind, par, z, c, viscous)
            if abs(c[0]) >= stick_limit(kind, par, z):
                w.stuck[j] = 0.0
        elif w.v[j] * rows[i - 1, n + j] <= 0.0:
            direction[0] = 1.0 if rows[i - 1, n + j] > 0.0 else -1.0
            stick_states(kind, par, _delayed(w, constants, state, rows, j, memory_delay(kind, par)), direction, z)
            w.stuck[j] = 1.0
