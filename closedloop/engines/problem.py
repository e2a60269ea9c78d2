"""A scenario as numbers: everything that the loop needs, open to inspection before it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, PRESSED
from closedloop.contacts.bind import contact_memory
from closedloop.control.compensation.none import NoCompensation
from closedloop.control.drives import DrivesSection
from closedloop.control.encoder import MEASURED_VELOCITY, NO_ENCODER, encoder_kind
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.law_input import LawInput
from closedloop.control.sensor import PackedSensor, SensorSection, start_sensor
from closedloop.errors import ClosedLoopError, LawError, ScenarioError
from closedloop.events.phases import MEASURED, PROJECTION, STEP_END, TOUCHING
from closedloop.families import is_users
from closedloop.friction.contact import Contact
from closedloop.friction.law import FrictionLaw, Slip
from closedloop.friction.laws.none import NoFriction
from closedloop.impact import RATIOS
from closedloop.impact.restitution import RESTITUTIONS, Restitution, coefficient_at
from closedloop.integrators import Scheme
from closedloop.jit.calls import entry_address
from closedloop.jit.interpreted import interpreted, twin_address
from closedloop.loops.bind import loop_memory
from closedloop.parameters import one_joint_block, pack, pack_each_joint, parameter_block, per_joint, state_block
from closedloop.reference.desired import Desired
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.scenario import BaumgarteGains, ModelErrorSection, Scenario
from closedloop.step.closed_loops import closed_loops
from closedloop.step.contacts import contacts_in_step
from closedloop.step.entries import friction_entry, joint_friction_entry, law_entry
from closedloop.step.memory import (
    ELASTIC_STICK,
    RIGID_STICK,
    SMOOTH,
    SPRING_STICK,
    Constants,
    Loop,
    State,
    Work,
    make_loop,
)
from closedloop.step.record_row import ContactRow, Row, row_width
from closedloop.step.seen import MOTORS_MEASURED, read_joints
from closedloop.step.soft_contact import compliance_entry
from closedloop.surface.compliances.none import Rigid
from closedloop.surface.placed import PlacedSurface
from closedloop.surface.plane import Plane
from closedloop.user_code import of_users, why_member_not_compiled

Array = NDArray[np.float64]

# Slip slower than this, m/s, is none: a tip that starts with it sticks, one that slows down to it may.
STICK_SPEED = 1e-7


STICKING = {"rigid": RIGID_STICK, "elastic": ELASTIC_STICK, "spring": SPRING_STICK}


class PackedLaw(NamedTuple):
    """A law as the loop reads it: of control, of compensation, or of friction.

    Attributes
    ----------
    member : type
        Its class.
    numbers : array
        Its parameters, see `closedloop.parameters.parameter_block`; of friction in joints a row for each, (n, ...),
        see `closedloop.parameters.one_joint_block`.
    states : int
        How many states it has; of friction in joints, each of them.
    """

    member: Any
    numbers: Array
    states: int


def pack_law(section: ControlLaw | Compensation, n: int, joint_names: Sequence[str] = ()) -> PackedLaw:
    """Turn a law or a compensation into numbers for n joints.

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint, or a user's law lacks a function.
    """
    where = "law" if isinstance(section, ControlLaw) else "compensation"
    type(section).check_functions(f"{where}.kind")
    return PackedLaw(type(section), pack(section, n, where, joint_names), state_block(type(section)).count(n))


def pack_friction(section: FrictionLaw, n: int, joints: bool = False) -> PackedLaw:
    """Turn a law of the surface's friction, or of the joints', into numbers for n joints.

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint, or a user's law lacks a function.
    """
    member, where = type(section), "joint_friction" if joints else "friction"
    if member is not NoFriction:
        member.check_functions(f"{where}.kind")
    numbers = pack_each_joint(section, n, where) if joints else pack(section, n, where)
    return PackedLaw(member, numbers, state_block(member).count(1 if joints else 2))


@dataclass(frozen=True)
class Problem:
    """A scenario as numbers: everything that the loop needs, open to inspection before it runs.

    Attributes
    ----------
    robot, surface, integrator
        The arm with its tip, the surface, the scheme.
    frame : (3, 3) array
        Contact frame at t = 0: rows n, t1, t2 in base axes.
    q, v : (n,) arrays
        State at t = 0.
    mode : int
        Contact mode at t = 0, see `closedloop.closure.contact_force`.
    steps, h : int, float
        Number of steps and the step, s.
    stabiliser : (2,) array
        s_v, 1/s, and s_p, 1/s².
    pd_start : float
        Instant from which the PD part of the law acts, s.
    law, compensation, friction, joint_friction, compliance : PackedLaw
        The law, its compensation of friction, friction, and the compliance of the surface, as numbers.
    sensor : PackedSensor
        The force sensor.
    table : (steps · nodes + 1, 2 n + 11) array
        The reference at every instant at which a stage is evaluated, see `closedloop.step.evaluate.reference_row`, and
        a standard normal number for the force sensor.
    nodes : int
        Rows of the table to a step.
    project : bool
        Whether the state is projected onto the closure after each step.
    hold : int
        Steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    drives : (2, n) array
        Largest torque of each joint, and its largest change from sample to sample, N m; infinite where there is none.
    transmission : (3, n) array
        Stiffness, damping and motor inertia of elastic joints, see `closedloop.control.transmission`; zero: rigid.
    encoder : (k,) array
        The parameters of the encoders.
    wanted : Desired
        The reference at any instant.
    tolerance : float or None
        Relative tolerance of an adaptive integrator; None: the step is fixed.
    """

    scenario: Scenario
    robot: Robot
    surface: PlacedSurface
    frame: Array
    integrator: type[Scheme]
    q: Array
    v: Array
    mode: int
    steps: int
    h: float
    stabiliser: Array
    pd_start: float
    law: PackedLaw
    compensation: PackedLaw
    friction: PackedLaw
    joint_friction: PackedLaw
    compliance: PackedLaw
    sensor: PackedSensor
    table: Array
    nodes: int
    project: bool
    hold: int
    drives: Array
    transmission: Array
    encoder: Array
    wanted: Desired
    tolerance: float | None

    @property
    def time_constant(self) -> float | None:
        """T of Baumgarte's stabiliser, s, as given or as chosen by "auto"; None without that stabiliser."""
        section = self.scenario.stabiliser
        if not isinstance(section, BaumgarteGains):
            return None
        return float(self.stabiliser[1] ** -0.5) if section.time_constant == "auto" else section.time_constant

    @property
    def plane(self) -> Plane:
        """The plane through the surface's origin at t = 0, with its normal there: the surface itself if it is one."""
        return Plane(self.surface.normal, self.surface.offset)

    @property
    def path(self) -> Array:
        """q_des and q̇_des of every row of the table, (P, 2, n)."""
        n = self.robot.n
        return self.table[:, : 2 * n].reshape(-1, 2, n)

    @property
    def gains(self) -> Array:
        """K_p and K_d of every joint, (2, n), of a law that has them."""
        law: Any = self.scenario.law
        return np.array([per_joint(f"law.{name}", getattr(law, name), self.robot.n) for name in ("kp", "kd")])

    @property
    def settings(self) -> Array:
        """f_des at the start, N, and the instant from which the PD part acts, s."""
        return np.array([self.table[0, 2 * self.robot.n + 9], self.pd_start])

    @property
    def general(self) -> bool:
        """Whether the general form of the loop is needed."""
        return needs_general_form(self.scenario) or self.bound or bool(self.scenario.contact)

    @property
    def bound(self) -> bool:
        """Whether there are loops, or stops of joints."""
        return bool(self.robot.model.loops) or self.scenario.robot.stops

    @property
    def row_width(self) -> int:
        """Numbers in a recorded row."""
        contacts = len(self.scenario.contact or ())
        return row_width(self.robot.n, bool(arm_columns(self.scenario)), contacts)

    def loop(self, user_law: bool = False) -> Loop:
        """Return the loop's memory at t = 0.

        Parameters
        ----------
        user_law : bool
            Whether a user's law replaces the scenario's law and compensation.

        The addresses of the functions that it calls are set by `connect`, or by `closedloop.engines.user_law.UserLaw`.
        """
        n, law, compensation = self.robot.n, self.law, self.compensation
        own, both = (0, 0) if user_law else (law.states, law.states + compensation.states)
        surface, joints = self.friction.states, self.joint_friction.states
        motors = 2 * n if self.scenario.transmission.elastic else 0
        extra = both + self.sensor.states + surface + n * joints + motors
        loop = make_loop(
            n, **self._sizes(), extra=extra, stages=self.integrator.stages, ring=self.sensor.ring
        )  # fmt: skip
        state = loop.state
        state.own_law_states, state.law_states = own, both
        state.friction_states, state.joint_states, state.sensor_states = surface, joints, self.sensor.states
        self._set_state(state)
        if not self.surface.fixed_plane:
            memory = self.surface.memory()
            state.surface_at = memory.address
            loop.w.keep_alive(surface=memory)
        if self.bound:
            loops = loop_memory(self.robot, self.scenario.robot.stops)
            state.loops_at, loops.links.loop = loops.address, state.address
            loop.w.keep_alive(loops=loops)
        self._set_constants(loop.constants)
        self._set_start(state, loop.w)
        if self.scenario.contact:
            contacts = contact_memory(self.scenario, self.robot)
            state.contacts_at, contacts.links.loop = contacts.address, state.address
            contacts.links.record_at = self.row_width - ContactRow.count(len(self.scenario.contact))
            contacts.contacts.mode[0] = PRESSED if state.unilateral == 0 else FREE
            loop.w.keep_alive(contacts=contacts)
        if state.encoder != NO_ENCODER and state.phase == STEP_END:
            interpreted(read_joints)(loop.w, loop.constants, state, self.table)
            state.phase = MEASURED
        return loop

    def constants(self) -> Constants:
        """Return the constants of the loop's memory, by themselves."""
        sizes = self.robot.n, *self._sizes().values()
        constants = Constants(np.zeros(Constants.count(*sizes)), *sizes)
        self._set_constants(constants)
        return constants

    def _sizes(self) -> dict[str, int]:
        """Return how many numbers the parameters of each member are, in the order of `Constants`."""
        return {
            "law": self.law.numbers.size, "compensation": self.compensation.numbers.size,
            "friction": self.friction.numbers.size, "joint_friction": self.joint_friction.numbers.shape[1],
            "compliance": self.compliance.numbers.size,
        }  # fmt: skip

    def entries(self, user_law: bool = False) -> dict[str, Any]:
        """Return what the loop calls by address, by the names that `State` has for it; see `loop` for `user_law`."""
        found: dict[str, Any] = self.surface.entries()
        if self.general and not user_law:
            found["law"] = law_entry(self.law.member)
            if self.compensation.member is not NoCompensation:
                found["compensation"] = law_entry(self.compensation.member)
        if self.compliance.member is not Rigid:
            found["compliance"] = compliance_entry(self.compliance.member)
        if self.friction.member is not NoFriction:
            found["friction"] = friction_entry(self.friction.member)
        if self.joint_friction.member is not NoFriction:
            found["joint_friction"] = joint_friction_entry(self.joint_friction.member)
        return found

    def connect(self, loop: Loop, user_law: Callable[[bool], None] | None = None, compiled: bool = True) -> None:
        """Write into a loop's memory where what it calls is: machine code, or what an interpreted loop calls.

        Parameters
        ----------
        loop : Loop
            The memory.
        user_law : callable, optional
            What writes where a law of one's own is; it is told `compiled`.
        compiled : bool
            Whether the loop is machine code.

        Raises
        ------
        ScenarioError
            If numba cannot compile a user's member.
        """
        address = entry_address if compiled else twin_address
        for name, entry in self.entries(user_law is not None).items():
            try:
                setattr(loop.state, name, address(entry))
            except Exception as error:
                member, known = getattr(self.scenario, name), {"LawInput": LawInput._fields, "Slip": Slip._fields}
                if not is_users(member) or isinstance(error, ClosedLoopError):
                    raise
                why = why_member_not_compiled(error, type(member), known)
                raise ScenarioError(f"{name}.kind = {member.kind}: cannot be compiled: {why}") from None
        if loop.state.loops_at != 0:
            loop.state.loops = address(closed_loops)
        if loop.state.contacts_at != 0:
            loop.state.contacts = address(contacts_in_step)
        if loop.state.surface_motion != 0:
            loop.w.kept["surface"].links.motion = loop.state.surface_motion
        if user_law is not None:
            user_law(compiled)

    def _set_constants(self, constants: Constants) -> None:
        robot, impact = self.robot, self.scenario.impact
        constants.h, constants.node, constants.offset = self.h, self.h / self.nodes, self.surface.offset
        constants.s_v, constants.s_p = self.stabiliser
        constants.tip[:], constants.gravity[:], constants.reach = robot.tip_offset, robot.gravity, robot.reach**2
        constants.lower_stop[:], constants.upper_stop[:] = robot.model.position_lower, robot.model.position_upper
        constants.restitution, constants.rest_speed = impact.restitution, impact.rest_speed
        constants.sensor[:], constants.support[:], constants.stick_speed = (
            self.sensor.par.memory, robot.support, STICK_SPEED,
        )  # fmt: skip
        constants.law[:], constants.compensation[:] = self.law.numbers, self.compensation.numbers
        wrong = self.scenario.model_error
        constants.believed_masses, constants.unknown_payload = wrong.masses, wrong.payload
        constants.armature[:] = 0.0 if robot.model.elastic else robot.model.armature
        constants.stiffness[:], constants.shaft_damping[:], constants.motor_inertia[:] = self.transmission
        constants.tilt[:], constants.encoder[:] = np.eye(3) if wrong.normal == 0.0 else wrong.tilt(), self.encoder
        constants.torque_limit[:], constants.torque_change[:] = self.drives
        constants.compliance[:] = self.compliance.numbers
        constants.friction[:], constants.joint_friction[:] = self.friction.numbers, self.joint_friction.numbers
        if self.friction.member is not NoFriction:  # whose numbers are zero, as the memory is
            tip = self._tip()
            with of_users(self.friction.member, "friction.kind"):
                constants.impact_friction = tip.kinetic_level
                constants.capture_speed, constants.lag = tip.capture_speed, tip.lag
        if self.joint_friction.member is not NoFriction:
            with of_users(self.joint_friction.member, "joint_friction.kind"):
                for j, joint in enumerate(self._joints()):
                    constants.joint_capture_speed[j], constants.joint_lag[j] = joint.capture_speed, joint.lag

    def _set_state(self, state: State) -> None:
        state.steps, state.hold, state.nodes_per_step = self.steps, self.hold, self.nodes
        state.project, state.semi_implicit = self.project, self.integrator.semi_implicit
        state.unilateral = self.scenario.surface.contact == "unilateral"
        state.impact_law = RATIOS[self._restitution().ratio_of]
        state.sticking, state.joint_sticking = _sticking(self.friction), _sticking(self.joint_friction)
        state.stops = self.scenario.robot.stops
        state.sensor_sampled = self.sensor.sampled
        transmission = self.scenario.transmission
        state.elastic = MOTORS_MEASURED if transmission.on_motors else int(transmission.elastic)
        state.encoder = reading_kind(self.scenario)
        state.drives = self.scenario.drives != DrivesSection()
        state.arm_at = Row.count(self.robot.n) if arm_columns(self.scenario) else 0
        state.model_error = self.scenario.model_error != ModelErrorSection()
        state.seen = state.model_error or state.elastic or state.encoder
        state.mode, state.sampled, state.risen = self.mode, 1, 1
        if self.project and self.mode != FREE:
            state.phase, state.next_phase = PROJECTION, STEP_END

    def _set_start(self, state: State, w: Work) -> None:
        n = self.robot.n
        w.q[:], w.v[:] = self.q, self.v
        w.frame[:] = self.frame
        terms = self.robot.terms(self.q, self.v)
        velocity = terms.jacobian @ self.v
        u = self.frame @ velocity
        w.anchor[:] = self.frame @ terms.position
        if not self.surface.fixed_plane:
            now = self.surface.touching(terms.position, velocity)
            u -= now.carried
            state.beside = self.mode == FREE and now.inside < 0.0 and now.gap <= TOUCHING
            w.anchor[:] = self.surface.frame[[1, 2, 0]] @ (terms.position - self.surface.origin)
        slip = float(np.hypot(u[1], u[2]))
        if slip > 0.0:
            w.direction[:] = u[1:] / slip
        felt = float(self.table[0, 2 * n + 9]) if self.mode != FREE else 0.0  # the sensor's history is f_des
        sensor = int(state.law_states)
        friction = sensor + int(state.sensor_states)
        joints = friction + int(state.friction_states)
        start_sensor(felt, self.sensor.par, w.z[sensor:friction], w.ring)
        w.measured, w.last_event = w.ring[0], -np.inf
        if joints > friction and self.mode != FREE and slip <= STICK_SPEED:
            with of_users(self.friction.member, "friction.kind"):
                w.z[friction:joints] = self._tip().rested()
        if state.joint_sticking == SPRING_STICK:
            w.stuck[:] = self.v == 0.0
        if state.joint_states > 0:
            with of_users(self.joint_friction.member, "joint_friction.kind"):
                motors = joints + n * int(state.joint_states)
                w.z[joints:motors] = np.concatenate([joint.rested() for joint in self._joints()])
        if state.elastic:
            # Each spring carries what holds the arm against gravity and the force desired, so that none is released.
            held = terms.bias - felt * (self.frame[0] @ terms.jacobian)
            w.z[-2 * n : -n], w.z[-n:] = self.q + held / self.transmission[0], self.v

    def set_restitution(self, loop: Loop) -> None:
        """Write into a loop's memory the coefficient of restitution of the impact at which it stands.

        Raises
        ------
        LawError
            If a user's law gives none.
        """
        given, t = self.scenario.impact.restitution, float(loop.w.time)
        try:
            loop.constants.restitution = coefficient_at(self._restitution(), given, -float(loop.w.before[0]))
        except ScenarioError as error:
            raise LawError(f"stopped at t = {t:.6g} s: {error}", t) from error.__cause__

    def _restitution(self) -> type[Restitution]:
        return RESTITUTIONS[self.scenario.impact.law]

    def _tip(self) -> Contact:
        """Return the contact of the tip, for what is asked of its friction once."""
        member, numbers, _ = self.friction
        return Contact(member, parameter_block(member)(numbers, self.robot.n), 2)

    def _joints(self) -> list[Contact]:
        member, rows, _ = self.joint_friction
        return [Contact(member, one_joint_block(member)(row, self.robot.n), 1) for row in rows]


