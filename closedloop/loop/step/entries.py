"""Entries: the functions by which the loop calls the plug-ins of a scenario, compiled separately, all of one signature.

    call_at(state.law.entry, address, TORQUE)        see `closedloop.jit.calls`

An entry takes the address of the loop's memory, and calls the member's functions with their arguments.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from closedloop.control.law import Compensation, ControlLaw, LawInput, Seen
from closedloop.jit.calls import Entry, row_of
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.parameters import one_joint_block, parameter_block, state_block
from closedloop.jit.user_code import function_of, member_entry
from closedloop.loop.step.memory import Constants, State, Work, loop_at
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.friction.law import JointFriction, Slip, SurfaceFriction, length_of

# Calls to a control law or a compensation, and to a law of friction.
TORQUE, START, RESTART, RATES, SLIDE, HOLD, ADVANCE_STATES, LIMIT, STICK = range(9)
CALLS = 9


@kernel
def mark_raised(address: int) -> None:
    """Note in the loop's memory that a user's member has raised something."""
    state, _, _ = loop_at(address)
    state.raised = 1


@kernel_inlined
def law_input(state: State, constants: Constants, w: Work) -> LawInput:
    """Return the input of the law at the state evaluated last."""
    if state.settings.seen != 0:
        seen = Seen(w.seen, state.n)
        return _input(state, w, seen, seen)
    return _input(state, w, w, w.tip)


@kernel_inlined
def _input(state: State, w: Work, arm: Any, tip: Any) -> LawInput:
    """Return the input of the law, of an arm (q, v, L, r, J, drift) whose tip has `frame` and the rows of Eq. 24."""
    wanted, pressed = w.reference, 0.0 if state.mode == FREE else 1.0
    return LawInput(
        w.time, arm.q, arm.v, w.H, w.C, arm.L, tip.A, tip.X, tip.S, tip.drift_c, tip.p, tip.u, arm.r, arm.J, arm.drift,
        tip.frame, wanted.q, wanted.v, w.qdd_des, wanted.position, wanted.velocity, wanted.acceleration, wanted.force,
        w.sensing.measured, pressed, w.scratch.numbers,
    )  # fmt: skip


@cache
def law_entry(member: type[ControlLaw] | type[Compensation]) -> Entry:
    """Return the entry of a law or a compensation, compiled when it is first needed.

    The states of a compensation follow those of the law.
    """
    Parameters, States = parameter_block(member), state_block(member)
    torque, rates, start, restart = (function_of(member, name) for name in ("torque", "rates", "start", "restart"))

    behind = issubclass(member, Compensation)

    def entry(address: int, what: int) -> int:
        state, constants, w = loop_at(address)
        first, last = (state.law.states, state.law_states) if behind else (0, state.law.states)
        x, par = (
            law_input(state, constants, w),
            Parameters(constants.compensation if behind else constants.law, state.n),
        )
        z = States(w.z[first:last], state.n)
        if what == TORQUE:
            torque(x, par, z, w.torque)
        elif what == RATES:
            rates(x, par, z, w.sensing.reading, w.torque, States(w.dz[first:last], state.n))
        elif what == START:
            start(x, par, z)
        else:
            restart(w.scratch.column, par, z)
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_{member.__name__}"
    return member_entry(entry, member, mark_raised)


@cache
def friction_entry(member: type[SurfaceFriction]) -> Entry:
    """Return the entry of a law of the surface's friction, compiled when it is first needed.

        SLIDE, HOLD     write c and viscous: of a tip that slides, of one that sticks as a spring
        RATES           writes dz and decays.rate
        ADVANCE_STATES  advances z by friction_span
        LIMIT           writes stick_limit
        STICK           writes z where slip along `direction` has ended

    In `Work` it reads slip, delayed_slip and direction.
    """
    Parameters, States = parameter_block(member), state_block(member)
    slide, hold, rates, decay = (function_of(member, name) for name in ("slide", "hold", "rates", "decay"))
    advance, stick_limit, stick = (function_of(member, name) for name in ("advance", "stick_limit", "stick"))

    def entry(address: int, what: int) -> int:
        state, constants, w = loop_at(address)
        par, stuck = Parameters(constants.friction, state.n), state.mode == STUCK
        at = state.law_states + state.sensor.states
        z = States(w.z[at : at + state.friction.states], 2)
        x = Slip(w.friction.slip, length_of(w.friction.slip), w.friction.delayed_slip, w.friction.direction)
        if what in (SLIDE, HOLD):
            for k in range(2):
                w.friction.c[k], w.friction.viscous[k] = 0.0, 0.0
            if what == SLIDE:
                slide(x, par, z, w.friction.c, w.friction.viscous)
            else:
                hold(par, z, w.friction.c)
        elif what == RATES:
            rates(x, par, z, stuck, States(w.dz[at : at + state.friction.states], 2))
            decay(x, par, z, stuck, States(w.decays.rate[at : at + state.friction.states], 2))
        elif what == ADVANCE_STATES:
            advance(x, par, z, stuck, w.friction.span)
        elif what == LIMIT:
            w.friction.stick_limit = stick_limit(par, z)
        elif what == STICK:
            stick(x, par, z)
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_surface_{member.__name__}"
    return member_entry(entry, member, mark_raised)


@cache
def joint_friction_entry(member: type[JointFriction]) -> Entry:
    """Return the entry of a law of the joints' friction, which answers for all joints.

    As `friction_entry`, with joint_slip, joint_lagged and joint_direction read, and joint_dry, joint_viscous and
    joint_limit written. SLIDE is of each joint as it is, stuck or not; STICK of those with a direction.
    """
    Parameters, States = one_joint_block(member), state_block(member)
    slide, hold, rates, decay = (function_of(member, name) for name in ("slide", "hold", "rates", "decay"))
    advance, stick_limit, stick = (function_of(member, name) for name in ("advance", "stick_limit", "stick"))

    def entry(address: int, what: int) -> int:
        state, constants, w = loop_at(address)
        count = state.joint_friction.states
        here = state.law_states + state.sensor.states + state.friction.states
        for j in range(state.n):
            if constants.bearings[j] == 0.0:  # dry, viscous and limit stay zero, as the memory is
                here += count
                continue
            par, stuck = Parameters(row_of(constants.joint_friction, j), 1), w.joint_friction.stuck[j] != 0.0
            z = States(w.z[here : here + count], 1)
            u, direction = w.joint_friction.slip[j : j + 1], w.joint_friction.direction[j : j + 1]
            x = Slip(u, abs(u[0]), w.joint_friction.lagged[j], direction)
            if what == SLIDE:
                c, viscous = w.joint_friction.dry[j : j + 1], w.joint_friction.viscous[j : j + 1]
                c[0], viscous[0] = 0.0, 0.0
                if stuck:
                    hold(par, z, c)
                else:
                    slide(x, par, z, c, viscous)
            elif what == RATES:
                rates(x, par, z, stuck, States(w.dz[here : here + count], 1))
                decay(x, par, z, stuck, States(w.decays.rate[here : here + count], 1))
            elif what == ADVANCE_STATES:
                advance(x, par, z, stuck, w.friction.span)
            elif what == LIMIT:
                w.joint_friction.limit[j] = stick_limit(par, z)
            elif what == STICK and direction[0] != 0.0:
                stick(x, par, z)
            here += count
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_joint_{member.__name__}"
    return member_entry(entry, member, mark_raised)
