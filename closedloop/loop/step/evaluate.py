"""One evaluation of the equation of motion: law, friction, contact and Eq. 24 at one state.

The caller provides H, C, Jᵣ, r and J̇ᵣq̇ of the state, from Pinocchio or another source. `closedloop.loop.events` decides
which states are evaluated, and when.

The paper's law on a smooth surface is part of the loop, with loop joints too: `Settings.general` is 0. For everything
else
(other laws, friction of the tip and of the joints, a force sensor) it is the address of the law's entry.
"""

from closedloop.base.arrays import Array
from closedloop.control.drives import cut_torque
from closedloop.control.law import Perceived
from closedloop.control.laws.paper import PaperLaw, paper_law
from closedloop.control.sensor import SensorParameters, bias_at, continuous_reading, sensor_rates, signal_of
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.parameters import parameter_block
from closedloop.jit.simd8 import every
from closedloop.loop.step.closed_loops import DRIVE, factorise_tip, power_of_frames
from closedloop.loop.step.contacts import FRICTION_RATES
from closedloop.loop.step.entries import START, TORQUE, desired_acceleration, motor_rates, reference_row, transmit
from closedloop.loop.step.joint_friction import add_joint_friction, hold_joints, share_friction
from closedloop.loop.step.locate import in_contact_frame, keep_terms, locate_tip, perceive, sensor_feels
from closedloop.loop.step.memory import RIGID_STICK, Constants, State, Work, ask_contacts, ask_loops, is_semi_implicit
from closedloop.loop.step.solve_contact import contact_force
from closedloop.loop.step.tip_friction import surface_friction
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.closure.solve import DIVERGED, LAW_FAILED, OK
from closedloop.mechanics.friction.answers import RATES
from closedloop.mechanics.loops.reactions import lose_undriven

# Joint speed, rad/s (m/s), at which a run stops as diverged, long before the numbers overflow. The rates of three
# revolute joints are as large as that only within some 1e-5 rad of the posture in which two of their axes are parallel.
SPEED_LIMIT = 1e6

# Bound of forces and accelerations; the summary of a run takes squares, which are finite below it.
LARGEST = 1e100

# Parameters of the paper's law.
PaperParameters = parameter_block(PaperLaw)


@kernel_inlined
def evaluate(H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array, rows: Array) -> int:
    """Evaluate law, friction, contact and Eq. 24 at the state in `w`.

    Returns OK, SINGULAR, NOT_POSITIVE_DEFINITE, PAINLEVE, DIVERGED, LAW_FAILED or NO_NORMAL.

    `H`, `C`, (n, n), (n,) arrays: terms of the state, H's upper triangle.
    `w`: in: w.time, q, q̇, z, Jᵣ, r, J̇ᵣq̇ (and the torque, if it is held). Written: everything else.
    `constants`, `state`: see `closedloop.loop.step.memory`.
    `table` (P, 2 n + 14): see `reference_row`; the last columns are what the force sensor draws.
    `rows` (N, width): the rows recorded so far: what the memory of friction reads.
    """
    n = w.q.shape[0]
    status = locate_tip(w, constants, state)
    if status != OK:
        return status
    status = factorise_tip(H, w, constants, state)
    if status != OK:
        return status
    if state.settings.general != 0 or state.sampled != 0:
        reference_row(w.time, constants.node, table, n, w.reference.memory)
    if state.settings.general == 0:
        if state.sampled != 0:
            paper_torque(C, w, constants, w.time)
            ask_loops(state, DRIVE)
    else:
        status = ask_through_sensors(H, C, w, constants, state, table)
        if status != OK:
            return status
        if state.coupled == 0:
            surface_friction(w, constants, state, rows)
        add_joint_friction(w, constants, state, rows)
        if state.external.entry != 0:
            call_at(state.external.entry, state.external.at, 0)
    status = contact_force(C, w, constants, state)
    if status != OK:
        return status
    if state.settings.general != 0:
        holds = state.joint_friction.sticking == RIGID_STICK and state.event.stepping == 0
        if holds and hold_joints(w, constants, state):
            status = contact_force(C, w, constants, state)
            if status != OK:
                return status
            share_friction(w, constants, state)
        write_rates(w, constants, state)
        if state.raised != 0:
            return LAW_FAILED
    if state.loops.frames != 0:
        power_of_frames(H, C, w, state)
    return OK if bounded(w) else DIVERGED


@kernel_inlined
def ask_through_sensors(H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array) -> int:
    """Ask the law for its torque, with what the controller sees of the state in `w`, and pass it on to the joints.

    Returns OK, NOT_POSITIVE_DEFINITE, NO_NORMAL or LAW_FAILED; see `evaluate`.
    """
    if state.settings.feed_forward != 0:
        desired_acceleration(w.time, constants.node, table, w.qdd_des)
    if state.settings.perceived == 0:
        in_contact_frame(w.tip.frame, w.tip.carried, w.tip.turning, w.reference)
        keep_terms(H, C, w)
    elif state.settings.encoder == 0:
        status = perceive(H, C, w, constants, state)
        if status != OK:
            return status
    else:  # the law has been asked at the state that the encoders read, see `evaluate_law`
        perceived = Perceived(w.perceived, w.q.shape[0])
        in_contact_frame(perceived.frame, perceived.carried, perceived.turning, w.reference)
    if state.settings.encoder == 0 and ask_law(w, constants, state) != OK:
        return LAW_FAILED
    if state.settings.elastic != 0:
        transmit(w, constants)
    return OK


