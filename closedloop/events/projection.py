"""Projection: a state put back on the closure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import STUCK, factorise, strike, stuck_force
from closedloop.closure.solve import OK
from closedloop.events.phases import ASK, CLOSED, CLOSING, FAIL, MOST_MOVES, ask
from closedloop.jit.kernel import kernel
from closedloop.step.memory import GAP, MODE, MOVES, NEXT, REACH, RIGID_STICK, STATUS, STICKING, Whole, Work

Array = NDArray[np.float64]


@kernel
def close(H: Array, w: Work, k: Array, state: Whole) -> int:
    """Move the state towards the closure: q by −H⁻¹Aᵀ(A H⁻¹Aᵀ)⁻¹e until e is rounding, then q̇ likewise by its rate.

    Of all moves that close the loop these are the smallest in the norm of the mass matrix: what a contact impulse would
    do. The force of Eq. 24 carries no share of it.
    """
    state[STATUS] = factorise(H, w.A, w.L, w.X, w.S, k[REACH])
    if state[STATUS] != OK:
        return FAIL
    stuck = state[MODE] == STUCK and state[STICKING] == RIGID_STICK
    for level in range(2):
        w.a[0] = w.now[GAP] if level == 0 else w.u[0]
        size = abs(w.a[0])
        for i in range(1, 3):
            w.a[i] = 0.0
            if stuck:
                w.a[i] = w.p[i] - w.anchor[i - 1] if level == 0 else w.u[i]
                size = max(size, abs(w.a[i]))
        if level == 0 and (size <= CLOSED or state[MOVES] >= MOST_MOVES):
            continue
        if stuck:
            for i in range(3):
                w.b[i] = 0.0
            state[STATUS] = stuck_force(w.S, w.a, w.b, w.F, w.share)
            if state[STATUS] != OK:
                return FAIL
        else:
            w.F[0] = -w.a[0] / w.S[0, 0] if w.S[0, 0] > 0.0 else 0.0
            w.F[1], w.F[2] = 0.0, 0.0
        if level == 0:
            strike(w.L, w.X, w.F, w.column, w.q)
            state[MOVES] += 1
            ask(state, CLOSING)
            return ASK
        strike(w.L, w.X, w.F, w.column, w.v)
    ask(state, state[NEXT])
    return ASK
