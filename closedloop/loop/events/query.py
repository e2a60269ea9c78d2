"""What an integrator that evaluates any state at any instant is told of one: the phase QUERY of `proceed`."""

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.loop.events.locate import event_function, slip_margin
from closedloop.loop.events.phases import FAILED, TERMS
from closedloop.loop.events.substep import save_state
from closedloop.loop.step.contacts import WATCH
from closedloop.loop.step.energy_supplied import power
from closedloop.loop.step.memory import RIGID_STICK, Constants, State, Work, ask_contacts
from closedloop.loop.step.record_row import record
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.closure.solve import OK

# What a state is evaluated for: its derivative, to begin a step from it, to see how far an event is, to record it.
DERIVE, BEGIN_STEP, EVENT_VALUE, RECORD = range(4)


@kernel
def answer_query(
    H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, rows: Array
) -> int:  # fmt: skip
    """Write what `State.query` wants of the state that was evaluated, and return TERMS, or FAILED with `State.status`.

    The event function is in w.search.value, the row in `rows`; see `closedloop.loop.events.proceed` for the arguments.
    """
    alone = state.coupled == 0
    if alone and state.query != DERIVE:
        state.status = ask_contacts(state, WATCH)
        if state.status != OK:
            return FAILED
    if state.query == DERIVE:
        w.supply.power = power(w, state)
    elif state.query == BEGIN_STEP:
        save_state(w, constants, state)
    elif state.query == EVENT_VALUE:
        w.search.value = event_function(w, constants, state)
        if state.friction.sticking == RIGID_STICK and state.mode == PRESSED and alone:
            begun, band = w.start.slip_speed, constants.capture_speed
            if begun > constants.stick_speed and not begun > band > 0.0:  # see `Memory.apply_event`
                w.search.value = min(w.search.value, 1e3 * (slip_margin(w, constants) - constants.stick_speed))
    else:
        record(H, C, w, constants, state, table, rows, state.row)
    return TERMS
