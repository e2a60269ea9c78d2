"""The loop as a machine that asks for what it needs: steps, events, impacts and projections in one place.

`proceed` is called with the terms (H, C, Jᵣ, r, J̇ᵣq̇) of the state it asked for, does everything that can be done with
them, and returns with the next state to be evaluated in `Work.q` and `Work.v`. Who evaluates it is not its business:
Pinocchio, called from Python, or terms of our own, compiled. This way of turning a loop inside out is known as reverse
communication.

The phase says what the terms that have just arrived are for:

    ARRIVE    the end of a step (or the start): record the row, or find that something happened on the way
    STAGE     a later stage of a Runge-Kutta step
    PROBE_END the end of a trial step, taken to locate an event inside a step
    APPLY_EVENT   the state at the instant of an event: apply the impact, change the mode
    APPLY_IMPACT    (no terms) the impulses of the impact are known
    BEGIN     the state just after an event: go on from there to the end of the step
    PROJECT     a state to be put back on the closure (projection)

An event shows when a step arrives and its event function is negative: the gap while the tip is free, the force of the
rigid closure while it is pressed, the speed along the old direction while it slides, and what is left of the friction
cone while it sticks. It also shows when a stage inside a step finds that the rigid closure of a pressed tip pulls, and
when a free tip goes down at the beginning of a step and up at its end. The step is then taken again, shorter, until the
instant is bracketed to `INSTANT`; a step to that instant, the event, and a step for the remainder replace it. Every
piece is a full step of the integrator, so its order is kept. What begins and ends between two evaluations leaves no
trace: a pull that no stage sees, and a free tip that rises, dips into the surface and rises again in one step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE
from closedloop.closure.solve import OK
from closedloop.events.locate import event_function, narrow
from closedloop.events.phases import (
    APPLY_EVENT,
    APPLY_IMPACT,
    ARRIVING,
    ASK,
    AT_EVENT,
    BEGINNING,
    COLLIDE,
    DONE,
    ENLARGE,
    FAIL,
    FAILED,
    IMPACT_LAW_WANTED,
    IMPACTING,
    LEAVE,
    PROBING,
    PROJECT,
    PROJECTING,
    ROOM,
    SET_OUT,
    SET_OUT_AGAIN,
    STAGING,
    TERMS,
    ask,
)
from closedloop.events.projection import project
from closedloop.events.substep import advance_friction, arrive, leave_stage, look, remember, restore
from closedloop.events.transitions import apply_event, apply_impact, begin_piece
from closedloop.jit.kernel import inlined_kernel
from closedloop.step.advance import advance
from closedloop.step.energy_supplied import gain, settle
from closedloop.step.evaluate import evaluate, locate_tip
from closedloop.step.joint_friction import stick_or_slip_joints
from closedloop.step.memory import Constants, State, Work
from closedloop.step.record_row import record

Array = NDArray[np.float64]


@inlined_kernel
def proceed(
    H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, tableau: Array, rows: Array,
    events: Array, more: int | None,
) -> int:  # fmt: skip
    """Use the terms of the state that was asked for, and ask for the next.

    Parameters
    ----------
    H, C : (n, n), (n,) arrays
        Terms at (q, q̇) in `w`; Jᵣ, r and J̇ᵣq̇ are in `w`.
    w, k, state
        See `closedloop.step.memory`.
    table : (P, 2 n + 11) array
        What is desired at the instants of the stages, see `closedloop.step.evaluate.reference_row`.
    tableau : (S + 1, S) array
        See `closedloop.integrators.Scheme.tableau`.
    rows : (N, width) array
        The record, see `closedloop.step.record_row.Row`; row state.row is the next to be written.
    events : (M, EVENT_WIDTH) array
        The table of events, of which state.events rows are written.
    more : int or None
        See `closedloop.step.evaluate`.

    Returns
    -------
    int
        TERMS: evaluate the terms at (q, q̇) and call again. ROOM:
        give a larger table of events and call again. IMPACT_LAW_WANTED: call `collide`, then again. DONE, or FAILED
        with state.status.
    """
    phase = state.phase
    if phase in (ARRIVING, STAGING, BEGINNING) or (phase in (PROBING, AT_EVENT) and state.mode != FREE):
        status = evaluate(H, C, w, constants, state, table, rows, more)
        if status != OK:
            state.status = status
            return FAILED
    elif phase != IMPACTING:
        locate_tip(w, constants)
    todo = ASK
    if phase == ARRIVING:
        w.event_value = event_function(w, constants, state, more)
        todo = arrive(w, w.drift_c[0], state)
        if todo == SET_OUT:
            settle(w)
            if more is not None:
                stick_or_slip_joints(w, constants, state, rows)
            record(H, C, w, constants, state, table, rows, state.row, more)
            if state.row == state.steps:
                return DONE
            state.row += 1
            state.events_in_step, state.after_event = 0, 0
            w.length = constants.h
        elif todo == SET_OUT_AGAIN and state.hold > 0 and state.sampled != 0:
            for j in range(w.torque.shape[0]):
                w.torque[j] = w.held[j]  # until the end of the step the torque of the last sample acted
    elif phase == STAGING:
        todo = look(w, state) if state.unilateral != 0 else LEAVE
    elif phase == PROBING:
        w.event_value = event_function(w, constants, state, more)
        todo = narrow(w, state)
    elif phase == AT_EVENT:
        todo = APPLY_EVENT
    elif phase == IMPACTING:
        todo = APPLY_IMPACT
    elif phase == PROJECTING:
        todo = PROJECT
    else:
        todo = begin_piece(C, w, constants, state, more)

    if todo == APPLY_EVENT:
        settle(w)
        todo = apply_event(H, w, constants, state, rows, events, more)
    if todo == APPLY_IMPACT:
        if state.status != OK:
            return FAILED
        apply_impact(w, constants, state, events, more)
        todo = ASK
        if state.project != 0 and state.mode != FREE:
            state.moves, state.next_phase = 0, BEGINNING
            ask(state, PROJECTING)
        else:
            ask(state, BEGINNING)
    if todo == PROJECT:
        todo = project(H, w, constants, state)
    if todo == SET_OUT:
        remember(w, constants, state, more)
        todo = LEAVE
    elif todo == SET_OUT_AGAIN:
        restore(w, state)
        todo = LEAVE
    if todo == LEAVE:
        stage, tau = state.stage, w.tau
        gain(w, stage, tau, tableau[tableau.shape[0] - 1, stage])
        if more is not None and state.semi_implicit != 0:
            advance_friction(w, state, tau)
        advance(
            stage, tau, state.semi_implicit != 0, state.after_event != 0, tableau, w.begin, w.stages,
            w.qdd, w.dz, w.q, w.v, w.z,
        )  # fmt: skip
        leave_stage(w, constants.h, state, tableau)
    elif todo == ENLARGE:
        return ROOM
    elif todo == COLLIDE:
        return IMPACT_LAW_WANTED
    elif todo == FAIL:
        return FAILED
    return TERMS
