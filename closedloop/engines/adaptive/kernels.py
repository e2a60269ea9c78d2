"""The kernels of a step, to be asked about any state at any instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import PRESSED
from closedloop.closure.solve import OK
from closedloop.events.locate import gauge, slip_left
from closedloop.events.phases import extra_states
from closedloop.events.substep import remember
from closedloop.friction.laws import capture_speed
from closedloop.jit.kernel import entry_kernel, inlined_kernel
from closedloop.robot.tip import tip_kinematics
from closedloop.step.energy_supplied import power
from closedloop.step.evaluate import evaluate
from closedloop.step.memory import (
    FRICTION,
    FRICTION_AT,
    FRICTION_WIDTH,
    GAUGE,
    GRAVITY,
    JOINTS,
    MODE,
    RIGID_STICK,
    ROW,
    SENSOR_RING,
    STAGES,
    START_POWER,
    START_SLIP,
    STICK_SPEED,
    STICKING,
    TIP,
    Whole,
    workspace,
)
from closedloop.step.record_row import record

Array = NDArray[np.float64]

# What a state is evaluated for: its derivative, to begin a step from it, to see how far an event is, to record it.
DERIVE, SET_OUT, GAUGE_IT, RECORD = range(4)


@inlined_kernel
def _on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    k: Array, state: Whole, memory: Array, wanted: Array, table: Array, rows: Array, use: int, more: int | None,
) -> int:  # fmt: skip
    n = C.shape[0]
    w = workspace(memory, n, extra_states(state, n), state[STAGES], state[SENSOR_RING])
    tip_kinematics(
        joint_jacobian, rotation, origin, velocity, acceleration,
        k[TIP : TIP + 3], k[GRAVITY : GRAVITY + 3], k[JOINTS : JOINTS + n], w.J, w.r, w.drift,
    )  # fmt: skip
    status = evaluate(H, C, w, k, state, wanted, rows, more)
    if status != OK:
        return status
    if use == DERIVE:
        w.now[START_POWER] = power(w)
    elif use == SET_OUT:
        remember(w, k, state, more)
    elif use == GAUGE_IT:
        w.now[GAUGE] = gauge(w, k, state, more)
        if more is not None and state[STICKING] == RIGID_STICK and state[MODE] == PRESSED:
            band = capture_speed(state[FRICTION], k[FRICTION_AT : FRICTION_AT + FRICTION_WIDTH])
            begun = w.now[START_SLIP]
            if begun > k[STICK_SPEED] and not begun > band > 0.0:  # see `Memory.happen`
                w.now[GAUGE] = min(w.now[GAUGE], 1e3 * (slip_left(w, k, state) - k[STICK_SPEED]))
    elif use == RECORD:
        record(H, C, w, k, state, table, rows, state[ROW], more)
    return OK


@entry_kernel
def evaluate_on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    k: Array, state: Whole, memory: Array, wanted: Array, table: Array, rows: Array, use: int,
) -> int:  # fmt: skip
    """Do `closedloop.step.evaluate.evaluate` on what Pinocchio left in its data, and return its status.

    H ... rows are as in `closedloop.events.proceed` and `closedloop.robot.tip`; `wanted` (1, 2 n + 11) stands for the
    table at this instant, and `use` says what the state is for: DERIVE, SET_OUT, GAUGE_IT or RECORD.
    """
    return _on_pinocchio(
        H, C, joint_jacobian, rotation, origin, velocity, acceleration, k, state, memory, wanted, table, rows, use, None
    )


@entry_kernel
def evaluate_with_more_on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    k: Array, state: Whole, memory: Array, wanted: Array, table: Array, rows: Array, use: int,
) -> int:  # fmt: skip
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return _on_pinocchio(
        H, C, joint_jacobian, rotation, origin, velocity, acceleration, k, state, memory, wanted, table, rows, use, 1
    )
