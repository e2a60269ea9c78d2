"""The kernels of a step, to be asked about any state at any instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import PRESSED
from closedloop.closure.solve import OK
from closedloop.events.locate import event_function, slip_left
from closedloop.events.phases import extra_states
from closedloop.events.substep import remember
from closedloop.friction.laws import capture_speed
from closedloop.jit.kernel import entry_kernel, inlined_kernel
from closedloop.robot.tip import tip_kinematics
from closedloop.step.energy_supplied import power
from closedloop.step.evaluate import evaluate
from closedloop.step.memory import RIGID_STICK, Constants, State, Whole, Work
from closedloop.step.record_row import record

Array = NDArray[np.float64]

# What a state is evaluated for: its derivative, to begin a step from it, to see how far an event is, to record it.
DERIVE, SET_OUT, EVENT_VALUE, RECORD = range(4)


@inlined_kernel
def _on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    constant_numbers: Array, state_numbers: Whole, work_numbers: Array, wanted: Array, table: Array, rows: Array,
    use: int, more: int | None,
) -> int:  # fmt: skip
    n = C.shape[0]
    constants, state = Constants(constant_numbers, n), State(state_numbers)
    w = Work(work_numbers, n, extra_states(state, n), state.stages, state.sensor_ring)
    tip_kinematics(
        joint_jacobian, rotation, origin, velocity, acceleration,
        constants.tip, constants.gravity, constants.support, w.J, w.r, w.drift,
    )  # fmt: skip
    status = evaluate(H, C, w, constants, state, wanted, rows, more)
    if status != OK:
        return status
    if use == DERIVE:
        w.start_power = power(w)
    elif use == SET_OUT:
        remember(w, constants, state, more)
    elif use == EVENT_VALUE:
        w.event_value = event_function(w, constants, state, more)
        if more is not None and state.sticking == RIGID_STICK and state.mode == PRESSED:
            band = capture_speed(state.friction, constants.friction)
            begun = w.start_slip_speed
            if begun > constants.stick_speed and not begun > band > 0.0:  # see `Memory.happen`
                w.event_value = min(w.event_value, 1e3 * (slip_left(w, constants, state) - constants.stick_speed))
    elif use == RECORD:
        record(H, C, w, constants, state, table, rows, state.row, more)
    return OK


@entry_kernel
def evaluate_on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    constant_numbers: Array, state_numbers: Whole, work_numbers: Array, wanted: Array, table: Array, rows: Array,
    use: int,
) -> int:  # fmt: skip
    """Do `closedloop.step.evaluate.evaluate` on what Pinocchio left in its data, and return its status.

    H ... rows are as in `closedloop.events.proceed` and `closedloop.robot.tip`; `wanted` (1, 2 n + 11) stands for the
    table at this instant, and `use` says what the state is for: DERIVE, SET_OUT, EVENT_VALUE or RECORD.
    """
    return _on_pinocchio(
        H,
        C,
        joint_jacobian,
        rotation,
        origin,
        velocity,
        acceleration,
        constant_numbers,
        state_numbers,
        work_numbers,
        wanted,
        table,
        rows,
        use,
        None,
    )


@entry_kernel
def evaluate_with_more_on_pinocchio(
    H: Array, C: Array, joint_jacobian: Array, rotation: Array, origin: Array, velocity: Array, acceleration: Array,
    constant_numbers: Array, state_numbers: Whole, work_numbers: Array, wanted: Array, table: Array, rows: Array,
    use: int,
) -> int:  # fmt: skip
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return _on_pinocchio(
        H,
        C,
        joint_jacobian,
        rotation,
        origin,
        velocity,
        acceleration,
        constant_numbers,
        state_numbers,
        work_numbers,
        wanted,
        table,
        rows,
        use,
        1,
    )
