"""Impacts of the tip: their impulses, the mode after them, and their rows in the table of events."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.jit.pointers import row_of
from closedloop.loop.events.phases import MAX_RAPID
from closedloop.loop.events.stops import MOST_TRIALS, note_sides, yield_stops
from closedloop.loop.events.table import IMPACT, TOUCHDOWN, write_event
from closedloop.loop.step.entries import RESTART
from closedloop.loop.step.evaluate import call_law
from closedloop.loop.step.locate import set_anchor
from closedloop.loop.step.memory import RIGID_STICK, SPRING_STICK, Constants, State, Work, loop_at
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK, apply_impulse
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.given_modes import own_mobility
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.impact import CUT as ENERGY_CUT
from closedloop.mechanics.impact import ImpactWork, energy_lost, impact

Array = NDArray[np.float64]


@kernel
def log_event(w: Work, constants: Constants, state: State, events: Array, energy: float) -> None:
    """Write the event state.kind into the table, and subtract its energy loss from the energy supplied."""
    write_event(
        row_of(events, state.events), w.time, state.kind, w.discarded_rebound, w.restitution_given, w.frame, w.r,
        w.before, w.after, w.compression, w.decompression, energy, w.energy_rested,
    )  # fmt: skip
    state.events += 1
    w.supplied -= energy
    for i in range(3):  # a surface that moves does work on the arm
        w.supplied += (w.compression[i] + w.decompression[i]) * w.carried[i]


@kernel
def apply_impact(w: Work, constants: Constants, state: State, events: Array) -> None:
    """Apply the impulses of an impact to q̇, and set the mode after it."""
    lost = lost_in_both(w)
    apply_impulse(w.L, w.X, w.F, w.column, w.v)
    log_event(w, constants, state, events, lost)
    state.risen = 1
    if state.law != 0:
        call_law(state, RESTART)
        at = state.law_states + state.sensor_states
        for i in range(at, at + state.friction_states):
            w.z[i] = 0.0  # of a contact just made
        speed = np.hypot(w.after[1], w.after[2])
        if speed > 0.0:
            w.direction[0], w.direction[1] = w.after[1] / speed, w.after[2] / speed
    if state.kind == TOUCHDOWN:
        make_contact(w, constants, state, np.hypot(w.after[1], w.after[2]))


@kernel
def make_contact(w: Work, constants: Constants, state: State, speed: float) -> None:
    """Set the mode of a tip on the surface: STUCK if its law of friction sticks and it is slow enough, else PRESSED."""
    state.mode = PRESSED
    if state.sticking in (RIGID_STICK, SPRING_STICK) and speed <= constants.stick_speed:
        state.mode = STUCK
        set_anchor(w, state)


@kernel
def lost_in_both(w: Work) -> float:
    """Return the energy that the two phases of an impact take, J, and write their impulse as F."""
    for i in range(3):
        w.F[i] = w.compression[i] + w.decompression[i]
    return float(energy_lost(w.before, w.after, w.F))


@entry_kernel
def collide(address: int) -> None:
    """Compute the impulses of the impact at the present state, and whether it ends in contact.

    The address is that of the loop's memory, see `closedloop.loop.step.memory.loop_at`. The function is separate from
    `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    state, constants, w = loop_at(address)
    if state.together != 0:
        _, c = contacts_at(state.contacts_at)
        own_mobility(c, state.striking, c.slope)
        strike_surface(c.slope, c.mu[state.striking], w, constants, state)
        return
    if state.stops == 0:
        strike_surface(w.S, constants.impact_friction, w, constants, state)
        return
    note_sides(w)
    for _ in range(MOST_TRIALS):
        strike_surface(w.S, constants.impact_friction, w, constants, state)
        if state.status != OK or not yield_stops(w, state):
            return


@kernel
def strike_surface(S: Array, mu: float, w: Work, constants: Constants, state: State) -> None:
    """Write the impulses on a point of mobility S (3, 3), 1/kg, that strikes with `before`, and the kind of event."""
    bounces = state.rapid_events <= MAX_RAPID
    state.kind, w.discarded_rebound, w.restitution_given = IMPACT if bounces else TOUCHDOWN, 0.0, 0.0
    w.energy_rested, bounced = 0.0, 0.0
    for _ in range(2):
        restitution = constants.restitution if state.kind == IMPACT else 0.0
        state.status = impact(
            S, w.before, restitution, state.impact_law, mu, w.scratch,
            (w.compression, w.decompression), w.after,
        )  # fmt: skip
        if state.status != OK or state.kind == TOUCHDOWN:
            if w.discarded_rebound > 0.0:
                w.energy_rested = lost_in_both(w) - bounced
            return
        if w.after[0] >= constants.rest_speed:
            cut = int(ImpactWork(w.scratch).happened) & ENERGY_CUT != 0
            w.restitution_given = -w.after[0] / w.before[0] if cut else restitution
            return
        state.kind, w.discarded_rebound, bounced = TOUCHDOWN, w.after[0], lost_in_both(w)
