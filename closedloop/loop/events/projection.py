"""Projection of a state onto the closure, at position and velocity level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.loop.events.phases import CLOSED, FAIL, MAX_MOVES, NEED_TERMS, PROJECTION, request_terms
from closedloop.loop.step.closed_loops import factorise_tip
from closedloop.loop.step.locate import off_anchor
from closedloop.loop.step.memory import RIGID_STICK, Constants, State, Work
from closedloop.loop.step.turn import move
from closedloop.mechanics.closure.contact_force import STUCK, answer_impulse, apply_impulse, stuck_force
from closedloop.mechanics.closure.solve import OK

Array = NDArray[np.float64]


@kernel
def project(H: Array, w: Work, constants: Constants, state: State) -> int:
    """Project the state onto the closure: q by −H⁻¹Aᵀ(A H⁻¹Aᵀ)⁻¹e until e is rounding, then q̇ likewise by ė.

    Of all corrections that close the loop these are the smallest in the norm of H, as a contact impulse's is. They do
    not contribute to the force of Eq. 24.
    """
    state.status = factorise_tip(H, w, constants, state)
    if state.status != OK:
        return FAIL
    stuck = state.mode == STUCK and state.sticking == RIGID_STICK
    for level in range(2):
        w.a[0] = w.gap if level == 0 else w.u[0]
        size = abs(w.a[0])
        for i in range(1, 3):
            w.a[i] = 0.0
            if stuck:
                w.a[i] = off_anchor(w, state, i) if level == 0 else w.u[i]
                size = max(size, abs(w.a[i]))
        if level == 0 and (size <= CLOSED or state.projections >= MAX_MOVES):
            continue
        if stuck:
            for i in range(3):
                w.b[i] = 0.0
            state.status = stuck_force(w.S, w.a, w.b, w.F, w.stabiliser_force)
            if state.status != OK:
                return FAIL
        else:
            w.F[0] = -w.a[0] / w.S[0, 0] if w.S[0, 0] > 0.0 else 0.0
            w.F[1], w.F[2] = 0.0, 0.0
        if level == 0:
            if state.balls == 0:
                apply_impulse(w.L, w.X, w.F, w.column, w.q)
            else:
                answer_impulse(w.L, w.X, w.F, w.column)
                move(w, constants)
            state.projections += 1
            request_terms(state, PROJECTION)
            return NEED_TERMS
        apply_impulse(w.L, w.X, w.F, w.column, w.v)
    request_terms(state, state.next_phase)
    return NEED_TERMS
