"""The entries of plug-ins, and what is desired at an instant, from the table that the reference is prepared as.

Angles and rates of motors behind elastic joints are the last of z, see `closedloop.control.drives`.

Entries are the functions by which the loop calls the plug-ins of a scenario, compiled separately, all of one signature.

    call_at(state.law.entry, address, TORQUE)        see `closedloop.jit.calls`

An entry takes the address of the loop's memory, and calls the member's functions with their arguments.
"""

from typing import Any

from closedloop.base.arrays import Array
from closedloop.control.law import Compensation, ControlLaw, LawInput, Perceived
from closedloop.control.reference.inverse_kinematics import cubic
from closedloop.jit.calls import Entry, row_of
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.parameters import one_joint_block, parameter_block, state_block
from closedloop.jit.user_code import function_of, member_entry
from closedloop.loop.step.memory import Constants, State, Work, loop_at
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.friction.answers import HOLD, LIMIT, RATES, SLIDE, STICK, answers
from closedloop.mechanics.friction.law import JointFriction, Slip, SurfaceFriction, length_of
from robot_models.cached import cached

# The sum of two slopes, rad/s² (m/s²), that are rounding: their signs say nothing, but they may have derivatives.
STILL = 1e-11


@kernel_inlined
def reference_row(t: float, spacing: float, table: Array, n: int, row: Array) -> None:
    """Write the reference at time t: between the table's rows positions are cubics and the rest is linear.

    `t`, `spacing`: time, and time between two rows of the table, s.
    `table` (P, >= 2 n + 10): q_des, q̇_des, then r_des, ṙ_des and r̈_des of the tip in base axes, then f_des.
    `row` (2 n + 10,): written.
    """
    x = t / spacing
    at = nearest_row(t, spacing, table.shape[0])
    width = row.shape[0]
    if abs(x - at) < 1e-6 or round(x) > at:
        for j in range(width):
            row[j] = table[at, j]
        return
    at = min(int(x), table.shape[0] - 2)
    s = x - at
    for j in range(width):
        row[j] = (1.0 - s) * table[at, j] + s * table[at + 1, j]
    for block in range(2):
        begin = 0 if block == 0 else 2 * n
        size = n if block == 0 else 3
        for j in range(begin, begin + size):
            row[j], _, _ = cubic(
                table[at, j], table[at + 1, j], table[at, j + size], table[at + 1, j + size], spacing, s
            )


@kernel_inlined
def nearest_row(t: float, spacing: float, count: int) -> int:
    """Return which of the table's rows is nearest to time t, s."""
    return min(round(t / spacing), count - 1)


@kernel
def desired_acceleration(t: float, spacing: float, table: Array, qdd: Array) -> None:
    """Write q̈_des (n,) at the table's row nearest to t, s, of the rates q̇_des on either side of it.

    It is the smaller of the two slopes, and zero where they differ in sign: so a velocity that jumps, as at the start
    of a line, asks for no acceleration, and a smooth one for its own, to first order in the spacing.
    """
    n, at = qdd.shape[0], nearest_row(t, spacing, table.shape[0])
    for j in range(n):
        qdd[j] = 0.0
        if 0 < at < table.shape[0] - 1:
            before = (table[at, n + j] - table[at - 1, n + j]) / spacing
            after = (table[at + 1, n + j] - table[at, n + j]) / spacing
            if before * after > 0.0 or abs(before) + abs(after) <= STILL:
                qdd[j] = before if abs(before) < abs(after) else after


@kernel
def transmit(w: Work, constants: Constants) -> None:
    """Write the torque that the transmissions pass on to the links, `transmitted` (n,), N m."""
    n = w.q.shape[0]
    at = w.z.shape[0] - 2 * n
    for j in range(n):
        gap, wound = constants.gears.play[j], w.z[at + j] - w.q[j]
        across = 0.0 if gap > 0.0 and abs(wound) <= gap else (wound - gap if wound > 0.0 else wound + gap)
        passed = constants.gears.stiffness[j] * across + constants.gears.damping[j] * (w.z[at + n + j] - w.v[j])
        # teeth push on the side where they touch, and do not pull
        w.drives.transmitted[j] = 0.0 if gap > 0.0 and passed * across <= 0.0 else passed


@kernel
def motor_rates(w: Work, constants: Constants) -> None:
    """Write the rates of the motors' states, from the torque and what the transmissions pass on."""
    n = w.q.shape[0]
    at = w.z.shape[0] - 2 * n
    for j in range(n):
        w.dz[at + j] = w.z[at + n + j]
        if constants.gears.motor_inertia[j] > 0.0:
            w.dz[at + n + j] = (w.torque[j] - w.drives.transmitted[j]) / constants.gears.motor_inertia[j]
        else:  # a joint without a drive
            w.dz[at + n + j] = 0.0


