"""Impacts of the tip: their impulses, the mode after them, and their rows in the table of events."""

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.loop.events.table import IMPACT, TOUCHDOWN, write_event
from closedloop.loop.step.closed_loops import impulse_of_frames
from closedloop.loop.step.entries import RESTART
from closedloop.loop.step.evaluate import call_law
from closedloop.loop.step.locate import set_anchor
from closedloop.loop.step.memory import RIGID_STICK, SPRING_STICK, Constants, State, Work, loop_at
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK, apply_impulse
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.friction import friction_of_impact
from closedloop.mechanics.contacts.impact import own_rest_speed
from closedloop.mechanics.contacts.memory import contacts_at
from closedloop.mechanics.impact import CUT as ENERGY_CUT
from closedloop.mechanics.impact import ImpactWork, energy_lost, impact
from closedloop.mechanics.limits import MAX_RAPID


@kernel
def log_event(w: Work, constants: Constants, state: State, events: Array, energy: float) -> None:
    """Write the event state.event.kind into the table, and subtract its energy loss from the energy supplied."""
    x = w.impact
    write_event(
        row_of(events, state.event.rows), w.time, state.event.kind, x.discarded_rebound, x.restitution_given,
        w.tip.frame, w.r, x.before, x.after, x.compression, x.decompression, energy, x.energy_rested,
    )  # fmt: skip
    state.event.rows += 1
    w.supply.energy -= energy
    for i in range(3):  # a surface that moves does work on the arm
        w.supply.energy += (x.compression[i] + x.decompression[i]) * w.tip.carried[i]
    if state.loops.frames != 0:
        for i in range(3):
            w.scratch.target[i] = x.compression[i] + x.decompression[i]
        w.supply.energy += impulse_of_frames(w, w.tip.X, w.scratch.target, x.after, w.tip.carried)


@kernel
def apply_impact(w: Work, constants: Constants, state: State, events: Array) -> None:
    """Apply the impulses of an impact to q̇, and set the mode after it."""
    lost = lost_in_both(w)
    apply_impulse(w.L, w.tip.X, w.tip.F, w.scratch.column, w.v)
    log_event(w, constants, state, events, lost)
    state.cleared = 1
    if state.settings.general != 0:
        call_law(state, RESTART)
        at = state.law_states + state.sensor.states
        for i in range(at, at + state.friction.states):
            w.z[i] = 0.0  # of a contact just made
        speed = np.hypot(w.impact.after[1], w.impact.after[2])
        if speed > 0.0:
            w.friction.direction[0], w.friction.direction[1] = w.impact.after[1] / speed, w.impact.after[2] / speed
    if state.event.kind == TOUCHDOWN:
        make_contact(w, constants, state, np.hypot(w.impact.after[1], w.impact.after[2]))


@kernel
def make_contact(w: Work, constants: Constants, state: State, speed: float) -> None:
    """Set the mode of a tip on the surface: STUCK if its law of friction sticks and it is slow enough, else PRESSED."""
    state.mode = PRESSED
    if state.friction.sticking in (RIGID_STICK, SPRING_STICK) and speed <= constants.stick_speed:
        state.mode = STUCK
        set_anchor(w, state)


@kernel
def lost_in_both(w: Work) -> float:
    """Return the energy that the two phases of an impact take, J, and write their impulse as F."""
    for i in range(3):
        w.tip.F[i] = w.impact.compression[i] + w.impact.decompression[i]
    return float(energy_lost(w.impact.before, w.impact.after, w.tip.F))


@entry_kernel
def collide(address: int) -> None:
    """Compute the impulses of the impact at the present state, and whether it ends in contact.

    The address is that of the loop's memory, see `closedloop.loop.step.memory.loop_at`. The function is separate from
    `proceed` because impacts are rare and their law takes longer to compile than all the rest.
    """
    state, constants, w = loop_at(address)
    if state.coupled != 0:
        links, c = contacts_at(state.contacts.at)
        mu, rest = friction_of_impact(links, c, state.striking), own_rest_speed(c, state.striking, constants.rest_speed)
        strike_surface(c.S[state.striking], mu, rest, w, constants, state)
        return
    strike_surface(w.tip.S, constants.impact_friction, constants.rest_speed, w, constants, state)


@kernel
def strike_surface(S: Array, mu: float, rest_speed: float, w: Work, constants: Constants, state: State) -> None:
    """Write the impulses on a point of mobility S (3, 3), 1/kg, that strikes with `before`, and the kind of event.

    If the rebound is slower than `rest_speed`, m/s, the tip stays in contact.
    """
    bounces = state.event.rapid <= MAX_RAPID
    state.event.kind, w.impact.discarded_rebound, w.impact.restitution_given = (
        IMPACT if bounces else TOUCHDOWN,
        0.0,
        0.0,
    )
    w.impact.energy_rested, bounced = 0.0, 0.0
    for _ in range(2):
        restitution = constants.restitution if state.event.kind == IMPACT else 0.0
        state.status = impact(
            S, w.impact.before, restitution, state.settings.impact_law, mu, w.scratch.numbers,
            (w.impact.compression, w.impact.decompression), w.impact.after,
        )  # fmt: skip
        if state.status != OK or state.event.kind == TOUCHDOWN:
            if w.impact.discarded_rebound > 0.0:
                w.impact.energy_rested = lost_in_both(w) - bounced
            return
        if w.impact.after[0] >= rest_speed:
            cut = int(ImpactWork(w.scratch.numbers).happened) & ENERGY_CUT != 0
            w.impact.restitution_given = -w.impact.after[0] / w.impact.before[0] if cut else restitution
            return
        state.event.kind, w.impact.discarded_rebound, bounced = TOUCHDOWN, w.impact.after[0], lost_in_both(w)