def _sticking(friction: PackedLaw) -> int:
    return SMOOTH if friction.member is NoFriction else STICKING[friction.member.sticks]


def needs_general_form(scenario: Scenario) -> bool:
    """Whether a scenario needs the general form of the loop, see `closedloop.step.evaluate`."""
    return (
        scenario.law.kind != "paper"
        or scenario.law.force_feedback > 0.0
        or scenario.law.force_integral > 0.0
        or scenario.compensation.kind != "none"
        or scenario.friction.kind != "none"
        or scenario.rubs_in_joints
        or scenario.sensor != SensorSection()
        or scenario.model_error != ModelErrorSection()
        or bool(arm_columns(scenario))
    )


def arm_columns(scenario: Scenario) -> tuple[str, ...]:
    """Return the columns beyond `closedloop.step.record_row.RECORDED` that a run of a scenario has."""
    drives = ("torque_limited",) if scenario.drives != DrivesSection() else ()
    encoder = ("measured_position", "measured_velocity") if scenario.reads_encoders else ()
    motors = ("motor_position", "motor_velocity", "transmitted_torque") if scenario.transmission.elastic else ()
    return drives + encoder + motors


def reading_kind(scenario: Scenario) -> int:
    """Return whether the controller reads encoders, see `closedloop.control.encoder.encoder_kind`."""
    kind = encoder_kind(scenario.encoder)
    return MEASURED_VELOCITY if kind == NO_ENCODER and scenario.transmission.on_motors else kind