@kernel
def lead_motors(w: Work, tau: float, substep: bool) -> None:
    """For the semi-implicit scheme, let the motors' angles advance with their new rates, as the joints do.

    In a substep after an event it is the mean of the old and the new rate, see `closedloop.loop.step.advance.advance`.
    """
    n = w.q.shape[0]
    at = w.z.shape[0] - 2 * n
    for j in range(n):
        w.dz[at + j] = w.z[at + n + j] + (0.5 * tau if substep else tau) * w.dz[at + n + j]


# Calls to a control law or a compensation, beside RATES; and how many calls there are with those to a law of friction.
TORQUE, START, RESTART = range(3)
CALLS = STICK + 1


@kernel
def mark_raised(address: int) -> None:
    """Note in the loop's memory that a user's member has raised something."""
    state, _, _ = loop_at(address)
    state.raised = 1


@kernel_inlined
def law_input(state: State, constants: Constants, w: Work) -> LawInput:
    """Return the input of the law at the state evaluated last."""
    if state.settings.perceived != 0:
        perceived = Perceived(w.perceived, state.n)
        return _input(state, w, perceived, perceived)
    return _input(state, w, w, w.tip)


@kernel_inlined
def _input(state: State, w: Work, arm: Any, tip: Any) -> LawInput:
    """Return the input of the law, of an arm (q, v, L, r, J, drift) whose tip has `frame` and the rows of Eq. 24."""
    wanted, pressed = w.reference, 0.0 if state.mode == FREE else 1.0
    return LawInput(
        w.time, arm.q, arm.v, w.H, w.C, arm.L, tip.A, tip.X, tip.S, tip.drift_c, tip.p, tip.u, arm.r, arm.J, arm.drift,
        tip.frame, wanted.q, wanted.v, w.qdd_des, wanted.position, wanted.velocity, wanted.acceleration, wanted.force,
        w.sensing.measured, w.sensing.tangential, pressed, w.scratch.numbers,
    )  # fmt: skip


@cached
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


@cached
def friction_entry(member: type[SurfaceFriction]) -> Entry:
    """Return the entry of a law of the surface's friction, compiled when it is first needed.

        SLIDE, HOLD     write c and viscous: of a tip that slides, of one that sticks as a spring
        RATES           writes dz and decays.rate
        ADVANCE_STATES  advances z by friction_span
        LIMIT           writes stick_limit
        STICK           writes z where slip along `direction` has ended

    In `Work` it reads slip, delayed_slip and direction.
    """
    Parameters, States, answer = parameter_block(member), state_block(member), answers(member)

    def entry(address: int, what: int) -> int:
        state, constants, w = loop_at(address)
        at = state.law_states + state.sensor.states
        end = at + state.friction.states
        x = Slip(w.friction.slip, length_of(w.friction.slip), w.friction.delayed_slip, w.friction.direction)
        limit = answer(
            what, x, Parameters(constants.friction, state.n), States(w.z[at:end], 2), state.mode == STUCK, w.friction.c,
            w.friction.viscous, States(w.dz[at:end], 2), States(w.decays.rate[at:end], 2), w.friction.span,
        )  # fmt: skip
        if what == LIMIT:
            w.friction.stick_limit = limit
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_surface_{member.__name__}"
    return member_entry(entry, member, mark_raised)


@cached
def joint_friction_entry(member: type[JointFriction]) -> Entry:
    """Return the entry of a law of the joints' friction, which answers for all joints.

    As `friction_entry`, with joint_slip, joint_lagged and joint_direction read, and joint_dry, joint_viscous and
    joint_limit written. SLIDE is of each joint as it is, stuck or not; STICK of those with a direction.
    """
    Parameters, States, answer = one_joint_block(member), state_block(member), answers(member)

    def entry(address: int, what: int) -> int:
        state, constants, w = loop_at(address)
        count = state.joint_friction.states
        here = state.law_states + state.sensor.states + state.friction.states
        for j in range(state.n):
            end = here + count
            # else dry, viscous and limit stay zero, as the memory is
            if constants.bearings[j] != 0.0 and (what != STICK or w.joint_friction.direction[j] != 0.0):
                stuck, u = w.joint_friction.stuck[j] != 0.0, w.joint_friction.slip[j : j + 1]
                x = Slip(u, abs(u[0]), w.joint_friction.lagged[j], w.joint_friction.direction[j : j + 1])
                limit = answer(
                    HOLD if what == SLIDE and stuck else what, x, Parameters(row_of(constants.joint_friction, j), 1),
                    States(w.z[here:end], 1), stuck, w.joint_friction.dry[j : j + 1],
                    w.joint_friction.viscous[j : j + 1], States(w.dz[here:end], 1), States(w.decays.rate[here:end], 1),
                    w.friction.span,
                )  # fmt: skip
                if what == LIMIT:
                    w.joint_friction.limit[j] = limit
            here = end
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_joint_{member.__name__}"
    return member_entry(entry, member, mark_raised)
