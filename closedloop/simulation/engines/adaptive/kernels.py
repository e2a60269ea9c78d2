"""The kernels of a step, for any state at any instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.pointers import fortran_at, integers_at, matrix_at, vector_at
from closedloop.loop.events.locate import event_function, slip_margin
from closedloop.loop.events.stops import measure_stops
from closedloop.loop.events.substep import save_state
from closedloop.loop.step.contacts import WATCH
from closedloop.loop.step.energy_supplied import power
from closedloop.loop.step.evaluate import evaluate
from closedloop.loop.step.memory import RIGID_STICK, loop_at
from closedloop.loop.step.record_row import record
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.closure.solve import OK
from closedloop.simulation.engines.proceed import ADDRESSES, Addresses, tip_from_pinocchio

Array = NDArray[np.float64]

# What a state is evaluated for: its derivative, to begin a step from it, to see how far an event is, to record it.
DERIVE, BEGIN_STEP, EVENT_VALUE, RECORD = range(4)


@entry_kernel
def evaluate_on_pinocchio(address: int, table: Array, use: int) -> int:
    """Do `closedloop.loop.step.evaluate.evaluate` with the terms in Pinocchio's data, and return its status.

    Parameters
    ----------
    address : int
        Of the memory of `closedloop.simulation.engines.proceed.Addresses`, with a table of one row, the reference at
        this instant.
    table : (P, 2 n + 11) array
        The whole table, for the noise of the force sensor.
    use : int
        What the state is for: DERIVE, BEGIN_STEP, EVENT_VALUE or RECORD.
    """
    a = Addresses(integers_at(address, ADDRESSES))
    tip_from_pinocchio(a)
    n = a.n
    state, constants, w = loop_at(a.loop)
    H, C, rows = fortran_at(a.H, n, n), vector_at(a.C, n), matrix_at(a.rows, a.row_count, a.row_width)
    status = evaluate(H, C, w, constants, state, matrix_at(a.table, a.instants, a.table_width), rows)
    if status != OK:
        return status
    if state.together == 0 and use != DERIVE:
        if state.stops != 0:
            measure_stops(H, C, w, constants, state)
        if state.contacts != 0:
            status = call_at(state.contacts, state.contacts_at, WATCH)
            if status != OK:
                return status
    if use == DERIVE:
        w.start_power = power(w, state)
    elif use == BEGIN_STEP:
        save_state(w, constants, state)
    elif use == EVENT_VALUE:
        stop = w.stop_margin  # an event of its own here
        w.stop_margin = np.inf
        w.event_value = event_function(w, constants, state)
        w.stop_margin = stop
        if state.sticking == RIGID_STICK and state.mode == PRESSED and state.together == 0:
            begun, band = w.start_slip_speed, constants.capture_speed
            if begun > constants.stick_speed and not begun > band > 0.0:  # see `Memory.apply_event`
                w.event_value = min(w.event_value, 1e3 * (slip_margin(w, constants) - constants.stick_speed))
    elif use == RECORD:
        record(H, C, w, constants, state, table, rows, state.row)
    return OK
