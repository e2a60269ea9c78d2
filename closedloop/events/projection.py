"""Projection: a state put back on the closure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import STUCK, apply_impulse, factorise, stuck_force
from closedloop.closure.solve import OK
from closedloop.events.phases import ASK, CLOSED, FAIL, MOST_MOVES, PROJECTING, ask
from closedloop.jit.kernel import kernel
from closedloop.step.memory import RIGID_STICK, Constants, State, Work

Array = NDArray[np.float64]


@kernel
def project(H: Array, w: Work, constants: Constants, state: State) -> int:
    """Move the state towards the closure: q by −H⁻¹Aᵀ(A H⁻¹Aᵀ)⁻¹e until e is rounding, then q̇ likewise by its rate.

    Of all moves that close the loop these are the smallest in the norm of the mass matrix: what a contact impulse would
    do. The force of Eq. 24 carries no share of it.
    """
    state.status = factorise(H, w.A, w.L, w.X, w.S, constants.reach)
    if state.status != OK:
        return FAIL
    stuck = state.mode == STUCK and state.sticking == RIGID_STICK
    for level in range(2):
        w.a[0] = w.gap if level == 0 else w.u[0]
        size = abs(w.a[0])
        for i in range(1, 3):
            w.a[i] = 0.0
            if stuck:
                w.a[i] = w.p[i] - w.anchor[i - 1] if level == 0 else w.u[i]
                size = max(size, abs(w.a[i]))
        if level == 0 and (size <= CLOSED or state.moves >= MOST_MOVES):
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
            apply_impulse(w.L, w.X, w.F, w.column, w.q)
            state.moves += 1
            ask(state, PROJECTING)
            return ASK
        apply_impulse(w.L, w.X, w.F, w.column, w.v)
    ask(state, state.next_phase)
    return ASK
