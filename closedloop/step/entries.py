"""Entries: the functions by which the loop calls the plug-ins of a scenario, compiled separately, all of one signature.

    call_at(state.law, address, TORQUE)        see `closedloop.jit.calls`

An entry takes the address of the loop's memory, and calls the member's functions with their arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.law_input import LawInput
from closedloop.jit.calls import Entry
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.parameters import parameter_block, state_block
from closedloop.step.memory import Constants, State, Work, loop_at
from closedloop.user_code import source_digest

Array = NDArray[np.float64]

# Calls to a law or a compensation.
TORQUE, RATES, START, RESTART = range(4)


@kernel_inlined
def law_input(state: State, constants: Constants, w: Work) -> LawInput:
    """Return the input of the law at the state evaluated last."""
    n, wanted = w.q.shape[0], w.reference
    return LawInput(
        w.time, w.q, w.v, w.H, w.C, w.L, w.A, w.X, w.S, w.drift_c, w.p, w.u, w.r, w.J, w.drift, constants.frame,
        wanted[0:n], wanted[n : 2 * n], wanted[2 * n : 2 * n + 3], wanted[2 * n + 3 : 2 * n + 6],
        wanted[2 * n + 6 : 2 * n + 9], wanted[2 * n + 9], w.measured, 0.0 if state.mode == FREE else 1.0, w.scratch,
    )  # fmt: skip


@cache
def law_entry(member: type[ControlLaw] | type[Compensation]) -> Entry:
    """Return the entry of a law or a compensation, compiled when it is first needed.

    The states of a compensation follow those of the law.
    """
    Parameters, States = parameter_block(member), state_block(member)
    torque, rates, start, restart = (_as_kernel(member, name) for name in ("torque", "rates", "start", "restart"))

    if issubclass(member, Compensation):

        def entry(address: int, what: int) -> int:
            state, constants, w = loop_at(address)
            x, par = law_input(state, constants, w), Parameters(constants.compensation, state.n)
            z = States(w.z[state.own_law_states : state.law_states], state.n)
            if what == TORQUE:
                torque(x, par, z, w.torque)
            elif what == RATES:
                rates(x, par, z, w.reading, w.torque, States(w.dz[state.own_law_states : state.law_states], state.n))
            elif what == START:
                start(x, par, z)
            else:
                restart(w.column, par, z)
            return 0

    else:

        def entry(address: int, what: int) -> int:
            state, constants, w = loop_at(address)
            x, par = law_input(state, constants, w), Parameters(constants.law, state.n)
            z = States(w.z[0 : state.own_law_states], state.n)
            if what == TORQUE:
                torque(x, par, z, w.torque)
            elif what == RATES:
                rates(x, par, z, w.reading, w.torque, States(w.dz[0 : state.own_law_states], state.n))
            elif what == START:
                start(x, par, z)
            else:
                restart(w.column, par, z)
            return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_{member.__name__}"
    return entry_kernel(entry, identity=identity_of(member))


def identity_of(member: type[Any]) -> str:
    """Return the identity of a member in the cache of compiled code: its name and its source."""
    return f"{member.__module__}:{member.__qualname__} {source_digest(member)}"


def _as_kernel(member: type[Any], name: str) -> Callable[..., Any]:
    function: Any = getattr(member, name)
    made: Callable[..., Any] = function if hasattr(function, "py_func") else kernel(function)
    return made