@kernel_inlined
def write_rates(w: Work, constants: Constants, state: State) -> None:
    """Write the sensor's reading, and the rates of the states of law, sensor, friction and motors, under the forces."""
    first, par = state.law_states, SensorParameters(constants.sensor, 0)
    at = first + state.sensor.states
    w.sensing.reading = w.sensing.measured
    if state.sensor.sampled == 0:
        signal = signal_of(sensor_feels(0, w, par, state), par, w.z[first:at])
        w.sensing.reading = continuous_reading(signal, bias_at(w.time, 0, par), par)
    call_law(state, RATES)
    for axis in range(state.sensor.states):  # each is that of an axis
        i = first + axis
        sensor_rates(sensor_feels(axis, w, par, state), par, w.z[i : i + 1], w.dz[i : i + 1])
    for i in range(at, w.z.shape[0]):
        w.dz[i] = w.decays.rate[i] = 0.0  # with the semi-implicit scheme friction's states advance by themselves
    if not is_semi_implicit(state):
        if state.coupled != 0:
            ask_contacts(state, FRICTION_RATES)
        elif state.mode != FREE and state.friction.states > 0:
            w.friction.slip[0], w.friction.slip[1] = w.tip.u[1], w.tip.u[2]
            call_at(state.friction.entry, state.address, RATES)
        if state.joint_friction.states > 0:
            call_at(state.joint_friction.entry, state.address, RATES)
    if state.settings.elastic != 0:
        motor_rates(w, constants)


@kernel_inlined
def paper_torque(C: Array, w: Work, constants: Constants, t: float) -> None:
    """Write the torque of the paper's law at t, s, with what is desired in the reference."""
    n = w.q.shape[0]
    par, wanted = PaperParameters(constants.law, n), w.reference
    paper_law(t, wanted.force, par, (wanted.q, wanted.v), (w.q, w.v), C, w.tip.A, w.torque)


@kernel
def evaluate_law(H: Array, C: Array, w: Work, constants: Constants, state: State, table: Array) -> int:
    """Ask the law at the state in `w`, which is what the encoders read, and return a status, as `evaluate` does."""
    status = locate_tip(w, constants, state)
    if status != OK:
        return status
    reference_row(w.time, constants.node, table, w.q.shape[0], w.reference.memory)
    if state.settings.feed_forward != 0:
        desired_acceleration(w.time, constants.node, table, w.qdd_des)
    status = perceive(H, C, w, constants, state)
    return ask_law(w, constants, state) if status == OK else status


@kernel
def ask_law(w: Work, constants: Constants, state: State) -> int:
    """Write the torque of the law and its compensation, if they are sampled here; return OK or LAW_FAILED."""
    if state.started == 0:
        call_law(state, START)
    if state.sampled != 0 and drive_torque(w, constants, state) != 0:
        return LAW_FAILED
    state.started = 1
    return OK


@kernel
def drive_torque(w: Work, constants: Constants, state: State) -> int:
    """Write the torque that the law asks for, as the drives can give it; return 0, or the law's error."""
    limited = state.settings.drives != 0
    if limited and w.time != w.drives.sampled_at:  # a sample may be taken anew, after an event in the step before it
        w.drives.sampled_at = w.time
        for j in range(w.q.shape[0]):
            w.drives.before[j] = w.torque[j]
    failed = call_law(state, TORQUE)
    if state.loops.entry != 0:
        call_at(state.loops.entry, state.loops.perceived_at if state.loops.perceived_at != 0 else state.loops.at, DRIVE)
    else:
        lose_undriven(constants.undriven, state.settings.undriven, w.torque)
    if limited and failed == 0:
        cut_torque(
            w.torque, w.drives.before, constants.torque_change, constants.torque_limit, not w.time > 0.0,
            w.drives.limited,
        )  # fmt: skip
    return failed


@kernel
def call_law(state: State, what: int) -> int:
    """Call the law and its compensation, see `closedloop.loop.step.entries`; return 0, or the law's error."""
    if state.settings.general == 0:  # the built-in law has nothing to be told
        return 0
    failed = call_at(state.law.entry, state.address, what)
    if failed == 0 and state.compensation.entry != 0:
        call_at(state.compensation.entry, state.address, what)
    return failed


@kernel_inlined
def bounded(w: Work) -> bool:
    """Whether F, q̈ and q̇ are numbers, F and q̈ within `LARGEST`, and q̇ within `SPEED_LIMIT`."""
    total = abs(w.tip.F[0])
    for j in range(w.q.shape[0]):
        total += abs(w.qdd[j])
        if not every(abs(w.v[j]) <= SPEED_LIMIT):
            return False
    return every(total < LARGEST)
